"""The planar rigid body: accelerations that result from wheel forces.

Legend
    Fx, Fy      wheel forces in the wheel's frame [N]
    delta       road-wheel angle [rad]
    m, Iz       mass [kg], yaw inertia [kg m^2]
    (x, y)      wheel position relative to the centre of gravity [m]
    a_x, a_y    acceleration of the centre of gravity in body axes [m/s^2]; a level
                accelerometer at the centre of gravity measures these values
    r           yaw rate [rad/s]

The velocities follow from v_x' = a_x + r*v_y and v_y' = a_y - r*v_x. These are equations (2) of
paper 004 with a sign corrected (see the paper's errata).
"""

from __future__ import annotations

import math

from edge_agent.dynamics.parameters import Parameter
from edge_agent.dynamics.slip import wheel_position
from schemas.numeric import FloatArray
from schemas.runtime.jit import compiled


@compiled
def planar_accelerations(
    row: FloatArray, force_x: FloatArray, force_y: FloatArray, delta: FloatArray
) -> tuple[float, float, float]:
    """Return the accelerations (a_x, a_y [m/s^2], yaw acceleration [rad/s^2]) of the body that the
    wheel forces cause.

    The wheel forces `force_x` and `force_y` [N] and the road-wheel angles `delta` [rad] have shape
    (4,).
    """
    total_x = 0.0
    total_y = 0.0
    moment = 0.0
    for wheel in range(4):
        cos = math.cos(delta[wheel])
        sin = math.sin(delta[wheel])
        ahead = cos * force_x[wheel] - sin * force_y[wheel]
        left = sin * force_x[wheel] + cos * force_y[wheel]
        x, y = wheel_position(row, wheel)
        total_x += ahead
        total_y += left
        moment += x * left - y * ahead
    return (
        total_x / row[Parameter.MASS],
        total_y / row[Parameter.MASS],
        moment / row[Parameter.YAW_INERTIA],
    )


@compiled
def axle_lateral_forces(
    row: FloatArray, ay: float, yaw_acceleration: float, moment_x: float
) -> tuple[float, float]:
    """Return (front, rear) lateral force [N] of the axles in body axes, computed from accelerometer
    and gyroscope readings.

    moment_x [N m] is the yaw moment of the wheels' forward forces: the sum of -y*F, with lateral
    position y.
    """
    base = row[Parameter.TO_FRONT] + row[Parameter.TO_REAR]
    total = row[Parameter.MASS] * ay
    moment = row[Parameter.YAW_INERTIA] * yaw_acceleration - moment_x
    front = (row[Parameter.TO_REAR] * total + moment) / base
    return front, total - front


@compiled
def locked_axle_force(row: FloatArray, loads: FloatArray) -> float:
    """Return the lateral force [N] of the front axle that balances the yaw moment of a locked rear
    axle, per force over load of the rear wheels. The rear axle has the opposite force.

    Both rear wheels turn at the same speed. In a turn the inner one therefore slips forwards and
    the outer one backwards, and their forces turn the car back. `loads` (4,) are wheel loads [N].
    """
    base = row[Parameter.TO_FRONT] + row[Parameter.TO_REAR]
    return float(0.5 * row[Parameter.TRACK_REAR] * (loads[2] + loads[3]) / base)


@compiled
def advance_velocity(
    vx: float, vy: float, ax: float, ay: float, yaw_rate: float, step: float
) -> tuple[float, float]:
    """Return (v_x, v_y) [m/s] after `step` [s] in which accelerations a_x, a_y and yaw rate r are
    constant.

    The solution is exact. In a filter that uses Euler's rule instead, the error of v_y is four
    times as large.
    """
    angle = yaw_rate * step
    cos = math.cos(angle)
    sin = math.sin(angle)
    if abs(angle) < 1e-6:
        along = step
        across = 0.5 * angle * step
    else:
        along = sin / yaw_rate
        across = (1.0 - cos) / yaw_rate
    return (
        cos * vx + sin * vy + along * ax + across * ay,
        cos * vy - sin * vx + along * ay - across * ax,
    )
