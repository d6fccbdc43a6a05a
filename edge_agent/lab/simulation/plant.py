"""The vehicle that is driven: a planar body on four wheels with Magic Formula tyres.

It shares its equations with `edge_agent.dynamics` but is not the estimator's model: its tyres have another shape, their
stiffness grows less than the load, its loads follow the accelerations with a lag, it rolls, drags and resists rolling.

    m (dv_x/dt − r v_y) = ΣX − D v_x|v_x| + m g_x    v_x, v_y  speed of the centre of gravity in the body [m/s]
    m (dv_y/dt + r v_x) = ΣY + m g_y             r         yaw rate [rad/s]
    I_z dr/dt = Σ (x_i Y_i − y_i X_i)            X, Y      wheel forces in the body's axes [N]
    J dω/dt = T − R F_x − k_r R F_z              ω, T      wheel speed [rad/s], torque at the wheel [N·m]

    θ = K s / (μ F_z),  F = μ F_z f(|θ|) θ/|θ|   s         slip (longitudinal, lateral), K its stiffness
    K = κ F_z (1 − ε (F_z/F_0 − 1))              F_0       static load, ε how degressive the tyre is

    g_x, g_y = −g (h_x, h_y)/√(1 + h_x² + h_y²)  h_x, h_y  rise of the road per metre ahead and to the left

An accelerometer feels all forces but gravity: (dv_x/dt − r v_y − g_x), so g sin(slope) where the vehicle stands. The
load that is transferred goes by what is felt, and the loads add up to the weight's part that is normal to the road.

K does not know μ, unless the tyre softens: friction acts by similarity (Pacejka, Tyre and Vehicle Dynamics, 3rd ed.,
§4.2), and |F| ≤ μ F_z.

Explicit Euler for the body and linearly implicit Euler for the wheels, whose slip is stiff: with the secant slope of
the tyre in the denominator a wheel step is stable at any speed. The tyre's force is taken at the step's end, where the
ground has changed its speed too; without that term a wheel would seem to have twice its inertia.
Wheel order fl, fr, rl, rr; ISO 8855 signs.
"""

from __future__ import annotations

import math
from enum import IntEnum
from typing import Final

from edge_agent.dynamics.body import accelerations
from edge_agent.dynamics.loads import wheel_loads
from edge_agent.dynamics.parameters import Parameter, body
from edge_agent.dynamics.slip import SLOWEST_M_S, slips, wheel_position, wheel_velocity
from edge_agent.dynamics.tyres import TINY, brush, magic_formula
from schemas.numeric import FloatArray
from schemas.runtime.jit import compiled
from schemas.thresholds import GRAVITY

LONGEST_SUBSTEP: Final = 1e-3  # [s]; lateral dynamics at 1 m/s have poles near 150/s
SOFTEST: Final = 0.3  # stiffness never degrades below this share of proportional, however overloaded the wheel
REAR_LIMIT: Final = 0.5  # slip control lets go of the rear wheels at this share of the limit, so that they still guide
FIRM: Final = 1.0  # friction at which a softening tyre has its full stiffness
STANDING: Final = 1.0  # [rad/s] below it rolling resistance fades
BRAKED: Final = 0.1  # [rad/s] below it a brake does, so that it holds a wheel and does not turn it backwards
STILL: Final = 0.02  # [m/s, rad/s] slower than this in every direction, brakes hold the vehicle where it is


class Motion(IntEnum):
    """State of one vehicle."""

    VX = 0  # [m/s]
    VY = 1
    YAW_RATE = 2  # [rad/s]
    OMEGA = 3  # four wheels [rad/s]
    AX_LAGGED = 7  # [m/s^2], what the suspension has followed so far
    AY_LAGGED = 8
    X = 9  # [m] east
    Y = 10  # [m] north
    YAW = 11  # [rad], not wrapped


STATES: Final = 12


