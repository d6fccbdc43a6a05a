"""Simulated controllers of a vehicle: ABS, traction control (TCS), drag torque control and ESC.

Each controller acts in every integration step of the vehicle model. It gets the true slip of the
wheels, because the simulation includes the effect of the controllers on the wheels, but not their
sensors.

    ABS    If a wheel exceeds its slip limit, its brake torque is reduced at the rate DUMP, then
           held until the slip is half of the limit. The torque is then increased again: fast up to
           NEARLY times the torque at which the reduction began, then slowly. This gives 6 to 10
           cycles per second. Both rear wheels get the lower of the two rear torques.
    TCS    The engine torque is cut while a driven wheel spins, and the brake holds a wheel that
           spins much. The same logic removes the drag torque of engine or generator if that torque
           makes a wheel slip, and while ABS acts.
    ESC    If the yaw rate differs from the value expected from steering, one wheel is braked: the
           outer front wheel of a car that turns too much, the inner rear wheel of a car that turns
           too little. The engine torque is cut.
"""

from __future__ import annotations

import math
from typing import Final

from edge_agent.dynamics.parameters import Parameter
from edge_agent.lab.simulation.state import Control, Motion, TrueParameter, Wheel
from schemas.numeric import FloatArray
from schemas.runtime.jit import compiled
from schemas.thresholds import GRAVITY

# Slip limit of the rear wheels as a share of that of the front wheels. It is smaller, so that the
# rear wheels keep their lateral force.
REAR_LIMIT: Final = 0.5
SHOWN_S: Final = 0.25  # [s] time for which a controller counts as active after it acted
ABS_SLOWEST: Final = 1.5  # [m/s] at lower speeds brakes may lock the wheels
# Rates of ln(brake torque) [1/s] at USUAL_HZ: reduction, fast increase, slow increase.
DUMP: Final = 22.0
BUILD_FAST: Final = 35.0
BUILD: Final = 2.8
NEARLY: Final = 0.88
USUAL_HZ: Final = 8.0
LEAST_SHARE: Final = 0.02  # minimum brake torque under ABS, as a share of the demanded torque
TCS_SLOWEST: Final = 2.5  # [m/s] minimum speed in the denominator of the drive slip
# Rates [1/s] at which traction control reduces the engine torque and restores it.
CUT_RATE: Final = 5.0
GIVE_RATE: Final = 0.8
MOST_CUT: Final = 0.95  # maximum share of engine torque that is cut
MUCH: Final = 2.0  # multiple of the slip limit of traction control at which it also brakes
# Largest brake torque of traction control, divided by weight times wheel radius.
TCS_BRAKE: Final = 0.12
ESC_SLOWEST: Final = 4.0  # [m/s] ESC does not act at lower speeds
ESC_S: Final = 0.06  # [s] time for which the yaw rate must differ before ESC acts
YAW_OFF: Final = 0.10  # [rad/s] tolerated difference of the yaw rate
FOLLOWS_S: Final = 0.12  # [s] time constant with which a car follows its steering
YAW_SHARE: Final = 0.12
CHARACTERISTIC: Final = 45.0  # [m/s] speed at which understeer halves the effect of steering
MOST_LATERAL: Final = 9.0  # [m/s^2] largest lateral acceleration expected from steering
ESC_GAIN: Final = 3.0  # brake torque of ESC over weight times radius, per rad/s
ESC_BRAKE: Final = 0.15  # largest brake torque of ESC over weight times radius, front wheel
# Largest brake torque of ESC at a rear wheel, over weight times radius. A larger torque would
# reduce the lateral force that stabilises the car.
ESC_REAR: Final = 0.04
# Rate of change of the brake torques of traction control and ESC, over weight times radius [1/s].
HELD_RATE: Final = 2.0


