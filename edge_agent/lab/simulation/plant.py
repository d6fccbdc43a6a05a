"""The simulated vehicle ("plant"): a planar body on four wheels with Magic Formula tyres.

It shares equations with `edge_agent.dynamics`, but it is not the estimator's model. Its tyre curve
has another shape, and tyre stiffness grows less than the load. The wheel loads follow the
accelerations with a lag, the body rolls, and there are air drag and rolling resistance.

    m (dv_x/dt − r v_y) = ΣX − D v_x|v_x| + m g_x
    m (dv_y/dt + r v_x) = ΣY + m g_y
    I_z dr/dt = Σ (x_i Y_i − y_i X_i)
    J dω/dt = T − R F_x − k_r R F_z

    v_x, v_y   velocity of the centre of gravity in the body's axes [m/s]
    r          yaw rate [rad/s]
    m, I_z     mass [kg], yaw inertia [kg·m^2]
    D          air drag over squared speed [kg/m]
    X, Y       wheel forces in the body's axes [N]
    x_i, y_i   position of wheel i ahead and to the left of the centre of gravity [m]
    ω, T       wheel speed [rad/s], torque at the wheel [N·m]
    J, R       inertia [kg·m^2] and radius [m] of a wheel
    F_x, F_z   longitudinal force in the wheel's axes, wheel load [N]
    k_r        rolling resistance over load [1]

    θ = K s / (μ F_z),  F = μ F_z f(|θ|) θ/|θ|   s    slip (longitudinal, lateral), K its stiffness
    K = κ F_z (1 − ε (F_z/F_0 − 1))              F_0  static load, ε degression of the stiffness
                                                 κ    stiffness over load at the static load [1]
                                                 θ    slip normalised by stiffness and grip
                                                 f    tyre curve: used share of the grip μ F_z

    g_x, g_y = −g (h_x, h_y)/√(1 + h_x² + h_y²)  h_x, h_y  rise of the road per metre ahead and to
                                                           the left

An accelerometer measures the effect of all forces except gravity: (dv_x/dt − r v_y − g_x). Its
reading is therefore g sin(slope) where the vehicle stands. The load transfer follows the measured
acceleration, and the sum of the loads is the part of the weight normal to the road.

By default the slip stiffness K does not depend on μ: friction scales both axes of the force curve
(similarity method, Pacejka, Tyre and Vehicle Dynamics, 3rd ed., §4.2), and |F| ≤ μ F_z. With an
option of the vehicle, K grows with μ.

A vehicle may have tyres with a relaxation length (RELAXATION: four fifths of the slip build up over
that length), and controllers that work in cycles and report their activity (ABS_HZ:
`controllers.py`). Without controllers, the drive or brake torque of a wheel decreases smoothly
where its slip exceeds a limit.

Integration: explicit Euler for the body, and linearly implicit Euler for the wheels, because their
slip is stiff. The denominator of a wheel's step contains the secant slope of the tyre, so the step
is stable at any speed. During a step the vehicle's speed changes too, and with it the slip of the
wheels. The wheels' step includes this change. Without it, wheels would accelerate as slowly as
wheels with twice the inertia. Wheel order fl, fr, rl, rr; ISO 8855 signs.
"""

from __future__ import annotations

import math
from typing import Final

from edge_agent.dynamics.body import planar_accelerations
from edge_agent.dynamics.loads import wheel_loads
from edge_agent.dynamics.parameters import Parameter, body_of
from edge_agent.dynamics.slip import SLOWEST_M_S, wheel_position, wheel_slips, wheel_velocity
from edge_agent.dynamics.tyres import TINY, brush, dugoff, magic_formula
from edge_agent.lab.simulation.controllers import control_slip, slip_limit
from edge_agent.lab.simulation.state import STATES, Control, Motion, TrueParameter, Wheel
from edge_agent.lab.simulation.unevenness import radius_change
from schemas.numeric import FloatArray
from schemas.runtime.jit import compiled
from schemas.thresholds import GRAVITY

