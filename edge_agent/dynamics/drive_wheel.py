"""The electric drive wheel: motor, wheel and longitudinal tyre force (paper 002). The force is a
state whose derivative returns to zero, modelled as a sliding mode.

Legend
    tau     motor torque at the wheel, K_t*i [N m]           J    inertia, wheel and rotor [kg m^2]
    tau_u   stationary torque for the voltage [N m]          T_e  electric time constant L/R [s]
    omega   wheel speed [rad/s]                              R    wheel radius [m]
    F, F'   longitudinal force, its derivative [N, N/s]      k1, k2  sliding mode [N/s^2, 1/s]
    K_t     torque per motor current i [N m/A]               K_a  back-EMF constant [V s/rad]

tau' = (tau_u - tau)/T_e (10), J*omega' = tau - R*F (11), F'' = -k1*sgn(F') - k2*F' (31).

Departures from the paper: (1) Torque replaces the motor current, because there are no signals of
current or voltage. Moreover, the paper's values of K_a, K_t and J do not belong to the same motor.
(2) The left side of (31) is printed as F', but F'' is meant. (3) The sign function in (31) is
printed with a difference of quantities that have different units. Here its argument is F'.
"""

from __future__ import annotations

import math
from typing import NamedTuple

from schemas.numeric import FloatArray
from schemas.runtime.jit import compiled

ELECTRIC_S = 0.125 / 0.688  # [s] T_e from table 1 of paper 002
# k1 [N/s^2] and k2 [1/s] of the sliding mode, which the paper does not give
SLIDING_GAIN = 2000.0
SLIDING_RATE = 10.0
SOFT_N_S = 500.0  # [N/s] width of the smooth step, tanh(F'/SOFT_N_S), that replaces the sign of F'


class WheelState(NamedTuple):
    """State of an electric drive wheel: motor torque [N m], wheel speed [rad/s], longitudinal force
    [N] and its derivative [N/s].
    """

    torque: float
    omega: float
    force: float
    slope: float


@compiled
def drive_wheel(
    state: WheelState, settled: float, inertia: float, radius: float, step: float
) -> WheelState:
    """Return the state of a driven wheel (motor torque, speed, force, derivative of the force)
    after `step` [s] by Euler's rule, as printed in equation (32) of paper 002. `settled` is tau_u,
    the stationary motor torque [N m].
    """
    torque, omega, force, slope = state
    pull = SLIDING_GAIN * math.tanh(slope / SOFT_N_S) + SLIDING_RATE * slope
    return WheelState(
        torque + step * (settled - torque) / ELECTRIC_S,
        omega + step * (torque - radius * force) / inertia,
        force + step * slope,
        slope - step * pull,
    )


@compiled
def slip_share(radius: float, omega: float, along: float) -> float:
    """Return the share [1] that the force of the tyre model gets in the compensated force of a
    wheel (`blend_forces`): 1/2 + 2^(-1/|s|), equation (33) of paper 002.

    s is the longitudinal slip by equation (15): the difference of `radius` [m] times `omega`
    [rad/s] and the velocity `along` [m/s] of the wheel's centre, over the larger of the two. At
    ordinary slips (up to 0.2) the share is about one half.
    """
    turning = radius * omega
    most = max(abs(turning), abs(along), 1e-3)
    size = min(abs(turning - along) / most, 1.0)
    return 0.5 + (2.0 ** (-1.0 / size) if size > 0.0 else 0.0)


@compiled
def blend_forces(
    share: FloatArray, model: FloatArray, observed: FloatArray, out: FloatArray
) -> None:
    """Fill `out` (4,) with the compensated wheel forces [N] by equation (33) of paper 002:
    share*model + (1 - share)*observed. `model` (4,) are the forces of a tyre model, and `observed`
    (4,) the forces that an observer (filter) estimates.
    """
    for wheel in range(4):
        out[wheel] = share[wheel] * model[wheel] + (1.0 - share[wheel]) * observed[wheel]