class TrueParameter(IntEnum):
    """What only the true vehicle has; these continue the row of `edge_agent.dynamics.parameters.P`."""

    SHAPE = len(Parameter)  # c and e of the tyre curve
    CURVATURE = len(Parameter) + 1
    DEGRESSION = len(Parameter) + 2  # ε
    LAG = len(Parameter) + 3  # [s] of the sprung body behind the accelerations
    ROLL_LEAK = (
        len(Parameter) + 4
    )  # gravity that an accelerometer feels in the rolled and pitched body, per a_y and per a_x
    PITCH_LEAK = len(Parameter) + 5
    DRAG = len(Parameter) + 6  # D [N per (m/s)^2]
    ROLLING = len(Parameter) + 7  # k_r
    SLIP_LIMIT = len(Parameter) + 8  # slip at which anti-lock and traction control begin to let go; inf: none
    BRAKE_FRONT = len(Parameter) + 9  # share of the braking torque at the front axle
    POWER = len(Parameter) + 10  # [W]
    BRUSH = len(Parameter) + 11  # 1: the tyre's curve is that of the brush model, not the Magic Formula
    SOFTENING = (
        len(Parameter) + 12
    )  # stiffness falls with friction, as (mu/FIRM)^softening; 0: it does not know friction
    REAR_STEER = len(Parameter) + 13  # angle of the rear wheels over that of the front wheels; 0: they do not steer


PARAMETERS: Final = len(Parameter) + len(TrueParameter)


class Control(IntEnum):
    """Rows of what is done to the four wheels, and of the road under the vehicle, shape (5, 4)."""

    STEER = 0  # [rad at the road wheel]
    DRIVE = 1  # [N·m] asked for; slip control may allow less
    BRAKE = 2  # [N·m], positive, asked for
    MU = 3  # friction under the wheel
    TILT = 4  # rise of the road per metre ahead of the vehicle, and to its left; two numbers are of no use


INPUTS: Final = len(Control)


class Wheel(IntEnum):
    """Rows of what the four wheels do at an instant, shape (8, 4)."""

    FX = 0  # [N] in the wheel's axes
    FY = 1
    FZ = 2
    SPEED = 3  # [m/s] of the wheel's centre along the wheel
    SLIP = 4  # longitudinal
    THETA = 5  # normalised slip; beyond about 2 the wheel slides
    SLOPE = 6  # dF_x/dω along the secant [N·s/rad]
    TORQUE = 7  # [N·m] that acts, driving positive


@compiled
def gravity(u: FloatArray) -> tuple[float, float, float]:
    """(g_x, g_y) in the body's axes [m/s^2], and the share of gravity that presses on the road."""
    ahead, left = u[Control.TILT, 0], u[Control.TILT, 1]
    share = 1.0 / math.sqrt(1.0 + ahead * ahead + left * left)
    return -GRAVITY * ahead * share, -GRAVITY * left * share, share


@compiled
def stiffness_per_load(slope: float, degression: float, load: float, at_rest: float) -> float:
    """K/F_z of a wheel under `load` [N] that carries `at_rest` [N] when standing."""
    return slope * max(1.0 - degression * (load / at_rest - 1.0), SOFTEST)


@compiled
def allowed(slip: float, limit: float) -> float:
    """Share of the torque that slip control lets through: all up to `limit`, nothing from twice the limit."""
    return min(max(2.0 - abs(slip) / limit, 0.0), 1.0)


@compiled
def slip_limit(p: FloatArray, i: int) -> float:
    """Slip at which the control of wheel `i` begins to let go."""
    return float(p[TrueParameter.SLIP_LIMIT] if i < 2 else REAR_LIMIT * p[TrueParameter.SLIP_LIMIT])


@compiled
def wheel_forces(x: FloatArray, p: FloatArray, u: FloatArray, w: FloatArray) -> None:
    """Fill `w` (8, 4) for the state `x` (12,), parameters `p` (26,) and inputs `u` (5, 4)."""
    loads = wheel_loads(body(p), x[Motion.AX_LAGGED], x[Motion.AY_LAGGED])
    at_rest = wheel_loads(body(p), 0.0, 0.0)
    _, _, share = gravity(u)
    for i in range(4):
        load, omega = share * loads[i], x[Motion.OMEGA + i]
        along, across = wheel_velocity(p, i, x[Motion.VX], x[Motion.VY], x[Motion.YAW_RATE], u[Control.STEER, i])
        slip_x, slip_y = slips(p[Parameter.RADIUS], omega, along, across)
        slope_x = stiffness_per_load(p[Parameter.SLOPE_X], p[TrueParameter.DEGRESSION], load, at_rest[i])
        slope_y = stiffness_per_load(p[Parameter.SLOPE_Y], p[TrueParameter.DEGRESSION], load, at_rest[i])
        if p[TrueParameter.SOFTENING] > 0.0:
            soft = (u[Control.MU, i] / FIRM) ** p[TrueParameter.SOFTENING]
            slope_x, slope_y = soft * slope_x, soft * slope_y
        theta_x, theta_y = slope_x * slip_x / u[Control.MU, i], slope_y * slip_y / u[Control.MU, i]
        theta = math.hypot(theta_x, theta_y)
        curve = (
            brush(theta)
            if p[TrueParameter.BRUSH] > 0.0
            else magic_formula(theta, p[TrueParameter.SHAPE], p[TrueParameter.CURVATURE])
        )
        secant = curve / theta if theta > TINY else 1.0
        pull = secant * u[Control.MU, i] * load
        drive, brake = u[Control.DRIVE, i], u[Control.BRAKE, i]
        if slip_x > 0.0:
            drive *= allowed(slip_x, slip_limit(p, i))
        else:
            brake *= allowed(slip_x, slip_limit(p, i))
        w[Wheel.FX, i], w[Wheel.FY, i], w[Wheel.FZ, i] = pull * theta_x, pull * theta_y, load
        w[Wheel.SPEED, i], w[Wheel.SLIP, i], w[Wheel.THETA, i] = along, slip_x, theta
        w[Wheel.SLOPE, i] = secant * slope_x * load * p[Parameter.RADIUS] / max(abs(along), SLOWEST_M_S)
        w[Wheel.TORQUE, i] = drive - brake * omega / max(abs(omega), BRAKED)