# [s] longest integration step; lateral dynamics at 1 m/s have poles near 150/s.
LONGEST_SUBSTEP: Final = 1e-3
# Minimum ratio of the stiffness to one proportional to the load, even at high overload.
SOFTEST: Final = 0.3
FIRM: Final = 1.0  # friction at which a tyre with softening has its full stiffness
STANDING: Final = 1.0  # [rad/s] wheel speed below which rolling resistance decreases to zero
DIRECT: Final = 0.2  # share of the slip that acts without the delay by relaxation
# [m/s] Speed of the driven wheels above that of the car at which the engine begins to give less,
# and at which it gives nothing.
FREE_SPIN: Final = (
    6.0,
    12.0,
)
# [rad/s] wheel speed below which the brake torque decreases, so that a brake holds a wheel and does
# not turn it backwards.
BRAKED: Final = 0.1
# [m/s, rad/s] speeds and yaw rate below which the brakes hold the vehicle in place.
STILL: Final = 0.02


@compiled
def gravity(u: FloatArray) -> tuple[float, float, float]:
    """Return (g_x, g_y, share): the components of gravity along the body's axes [m/s^2] on the
    slope in the inputs `u`, and the share of gravity that acts normal to the road.
    """
    ahead = u[Control.TILT, 0]
    left = u[Control.TILT, 1]
    share = 1.0 / math.sqrt(1.0 + ahead * ahead + left * left)
    return -GRAVITY * ahead * share, -GRAVITY * left * share, share


@compiled
def stiffness_per_load(slope: float, degression: float, load: float, at_rest: float) -> float:
    """Return the slip stiffness over load, K/F_z [1], of a wheel under `load` [N] whose static load
    is `at_rest` [N]. `slope` [1] is this ratio at the static load, and `degression` [1] its
    relative decrease if the load doubles.
    """
    return slope * max(1.0 - degression * (load / at_rest - 1.0), SOFTEST)


@compiled
def allowed_share(slip: float, limit: float) -> float:
    """Return the share of the demanded torque that smooth slip control allows at a wheel: 1 up to
    the slip `limit`, decreasing to 0 at twice this limit.
    """
    return min(max(2.0 - abs(slip) / limit, 0.0), 1.0)


@compiled
def wheel_torques(
    x: FloatArray, p: FloatArray, u: FloatArray, i: int, slip: float
) -> tuple[float, float]:
    """Return the driving and the braking torque [N·m] at wheel `i` of a vehicle with state `x`,
    parameters `p` and inputs `u`, after the controllers have responded to its slip.
    """
    drive = u[Control.DRIVE, i]
    brake = u[Control.BRAKE, i]
    if p[TrueParameter.ABS_HZ] > 0.0:
        drive *= 1.0 - x[Motion.CUT]
        brake += x[Motion.HELD + i]
        if x[Motion.LIMIT + i] > 0.0:
            brake = min(brake, x[Motion.LIMIT + i])
        if drive > 0.0 and p[TrueParameter.TCS] <= 0.0:
            faster = p[Parameter.RADIUS] * x[Motion.OMEGA + i] - abs(x[Motion.VX])
            drive *= min(max((FREE_SPIN[1] - faster) / (FREE_SPIN[1] - FREE_SPIN[0]), 0.0), 1.0)
    elif slip > 0.0:
        drive *= allowed_share(slip, slip_limit(p, i))
    else:
        brake *= allowed_share(slip, slip_limit(p, i))
    if drive < 0.0:
        drive *= min(max(x[Motion.OMEGA + i] / STANDING, 0.0), 1.0)
    return drive, brake


@compiled
def rolling_radius(p: FloatArray, u: FloatArray, i: int) -> float:
    """Return the rolling radius [m] of wheel `i` of a vehicle with parameters `p` and inputs `u`.
    It varies on uneven roads.
    """
    return float(p[Parameter.RADIUS] + radius_change(u[Control.SWING, i]))