@compiled
def slip_limit(p: FloatArray, i: int) -> float:
    """Return, from the vehicle's parameters `p`, the slip limit [1] of wheel `i` at which ABS
    begins to release the brake.
    """
    return float(p[TrueParameter.SLIP_LIMIT] if i < 2 else REAR_LIMIT * p[TrueParameter.SLIP_LIMIT])


@compiled
def control_slip(
    x: FloatArray, p: FloatArray, u: FloatArray, wheels: FloatArray, dt: float
) -> None:
    """Advance all slip controllers (ABS, traction control) in the vehicle's state `x` by `dt` [s],
    from the wheel slips in `wheels` (8, 4), the vehicle's parameters `p` and its inputs `u` (6, 4).
    """
    x[Motion.ABS_LEFT] = max(x[Motion.ABS_LEFT] - dt, 0.0)
    x[Motion.TCS_LEFT] = max(x[Motion.TCS_LEFT] - dt, 0.0)
    x[Motion.ESC_LEFT] = max(x[Motion.ESC_LEFT] - dt, 0.0)
    unit = p[Parameter.MASS] * GRAVITY * p[Parameter.RADIUS]
    wheel, esc_brake_ratio = stabilise(x, p, u, dt)
    traction_active = cut_drive(x, p, u, wheels, dt)
    for i in range(4):
        target = esc_brake_ratio * unit if i == wheel else 0.0
        if traction_active and spin_excess(x, p, wheels, i) > MUCH and u[Control.DRIVE, i] > 0.0:
            target = max(target, TCS_BRAKE * unit)
        step = HELD_RATE * unit * dt
        x[Motion.HELD + i] += min(max(target - x[Motion.HELD + i], -step), step)
        modulate(x, p, u, wheels, i, dt)
    low = max(x[Motion.LIMIT + 2], x[Motion.LIMIT + 3])
    if min(x[Motion.LIMIT + 2], x[Motion.LIMIT + 3]) > 0.0:
        low = min(x[Motion.LIMIT + 2], x[Motion.LIMIT + 3])
    if low > 0.0:
        x[Motion.LIMIT + 2] = low
        x[Motion.LIMIT + 3] = low


@compiled
def modulate(
    x: FloatArray, p: FloatArray, u: FloatArray, wheels: FloatArray, i: int, dt: float
) -> None:
    """Advance by `dt` [s] the limit that ABS sets to the brake torque of wheel `i`: reduce the
    limit while the wheel slips too much, otherwise hold or increase it. `x` is the vehicle's state,
    which is changed, `p` the vehicle's parameters, `u` the inputs and `wheels` the forces and slips
    of the wheels.
    """
    demanded = u[Control.BRAKE, i] + x[Motion.HELD + i]
    limit = slip_limit(p, i)
    slip = wheels[Wheel.SLIP, i]
    pace = p[TrueParameter.ABS_HZ] / USUAL_HZ * dt
    if demanded <= 0.0 or abs(x[Motion.VX]) < ABS_SLOWEST:
        x[Motion.LIMIT + i] = 0.0
        x[Motion.PEAK + i] = 0.0
    elif slip < -limit:
        now = demanded if x[Motion.LIMIT + i] <= 0.0 else min(x[Motion.LIMIT + i], demanded)
        if x[Motion.PEAK + i] <= 0.0:
            x[Motion.PEAK + i] = now
        x[Motion.LIMIT + i] = max(now * math.exp(-DUMP * pace), LEAST_SHARE * demanded)
        x[Motion.ABS_LEFT] = SHOWN_S
    elif x[Motion.LIMIT + i] > 0.0 and slip > -0.5 * limit:
        fast = x[Motion.LIMIT + i] < NEARLY * abs(x[Motion.PEAK + i])
        x[Motion.LIMIT + i] *= math.exp((BUILD_FAST if fast else BUILD) * pace)
        x[Motion.PEAK + i] = -abs(x[Motion.PEAK + i])
        if x[Motion.LIMIT + i] >= demanded:
            x[Motion.LIMIT + i] = 0.0
            x[Motion.PEAK + i] = 0.0