@compiled
def body_accelerations(x: FloatArray, p: FloatArray, u: FloatArray, w: FloatArray) -> tuple[float, float, float]:
    """(a_x, a_y) that an accelerometer at the centre of gravity feels [m/s^2], and the yaw acceleration [rad/s^2].

    `w` is filled.
    """
    ax, ay, yaw_acceleration = accelerations(p, w[Wheel.FX], w[Wheel.FY], u[Control.STEER])
    return ax - p[TrueParameter.DRAG] * x[Motion.VX] * abs(x[Motion.VX]) / p[Parameter.MASS], ay, yaw_acceleration


@compiled
def turn_wheels(
    x: FloatArray, p: FloatArray, u: FloatArray, w: FloatArray, dt: float, gain: float, yaw_acceleration: float
) -> None:
    """One linearly implicit Euler step of the wheel speeds in `x`: every torque that falls with ω damps it.

    gain is dv_x/dt [m/s^2], yaw_acceleration in rad/s^2: how the ground's speed changes under the wheels.
    """
    radius = p[Parameter.RADIUS]
    for i in range(4):
        ground = gain - wheel_position(p, i)[1] * yaw_acceleration
        omega, slip = x[Motion.OMEGA + i], abs(w[Wheel.SLIP, i])
        slow = max(abs(omega), STANDING)
        resistance = p[TrueParameter.ROLLING] * radius * w[Wheel.FZ, i] * omega / slow
        excess = w[Wheel.TORQUE, i] - resistance - radius * w[Wheel.FX, i] + dt * w[Wheel.SLOPE, i] * ground
        damping = radius * w[Wheel.SLOPE, i]
        if slip_limit(p, i) < slip < 2.0 * slip_limit(p, i):
            asked = u[Control.DRIVE, i] if w[Wheel.SLIP, i] > 0.0 else u[Control.BRAKE, i]
            damping += asked * radius / (max(abs(w[Wheel.SPEED, i]), SLOWEST_M_S) * slip_limit(p, i))
        if abs(omega) < BRAKED:
            damping += u[Control.BRAKE, i] / BRAKED
        x[Motion.OMEGA + i] = omega + dt * excess / (p[Parameter.WHEEL_INERTIA] + dt * damping)


@compiled
def held(x: FloatArray, p: FloatArray, u: FloatArray) -> bool:
    """Whether the brakes hold a vehicle that stands: they are stronger than engine and slope, and so are the tyres."""
    if abs(x[Motion.VX]) > STILL or abs(x[Motion.VY]) > STILL or abs(x[Motion.YAW_RATE]) > STILL:
        return False
    along, across, share = gravity(u)
    brake = pull = grip = 0.0
    for i in range(4):
        brake += u[Control.BRAKE, i] / p[Parameter.RADIUS]
        pull += u[Control.DRIVE, i] / p[Parameter.RADIUS]
        grip += 0.25 * u[Control.MU, i] * p[Parameter.MASS] * GRAVITY * share
    pull += p[Parameter.MASS] * along
    return bool(brake > 0.0 and abs(pull) <= brake and math.hypot(pull, p[Parameter.MASS] * across) <= grip)