@compiled
def relax_slip(x: FloatArray, p: FloatArray, u: FloatArray, dt: float) -> None:
    """Advance the delayed part of the tyres' slip in the vehicle's state `x` by `dt` [s]: over the
    relaxation length, it approaches the slip of the wheels. The wheel speeds in `x` must already
    have been updated.
    """
    for i in range(4):
        along, across = wheel_velocity(
            p, i, x[Motion.VX], x[Motion.VY], x[Motion.YAW_RATE], u[Control.STEER, i]
        )
        radius = rolling_radius(p, u, i)
        slip_x, slip_y = wheel_slips(radius, x[Motion.OMEGA + i], along, across)
        rolled = max(abs(along), abs(radius * x[Motion.OMEGA + i]), SLOWEST_M_S)
        share = -math.expm1(-dt * rolled / p[TrueParameter.RELAXATION])
        x[Motion.SLIP_X + i] += share * (slip_x - x[Motion.SLIP_X + i])
        x[Motion.SLIP_Y + i] += share * (slip_y - x[Motion.SLIP_Y + i])


@compiled
def wheel_forces(x: FloatArray, p: FloatArray, u: FloatArray, wheels: FloatArray) -> None:
    """Write loads, forces, slips and torques of the wheels to `wheels` (8, 4), for the state `x`,
    parameters `p` and inputs `u` (6, 4).
    """
    loads = wheel_loads(body_of(p), x[Motion.AX_LAGGED], x[Motion.AY_LAGGED])
    at_rest = wheel_loads(body_of(p), 0.0, 0.0)
    _, _, share = gravity(u)
    for i in range(4):
        load = share * loads[i] * (1.0 + u[Control.SWING, i])
        radius = rolling_radius(p, u, i)
        omega = x[Motion.OMEGA + i]
        along, across = wheel_velocity(
            p, i, x[Motion.VX], x[Motion.VY], x[Motion.YAW_RATE], u[Control.STEER, i]
        )
        slip_x, slip_y = wheel_slips(radius, omega, along, across)
        raw_slip = slip_x
        if p[TrueParameter.RELAXATION] > 0.0:
            slip_x = DIRECT * slip_x + (1.0 - DIRECT) * x[Motion.SLIP_X + i]
            slip_y = DIRECT * slip_y + (1.0 - DIRECT) * x[Motion.SLIP_Y + i]
        slope_x = stiffness_per_load(
            p[Parameter.SLOPE_X], p[TrueParameter.DEGRESSION], load, at_rest[i]
        )
        slope_y = stiffness_per_load(
            p[Parameter.SLOPE_Y], p[TrueParameter.DEGRESSION], load, at_rest[i]
        )
        if i >= 2:
            slope_y *= p[Parameter.REAR_SLOPE]
        if p[TrueParameter.SOFTENING] > 0.0:
            soft = (u[Control.MU, i] / FIRM) ** p[TrueParameter.SOFTENING]
            slope_x = soft * slope_x
            slope_y = soft * slope_y
        theta_x = slope_x * slip_x / u[Control.MU, i]
        theta_y = slope_y * slip_y / u[Control.MU, i]
        theta = math.hypot(theta_x, theta_y)
        if p[TrueParameter.CURVE] == 0.0:
            curve = magic_formula(theta, p[TrueParameter.SHAPE], p[TrueParameter.CURVATURE])
        elif p[TrueParameter.CURVE] == 1.0:
            curve = brush(theta)
        else:
            curve = dugoff(theta)
        secant = curve / theta if theta > TINY else 1.0
        pull = secant * u[Control.MU, i] * load
        drive, brake = wheel_torques(x, p, u, i, raw_slip)
        wheels[Wheel.FX, i] = pull * theta_x
        wheels[Wheel.FY, i] = pull * theta_y
        wheels[Wheel.FZ, i] = load
        wheels[Wheel.SPEED, i] = along
        wheels[Wheel.SLIP, i] = raw_slip
        wheels[Wheel.THETA, i] = theta
        wheels[Wheel.SLOPE, i] = secant * slope_x * load * radius / max(abs(along), SLOWEST_M_S)
        if p[TrueParameter.RELAXATION] > 0.0:
            wheels[Wheel.SLOPE, i] *= DIRECT
        wheels[Wheel.TORQUE, i] = drive - brake * omega / max(abs(omega), BRAKED)


