"""Process model of the papers' planar motion filters, with three degrees of freedom (v_x, v_y, yaw
rate r). The model is integrated by Heun's rule.

It is the model of paper 000 (equations 1 to 14), of paper 001, and of paper 004 (equations 1 to
12). The state is [v_x, v_y, a_x, a_y, r, z]. The accelerations a_x and a_y follow from the tyre
forces.

    v_x'    = a_x + r*v_y
    v_y'    = a_y - r*v_x    (paper 004 prints the wrong sign)
    I_z*r'  = yaw moment of the tyre forces

The last state z is the friction in paper 004, and the yaw acceleration in papers 000 and 001. These
two papers use the yaw moment as state. Here the moment is divided by I_z, so that all states are of
similar magnitude.
"""

from __future__ import annotations

import math
from enum import IntEnum
from typing import NamedTuple

import numpy as np

from edge_agent.dynamics.body import advance_velocity
from edge_agent.dynamics.chassis import PlanarMotion, WheelInputs, planar_response
from edge_agent.dynamics.dual_motor import axle_force, midpoint_speed
from edge_agent.dynamics.parameters import Body, Four, Parameter, as_four, body_of
from edge_agent.estimators.common.inputs import InputTrack, wheel_force
from schemas.mugrid import LOWER, UPPER
from schemas.numeric import FloatArray
from schemas.runtime.jit import compiled, inlined
from schemas.signals import S

LONGEST_S = 0.02  # [s] longest step of Heun's rule
# [m/s] At lower speed shorter steps are needed, because the pole of the lateral motion is at about
# 170/v [1/s].
CALM_M_S = 2.0
SHORTEST_SHARE = 0.2  # [1] shortest step over the longest one
POINTS = 12  # number of points of the cubature rule in six dimensions, one per column
# Number of points in the first of two loops. The loop lengths are constants, so that the compiler
# turns each loop into vector instructions without a remainder.
ABREAST = 8


class PlanarState(IntEnum):
    """Index of a state in the state vector of the papers' planar motion filters."""

    VX = 0
    VY = 1
    AX = 2
    AY = 3
    YAW_RATE = 4
    MU = 5  # friction (004)
    YAW_ACCELERATION = 5  # (000, 001)


class HeunInputs(NamedTuple):
    """Inputs of the vehicle model at both ends of one integration step of Heun's rule."""

    begin: WheelInputs
    end: WheelInputs
    step: float  # [s]
    by_torque: bool  # True if forces come from wheel torque, and z is the yaw acceleration


class PlanarStep(NamedTuple):
    """Length `dt` [s] of a step of the process model, and source of the longitudinal tyre forces:
    the wheels' torques (`by_torque`), one motor per axle (`by_motor`), or else the slip.
    """

    dt: float
    by_torque: bool
    by_motor: bool = False


@compiled
def stable_steps(speed: float, dt: float) -> int:
    """Return the number of equal Heun steps needed for a stable integration over `dt` [s] at
    `speed` [m/s].
    """
    longest = LONGEST_S * min(max(speed / CALM_M_S, SHORTEST_SHARE), 1.0)
    return max(1, math.ceil(dt / longest - 1e-6))


@inlined
def propagate_points(
    row: FloatArray,
    columns: FloatArray,
    friction: FloatArray,
    track: InputTrack,
    step: PlanarStep,
) -> None:
    """Advance the vehicle states by one step. Each of the `columns` (6, POINTS) is the state of one
    cubature point, and is changed in place.

    Inputs change linearly from the previous sample to the current sample. `step` selects the source
    of the longitudinal tyre forces:

    - `by_torque`: the torques of the four wheels. The last state z is the yaw acceleration, and the
      wheels' friction (4,) is given. The velocity is integrated from the states a_x and a_y. The
      accelerometers correct these two states, so that they include drag and road slope.
    - `by_motor`: the torque of each axle's motor, divided equally between the two wheels. The last
      state z is the friction of all wheels.
    - Neither flag: the slip of the wheels. The last state z is the friction of all wheels.
    """
    slowest = abs(columns[0, 0])
    for p in range(1, POINTS):
        slowest = min(slowest, abs(columns[0, p]))
    dt, by_torque, by_motor = step
    times = stable_steps(slowest, dt)
    unknown = (math.nan, math.nan, math.nan, math.nan)
    force_x = _torque_forces(row, track, dt) if by_torque else unknown
    if by_motor:
        force_x = _motor_forces(row, track, dt)
    mu = as_four(np.minimum(np.maximum(friction, LOWER), UPPER)) if by_torque else unknown
    before = track.inputs_before
    use = track.inputs
    cos = as_four(track.steering_before[0])
    sin = as_four(track.steering_before[1])
    begin = WheelInputs(cos, sin, as_four(before[S.OMEGA : S.TORQUE]), force_x, mu)
    for k in range(times):
        cos = as_four(track.steering[0])
        sin = as_four(track.steering[1])
        end = WheelInputs(cos, sin, as_four(use[S.OMEGA : S.TORQUE]), force_x, mu)
        if k + 1 < times:
            end = _interpolate_inputs(track, (k + 1) / times, force_x, mu)
        drive = HeunInputs(begin, end, dt / times, by_torque)
        _apply_heun_step(body_of(row), columns, 0, ABREAST, drive)
        _apply_heun_step(body_of(row), columns, ABREAST, POINTS, drive)
        begin = end