@compiled
def stand(x: FloatArray, p: FloatArray, u: FloatArray, dt: float) -> None:
    """One step of a vehicle that is `held`: only the suspension still moves, to where the slope wants it."""
    along, across, _ = gravity(u)
    x[Motion.VX] = x[Motion.VY] = x[Motion.YAW_RATE] = 0.0
    x[Motion.OMEGA : Motion.OMEGA + 4] = 0.0
    follow = min(dt / p[TrueParameter.LAG], 1.0)
    x[Motion.AX_LAGGED] += follow * (-along - x[Motion.AX_LAGGED])
    x[Motion.AY_LAGGED] += follow * (-across - x[Motion.AY_LAGGED])


@compiled
def advance(x: FloatArray, p: FloatArray, u: FloatArray, w: FloatArray, dt: float, substeps: int) -> None:
    """Move the state `x` on by `substeps` steps of `dt` [s] with the inputs `u` held; `w` is scratch."""
    along, across, _ = gravity(u)
    for _ in range(substeps):
        if held(x, p, u):
            stand(x, p, u, dt)
            continue
        wheel_forces(x, p, u, w)
        ax, ay, yaw_acceleration = body_accelerations(x, p, u, w)
        vx, vy, r = x[Motion.VX], x[Motion.VY], x[Motion.YAW_RATE]
        turn_wheels(x, p, u, w, dt, ax + r * vy + along, yaw_acceleration)
        c, s = math.cos(x[Motion.YAW] + 0.5 * dt * r), math.sin(x[Motion.YAW] + 0.5 * dt * r)
        x[Motion.X] += dt * (c * vx - s * vy)
        x[Motion.Y] += dt * (s * vx + c * vy)
        x[Motion.YAW] += dt * r
        x[Motion.VX] += dt * (ax + r * vy + along)
        x[Motion.VY] += dt * (ay - r * vx + across)
        x[Motion.YAW_RATE] += dt * yaw_acceleration
        follow = min(dt / p[TrueParameter.LAG], 1.0)
        x[Motion.AX_LAGGED] += follow * (ax - x[Motion.AX_LAGGED])
        x[Motion.AY_LAGGED] += follow * (ay - x[Motion.AY_LAGGED])


@compiled
def command(p: FloatArray, u: FloatArray, steer: float, force: float) -> None:
    """Fill STEER, DRIVE and BRAKE of `u` from a mean road-wheel angle [rad] and a longitudinal force [N].

    The steered wheels follow Ackermann: they point at one centre on the line of the rear axle. Where the rear wheels
    steer too, `steer` is the angle of a car without that on the same circle: the front wheels turn more, or less.
    """
    base = p[Parameter.TO_FRONT] + p[Parameter.TO_REAR]
    curvature = math.tan(steer) / base
    front = base * curvature / (1.0 - p[TrueParameter.REAR_STEER])
    for i in range(4):
        side = 1.0 if i % 2 == 0 else -1.0
        inner = 1.0 - side * 0.5 * p[Parameter.TRACK_FRONT] * curvature
        u[Control.STEER, i] = (
            math.atan(front / inner) if i < 2 else p[TrueParameter.REAR_STEER] * math.atan(front / inner)
        )
        drive_share = p[Parameter.DRIVE_FRONT] if i < 2 else 1.0 - p[Parameter.DRIVE_FRONT]
        brake_share = p[TrueParameter.BRAKE_FRONT] if i < 2 else 1.0 - p[TrueParameter.BRAKE_FRONT]
        u[Control.DRIVE, i] = 0.5 * drive_share * max(force, 0.0) * p[Parameter.RADIUS]
        u[Control.BRAKE, i] = 0.5 * brake_share * max(-force, 0.0) * p[Parameter.RADIUS]


class RecordColumn(IntEnum):
    """Columns of a record: the truth of one sample of one vehicle."""

    AX = 0  # [m/s^2] that an accelerometer at the centre of gravity feels, as the road lies
    AY = 1
    AX_FELT = 2  # [m/s^2] by an accelerometer fixed to the rolling and pitching body
    AY_FELT = 3
    YAW_RATE = 4
    DELTA = 5  # four wheels each, from here on
    OMEGA = 9
    TORQUE = 13
    X = 17
    Y = 18
    YAW = 19
    VX = 20
    VY = 21
    MU = 22
    UTILISATION = 26  # |F| / (μ F_z)
    SLOPE = 30  # rise of the road per metre ahead
    BANK = 31  # and to the left
    THETA = 32  # four wheels: normalised slip; beyond about 2.6 a wheel slides


RECORD: Final = 36