@compiled
def body_accelerations(
    x: FloatArray, p: FloatArray, u: FloatArray, wheels: FloatArray
) -> tuple[float, float, float]:
    """Return (a_x, a_y) that an accelerometer at the centre of gravity measures [m/s^2], and the
    yaw acceleration [rad/s^2].

    `x`, `p` and `u` are state, parameters and inputs of the vehicle. `wheels` (8, 4) is the array
    of wheel data that `wheel_forces` has filled for this state.
    """
    ax, ay, yaw_acceleration = planar_accelerations(
        p, wheels[Wheel.FX], wheels[Wheel.FY], u[Control.STEER]
    )
    return (
        ax - p[TrueParameter.DRAG] * x[Motion.VX] * abs(x[Motion.VX]) / p[Parameter.MASS],
        ay,
        yaw_acceleration,
    )


@compiled
def turn_wheels(
    x: FloatArray,
    p: FloatArray,
    u: FloatArray,
    wheels: FloatArray,
    dt: float,
    change: tuple[float, float],
) -> None:
    """Advance the wheel speeds ω in the vehicle's state `x` by one linearly implicit Euler step of
    `dt` [s]. Torques that decrease with ω are in the implicit part of the step, so that the step is
    stable. The wheels of a locked rear axle turn as one.

    `change` contains dv_x/dt [m/s^2] and the yaw acceleration [rad/s^2]. The function computes from
    it how much each wheel's speed over the ground changes. `wheels` (8, 4) is the array of wheel
    data that `wheel_forces` has filled for this state.
    """
    gain, yaw_acceleration = change
    for i in range(4):
        radius = rolling_radius(p, u, i)
        ground = gain - wheel_position(p, i)[1] * yaw_acceleration
        omega = x[Motion.OMEGA + i]
        slip = abs(wheels[Wheel.SLIP, i])
        slow = max(abs(omega), STANDING)
        resistance = p[TrueParameter.ROLLING] * radius * wheels[Wheel.FZ, i] * omega / slow
        excess = (
            wheels[Wheel.TORQUE, i]
            - resistance
            - radius * wheels[Wheel.FX, i]
            + dt * wheels[Wheel.SLOPE, i] * ground
        )
        damping = radius * wheels[Wheel.SLOPE, i]
        smooth = p[TrueParameter.ABS_HZ] <= 0.0
        if smooth and slip_limit(p, i) < slip < 2.0 * slip_limit(p, i):
            demanded_torque = (
                u[Control.DRIVE, i] if wheels[Wheel.SLIP, i] > 0.0 else u[Control.BRAKE, i]
            )
            damping += (
                demanded_torque
                * radius
                / (max(abs(wheels[Wheel.SPEED, i]), SLOWEST_M_S) * slip_limit(p, i))
            )
        if abs(omega) < BRAKED:
            damping += u[Control.BRAKE, i] / BRAKED
        x[Motion.OMEGA + i] = omega + dt * excess / (p[Parameter.WHEEL_INERTIA] + dt * damping)
    if p[Parameter.REAR_LOCKED] > 0.0:
        mean = 0.5 * (x[Motion.OMEGA + 2] + x[Motion.OMEGA + 3])
        x[Motion.OMEGA + 2] = mean
        x[Motion.OMEGA + 3] = mean