@inlined
def _apply_heun_step(
    vehicle: Body, columns: FloatArray, first: int, last: int, drive: HeunInputs
) -> None:
    """Advance the vehicle states in the columns `first` to `last` - 1 of `columns` by one step of
    Heun's rule, in place. `drive` are the inputs at both ends of the step.

    The function is pure arithmetic, so that the compiler can process several points in parallel.
    """
    begin, end, step, by_torque = drive
    column_v = columns[0]
    column_u = columns[1]
    column_x = columns[2]
    column_y = columns[3]
    column_r = columns[4]
    column_z = columns[5]
    for p in range(first, last):
        v = column_v[p]
        u = column_u[p]
        ax = column_x[p]
        ay = column_y[p]
        r = column_r[p]
        z = column_z[p]
        one = min(max(z, LOWER), UPPER)
        mu = begin.mu if by_torque else (one, one, one, one)
        _, _, turn = planar_response(
            vehicle, PlanarMotion(v, u, r, ax, ay), _with_friction(begin, mu)
        )
        turn = z if by_torque else turn
        slope_x = ax + r * u
        slope_y = ay - r * v
        ahead = v + step * slope_x
        aside = u + step * slope_y
        rate = r + step * turn
        vx, vy = advance_velocity(v, u, ax, ay, r, step) if by_torque else (ahead, aside)
        felt_x, felt_y, next_turn = planar_response(
            vehicle, PlanarMotion(vx, vy, rate, ax, ay), _with_friction(end, mu)
        )
        if not by_torque:
            vx = v + 0.5 * step * (slope_x + felt_x + rate * aside)
            vy = u + 0.5 * step * (slope_y + felt_y - rate * ahead)
        rate = r + 0.5 * step * (turn + next_turn)
        felt_x, felt_y, next_turn = planar_response(
            vehicle, PlanarMotion(vx, vy, rate, ax, ay), _with_friction(end, mu)
        )
        column_v[p] = vx
        column_u[p] = vy
        column_x[p] = felt_x
        column_y[p] = felt_y
        column_r[p] = rate
        column_z[p] = next_turn if by_torque else z


@inlined
def _with_friction(wheels: WheelInputs, mu: Four) -> WheelInputs:
    """Return a copy of the wheel inputs `wheels` (steering, speed, force, friction) in which `mu`
    replaces the friction.
    """
    return WheelInputs(wheels.cos, wheels.sin, wheels.omega, wheels.force_x, mu)


@inlined
def _interpolate_inputs(track: InputTrack, share: float, force_x: Four, mu: Four) -> WheelInputs:
    """Return the wheel inputs at a time between the previous sample (`share` 0) and the current
    sample (`share` 1). Steering angles and wheel speeds are interpolated. The longitudinal forces
    `force_x` and the friction `mu` are copied.
    """
    before = track.inputs_before
    use = track.inputs
    keep = 1.0 - share
    delta = S.DELTA
    omega = S.OMEGA
    fl = keep * before[delta] + share * use[delta]
    fr = keep * before[delta + 1] + share * use[delta + 1]
    rl = keep * before[delta + 2] + share * use[delta + 2]
    rr = keep * before[delta + 3] + share * use[delta + 3]
    return WheelInputs(
        (math.cos(fl), math.cos(fr), math.cos(rl), math.cos(rr)),
        (math.sin(fl), math.sin(fr), math.sin(rl), math.sin(rr)),
        (
            keep * before[omega] + share * use[omega],
            keep * before[omega + 1] + share * use[omega + 1],
            keep * before[omega + 2] + share * use[omega + 2],
            keep * before[omega + 3] + share * use[omega + 3],
        ),
        force_x,
        mu,
    )


@inlined
def _motor_forces(row: FloatArray, track: InputTrack, dt: float) -> Four:
    """Return the longitudinal forces [N] of the four wheels for one motor per axle, by equations
    (4) to (6) of paper 004; `dt` [s] is the time since the last sample.
    """
    front = _half_axle_force(row, track, 0, dt)
    rear = _half_axle_force(row, track, 2, dt)
    return front, front, rear, rear


@inlined
def _half_axle_force(row: FloatArray, track: InputTrack, first: int, dt: float) -> float:
    """Return half of the longitudinal tyre force [N] of an axle with one motor; its left wheel has
    index `first`. `dt` [s] is the time since the last sample.
    """
    use = track.inputs
    before = track.inputs_before
    omega = S.OMEGA + first
    now = midpoint_speed(use[omega], use[omega + 1])
    then = midpoint_speed(before[omega], before[omega + 1])
    turning = (now - then) / dt
    turning = 0.0 if math.isnan(turning) else turning
    torque = use[S.TORQUE + first] + use[S.TORQUE + first + 1]
    return 0.5 * axle_force(torque, turning, row[Parameter.WHEEL_INERTIA], row[Parameter.RADIUS])


@inlined
def _torque_forces(row: FloatArray, track: InputTrack, dt: float) -> Four:
    """Return the longitudinal forces [N] of the four wheels, computed from the wheels' torques and
    from the change of their speeds over `dt` [s].
    """
    return (
        wheel_force(row, track, 0, dt),
        wheel_force(row, track, 1, dt),
        wheel_force(row, track, 2, dt),
        wheel_force(row, track, 3, dt),
    )