@compiled
def observe(x: FloatArray, p: FloatArray, u: FloatArray, w: FloatArray, record: FloatArray) -> None:
    """Fill `record` (RECORD,) with what is true at this instant under the inputs `u`; fills `w` too."""
    wheel_forces(x, p, u, w)
    ax, ay, _ = body_accelerations(x, p, u, w)
    record[RecordColumn.AX], record[RecordColumn.AY] = ax, ay
    record[RecordColumn.AX_FELT] = ax + p[TrueParameter.PITCH_LEAK] * x[Motion.AX_LAGGED]
    record[RecordColumn.AY_FELT] = ay + p[TrueParameter.ROLL_LEAK] * x[Motion.AY_LAGGED]
    record[RecordColumn.YAW_RATE], record[RecordColumn.VX], record[RecordColumn.VY] = (
        x[Motion.YAW_RATE],
        x[Motion.VX],
        x[Motion.VY],
    )
    record[RecordColumn.X], record[RecordColumn.Y], record[RecordColumn.YAW] = x[Motion.X], x[Motion.Y], x[Motion.YAW]
    for i in range(4):
        record[RecordColumn.DELTA + i], record[RecordColumn.OMEGA + i], record[RecordColumn.TORQUE + i] = (
            u[Control.STEER, i],
            x[Motion.OMEGA + i],
            w[Wheel.TORQUE, i],
        )
        record[RecordColumn.MU + i] = u[Control.MU, i]
        record[RecordColumn.UTILISATION + i] = math.hypot(w[Wheel.FX, i], w[Wheel.FY, i]) / (
            u[Control.MU, i] * w[Wheel.FZ, i]
        )
        record[RecordColumn.THETA + i] = w[Wheel.THETA, i]
    record[RecordColumn.SLOPE], record[RecordColumn.BANK] = u[Control.TILT, 0], u[Control.TILT, 1]
    if held(x, p, u):
        _observe_held(x, p, u, record)


@compiled
def _observe_held(x: FloatArray, p: FloatArray, u: FloatArray, record: FloatArray) -> None:
    """What is true of a vehicle that is held: brakes and tyres give what the slope asks for."""
    along, across, share = gravity(u)
    record[RecordColumn.AX], record[RecordColumn.AY] = -along, -across
    record[RecordColumn.AX_FELT] = -along + p[TrueParameter.PITCH_LEAK] * x[Motion.AX_LAGGED]
    record[RecordColumn.AY_FELT] = -across + p[TrueParameter.ROLL_LEAK] * x[Motion.AY_LAGGED]
    record[RecordColumn.YAW_RATE] = record[RecordColumn.VX] = record[RecordColumn.VY] = 0.0
    for i in range(4):
        brake_share = p[TrueParameter.BRAKE_FRONT] if i < 2 else 1.0 - p[TrueParameter.BRAKE_FRONT]
        record[RecordColumn.OMEGA + i] = 0.0
        record[RecordColumn.THETA + i] = 0.0
        record[RecordColumn.TORQUE + i] = -0.5 * brake_share * p[Parameter.MASS] * along * p[Parameter.RADIUS]
        record[RecordColumn.UTILISATION + i] = math.hypot(along, across) / (u[Control.MU, i] * GRAVITY * share)


@compiled
def start_at(x: FloatArray, p: FloatArray, place: tuple[float, float, float], speed: float) -> None:
    """Set the state `x` to rolling straight on at `speed` [m/s] from place (x [m], y [m], yaw [rad])."""
    x[:] = 0.0
    x[Motion.VX] = speed
    x[Motion.X], x[Motion.Y], x[Motion.YAW] = place
    x[Motion.OMEGA : Motion.OMEGA + 4] = speed / p[Parameter.RADIUS]


def substeps_of(rate_hz: float) -> int:
    """How many equal plant steps of at most LONGEST_SUBSTEP make one sample."""
    return max(1, math.ceil(round(1.0 / (rate_hz * LONGEST_SUBSTEP), 9)))


@compiled
def wheel_place(x: FloatArray, p: FloatArray, i: int) -> tuple[float, float]:
    """Where wheel `i` stands on the ground, (x, y) [m]."""
    ahead, left = wheel_position(p, i)
    c, s = math.cos(x[Motion.YAW]), math.sin(x[Motion.YAW])
    return x[Motion.X] + c * ahead - s * left, x[Motion.Y] + s * ahead + c * left


@compiled
def strongest_pull(p: FloatArray, vx: float) -> float:
    """Largest driving force of the engine [N]: its power, and below 5 m/s the gearbox."""
    return float(p[TrueParameter.POWER] / max(vx, 5.0))