@compiled
def is_held(x: FloatArray, p: FloatArray, u: FloatArray) -> bool:
    """Return True if a vehicle with state `x`, parameters `p` and inputs `u` stands and is held by
    its brakes: brakes and tyres can hold more force than engine and slope exert.
    """
    if abs(x[Motion.VX]) > STILL or abs(x[Motion.VY]) > STILL or abs(x[Motion.YAW_RATE]) > STILL:
        return False
    along, across, share = gravity(u)
    brake = 0.0
    pull = 0.0
    grip = 0.0
    for i in range(4):
        brake += u[Control.BRAKE, i] / p[Parameter.RADIUS]
        pull += u[Control.DRIVE, i] / p[Parameter.RADIUS]
        grip += 0.25 * u[Control.MU, i] * p[Parameter.MASS] * GRAVITY * share
    pull += p[Parameter.MASS] * along
    return bool(
        brake > 0.0 and abs(pull) <= brake and math.hypot(pull, p[Parameter.MASS] * across) <= grip
    )


@compiled
def settle_standing(x: FloatArray, p: FloatArray, u: FloatArray, dt: float) -> None:
    """Apply one step of `dt` [s] to the state `x` of a vehicle that is held by its brakes: only the
    suspension moves, towards its equilibrium on the slope. `p` and `u` are the vehicle's parameters
    and inputs.
    """
    along, across, _ = gravity(u)
    x[Motion.VX] = 0.0
    x[Motion.VY] = 0.0
    x[Motion.YAW_RATE] = 0.0
    x[Motion.OMEGA : Motion.OMEGA + 4] = 0.0
    x[Motion.SLIP_X : STATES] = 0.0
    follow = min(dt / p[TrueParameter.LAG], 1.0)
    x[Motion.AX_LAGGED] += follow * (-along - x[Motion.AX_LAGGED])
    x[Motion.AY_LAGGED] += follow * (-across - x[Motion.AY_LAGGED])


@compiled
def advance(
    x: FloatArray, p: FloatArray, u: FloatArray, wheels: FloatArray, dt: float, substeps: int
) -> None:
    """Advance the state `x` of the simulated vehicle by `substeps` integration steps of `dt` [s]
    with parameters `p` and constant inputs `u`. `wheels` (8, 4) is scratch memory for forces and
    slips of the wheels.
    """
    along, across, _ = gravity(u)
    for _ in range(substeps):
        if is_held(x, p, u):
            settle_standing(x, p, u, dt)
            continue
        wheel_forces(x, p, u, wheels)
        ax, ay, yaw_acceleration = body_accelerations(x, p, u, wheels)
        vx = x[Motion.VX]
        vy = x[Motion.VY]
        r = x[Motion.YAW_RATE]
        turn_wheels(x, p, u, wheels, dt, (ax + r * vy + along, yaw_acceleration))
        if p[TrueParameter.RELAXATION] > 0.0:
            relax_slip(x, p, u, dt)
        if p[TrueParameter.ABS_HZ] > 0.0:
            control_slip(x, p, u, wheels, dt)
        c = math.cos(x[Motion.YAW] + 0.5 * dt * r)
        s = math.sin(x[Motion.YAW] + 0.5 * dt * r)
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
    """Fill the rows STEER, DRIVE and BRAKE of the inputs `u` of a vehicle with parameters `p`, from
    a mean road-wheel angle [rad] and a demanded longitudinal force [N].

    The steered wheels follow Ackermann geometry: their axes meet at one point on the line of the
    rear axle. If the rear wheels steer too, `steer` is the angle that a car without rear steering
    would need on the same circle. The front wheels then turn by a different angle, because the rear
    wheels contribute to the turn.
    """
    base = p[Parameter.TO_FRONT] + p[Parameter.TO_REAR]
    curvature = math.tan(steer) / base
    front = base * curvature / (1.0 - p[TrueParameter.REAR_STEER])
    for i in range(4):
        side = 1.0 if i % 2 == 0 else -1.0
        inner = 1.0 - side * 0.5 * p[Parameter.TRACK_FRONT] * curvature
        u[Control.STEER, i] = (
            math.atan(front / inner)
            if i < 2
            else p[TrueParameter.REAR_STEER] * math.atan(front / inner)
        )
        drive_share = p[Parameter.DRIVE_FRONT] if i < 2 else 1.0 - p[Parameter.DRIVE_FRONT]
        brake_share = p[TrueParameter.BRAKE_FRONT] if i < 2 else 1.0 - p[TrueParameter.BRAKE_FRONT]
        u[Control.DRIVE, i] = 0.5 * drive_share * max(force, 0.0) * p[Parameter.RADIUS]
        u[Control.BRAKE, i] = 0.5 * brake_share * max(-force, 0.0) * p[Parameter.RADIUS]