@compiled
def spin_excess(x: FloatArray, p: FloatArray, wheels: FloatArray, i: int) -> float:
    """Return the drive slip of wheel `i` divided by the slip at which traction control acts [1].
    `x` is the vehicle's state, `p` the vehicle's parameters, and `wheels` contains the wheels'
    speeds over ground.
    """
    along = wheels[Wheel.SPEED, i]
    faster = p[Parameter.RADIUS] * x[Motion.OMEGA + i] - along
    return float(faster / (p[TrueParameter.SLIP_LIMIT] * max(abs(along), TCS_SLOWEST)))


@compiled
def cut_drive(x: FloatArray, p: FloatArray, u: FloatArray, wheels: FloatArray, dt: float) -> bool:
    """Cut or restore the engine torque in the vehicle's state `x` over `dt` [s], as traction
    control does.

    Return True if traction control acts now. It acts if the vehicle has traction control, and a
    wheel slips too much because it spins or because drag torque slows it.
    """
    acts = False
    drags = False
    for i in range(4):
        spin = spin_excess(x, p, wheels, i)
        if (u[Control.DRIVE, i] > 0.0 and spin > 1.0) or (
            u[Control.DRIVE, i] < 0.0 and spin < -1.0
        ):
            acts = True
        drags = drags or u[Control.DRIVE, i] < 0.0
    acts = acts and p[TrueParameter.TCS] > 0.0
    others_act = x[Motion.ESC_LEFT] > 0.0 or (drags and x[Motion.ABS_LEFT] > 0.0)
    rate = CUT_RATE if acts or others_act else -GIVE_RATE
    x[Motion.CUT] = min(max(x[Motion.CUT] + rate * dt, 0.0), MOST_CUT)
    if acts:
        x[Motion.TCS_LEFT] = SHOWN_S
    return acts


@compiled
def stabilise(x: FloatArray, p: FloatArray, u: FloatArray, dt: float) -> tuple[int, float]:
    """Advance the stability control (ESC) in the vehicle's state `x` by `dt` [s], from the inputs
    `u` and the parameters `p`. Return two values: the index of the wheel that ESC brakes (-1 for
    none), and the brake torque divided by (vehicle's weight * wheel radius).
    """
    vx = x[Motion.VX]
    r = x[Motion.YAW_RATE]
    if p[TrueParameter.ESC] <= 0.0 or vx < ESC_SLOWEST:
        x[Motion.DEVIATES] = 0.0
        x[Motion.ASKED] = r
        return -1, 0.0
    base = p[Parameter.TO_FRONT] + p[Parameter.TO_REAR]
    steer = 0.5 * (u[Control.STEER, 0] + u[Control.STEER, 1])
    target_rate = vx * math.tan(steer) / (base * (1.0 + (vx / CHARACTERISTIC) ** 2))
    target_rate = min(max(target_rate, -MOST_LATERAL / vx), MOST_LATERAL / vx)
    x[Motion.ASKED] += (target_rate - x[Motion.ASKED]) * -math.expm1(-dt / FOLLOWS_S)
    target_rate = x[Motion.ASKED]
    off = r - target_rate
    beyond = abs(off) - YAW_OFF - YAW_SHARE * abs(target_rate)
    x[Motion.DEVIATES] = x[Motion.DEVIATES] + dt if beyond > 0.0 else 0.0
    if x[Motion.DEVIATES] < ESC_S:
        return -1, 0.0
    x[Motion.ESC_LEFT] = SHOWN_S
    turns_too_much = off * target_rate > 0.0 or abs(r) > abs(target_rate)
    right_side = 1 if off > 0.0 else 0
    wheel = right_side if turns_too_much else 2 + right_side
    return wheel, min(ESC_GAIN * beyond, ESC_BRAKE if turns_too_much else ESC_REAR)