@compiled
def regenerate(x: FloatArray, p: FloatArray, u: FloatArray) -> None:
    """Replace a part of the brake torque in the inputs `u` of a vehicle (state `x`, parameters `p`)
    by drag torque of engine or generator, which acts at the driven wheels only.
    """
    total = 0.0
    for i in range(4):
        total += u[Control.BRAKE, i] / p[Parameter.RADIUS]
    if total <= 0.0:
        return
    fades = min(max(0.5 * (x[Motion.VX] - 1.0), 0.0), 1.0)
    part = min(total, p[Parameter.MASS] * p[TrueParameter.REGENERATION] * fades)
    for i in range(4):
        drive_share = p[Parameter.DRIVE_FRONT] if i < 2 else 1.0 - p[Parameter.DRIVE_FRONT]
        u[Control.BRAKE, i] *= 1.0 - part / total
        u[Control.DRIVE, i] -= 0.5 * drive_share * part * p[Parameter.RADIUS]


@compiled
def start_at(x: FloatArray, p: FloatArray, place: tuple[float, float, float], speed: float) -> None:
    """Set the state `x` of a simulated vehicle to straight rolling at `speed` [m/s], starting at
    the pose `place` (x [m], y [m], yaw [rad]).
    """
    x[:] = 0.0
    x[Motion.VX] = speed
    x[Motion.X], x[Motion.Y], x[Motion.YAW] = place
    x[Motion.OMEGA : Motion.OMEGA + 4] = speed / p[Parameter.RADIUS]


def substeps_of(rate_hz: float) -> int:
    """Return the number of equal integration steps, of at most LONGEST_SUBSTEP [s] each, in one
    sample at the rate `rate_hz` [Hz].
    """
    return max(1, math.ceil(round(1.0 / (rate_hz * LONGEST_SUBSTEP), 9)))


@compiled
def wheel_place(x: FloatArray, p: FloatArray, i: int) -> tuple[float, float]:
    """Return the position of wheel `i` on the ground, (x, y) [m], of a vehicle with state `x` and
    parameters `p`.
    """
    ahead, left = wheel_position(p, i)
    c = math.cos(x[Motion.YAW])
    s = math.sin(x[Motion.YAW])
    return x[Motion.X] + c * ahead - s * left, x[Motion.Y] + s * ahead + c * left


@compiled
def ground_velocity(x: FloatArray) -> tuple[float, float]:
    """Return the velocity of a vehicle with state `x` over the ground (east, north) [m/s]."""
    c = math.cos(x[Motion.YAW])
    s = math.sin(x[Motion.YAW])
    return c * x[Motion.VX] - s * x[Motion.VY], s * x[Motion.VX] + c * x[Motion.VY]


@compiled
def strongest_pull(p: FloatArray, vx: float) -> float:
    """Return the largest driving force of the engine [N] at the speed `vx` [m/s]: it is limited by
    the engine's power, and below 5 m/s by the gearbox.
    """
    return float(p[TrueParameter.POWER] / max(vx, 5.0))
