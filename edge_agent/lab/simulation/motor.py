"""Permanent-magnet synchronous motors at the wheels, and the PID speed control of paper 003
(section 4.1).

Legend, in the rotor's d-q axes
    u, i        voltage [V] and current [A] of an axis
    L, R        inductance [H] and resistance [ohm] of the stator
    psi         flux of the magnets [Wb]
    p           pole pairs
    omega_e     electrical speed p*omega_m [rad/s]
    G           gear ratio from motor to wheel

    L_d*i_d' = u_d - R*i_d + omega_e*L_q*i_q                     voltage of the d axis
    L_q*i_q' = u_q - R*i_q - omega_e*(L_d*i_d + psi)             voltage of the q axis
    T = 1.5*p*(psi*i_q + (L_d - L_q)*i_d*i_q)                    torque

The inverter's current control is proportional-integral with feed-forward of the motor's own terms.
The target of i_d is zero, and the voltage is limited. The paper gives no constants; these are of an
ordinary hub motor. The module `plant` computes the rotation of motor and wheel together; the
wheel's inertia includes the rotor. Viscous friction is left out, because the filters use the torque
at the wheel.
"""

from __future__ import annotations

import math
from typing import Final, NamedTuple

import numpy as np

from schemas.numeric import FloatArray
from schemas.runtime.jit import compiled

# [s] longest integration step of the motor's equations; their electrical time constant is L/R = 3
# ms.
STEP_S: Final = 1e-4
# Columns of a motor's state: currents [A], and integrals of their errors [A s].
D = 0
Q = 1
D_SUM = 2
Q_SUM = 3


class Pmsm(NamedTuple):
    """Constants of one permanent-magnet synchronous motor (PMSM), of its current control and of the
    vehicle's speed control.
    """

    resistance: float = 0.10  # R [ohm]
    inductance_d: float = 3.0e-4  # L_d [H]
    inductance_q: float = 3.0e-4  # L_q [H]
    flux: float = 0.12  # psi [Wb]
    pole_pairs: float = 8.0  # p
    gear: float = 4.0  # G
    voltage: float = 600.0  # [V] largest voltage of the inverter
    bandwidth: float = 600.0  # [rad/s] bandwidth of the current control
    proportional: float = 1.5  # [1/s] gain of the speed control for the error of speed
    integral: float = 0.3  # [1/s^2] gain of the speed control for the integral of the error
    derivative: float = 0.05  # [1] gain of the speed control for the acceleration


def speed_demand(motor: Pmsm, error: float, summed: float, acceleration: float) -> float:
    """Return the acceleration [m/s^2] that the PID controller demands.

    Args:
        error: demanded minus true speed [m/s].
        summed: integral of the error over time [m].
        acceleration: true acceleration [m/s^2]; it replaces the derivative of the error.
    """
    return motor.proportional * error + motor.integral * summed - motor.derivative * acceleration


def at_rest() -> FloatArray:
    """Return the initial state (4, 4) of four motors without current."""
    return np.zeros((4, 4))


@compiled
def turn_motor(
    state: FloatArray, motor: Pmsm, demanded_torque: float, omega: float, dt: float
) -> float:
    """Advance one motor's state (4,) by `dt` [s] at wheel speed `omega` [rad/s]; return its torque
    at the wheel [N m].

    `demanded_torque` is the demanded torque at the wheel [N m].
    """
    per_ampere = 1.5 * motor.pole_pairs * motor.flux
    aim = demanded_torque / (motor.gear * per_ampere)
    electrical = motor.pole_pairs * motor.gear * omega
    count = max(1, math.ceil(dt / STEP_S - 1e-9))
    step = dt / count
    for _ in range(count):
        back_d = electrical * motor.inductance_q * state[Q]
        back_q = electrical * (motor.inductance_d * state[D] + motor.flux)
        error_d = -state[D]
        error_q = aim - state[Q]
        control = motor.bandwidth * motor.resistance
        voltage_d = motor.bandwidth * motor.inductance_d * error_d + control * state[D_SUM] - back_d
        voltage_q = motor.bandwidth * motor.inductance_q * error_q + control * state[Q_SUM] + back_q
        size = math.hypot(voltage_d, voltage_q)
        share = min(1.0, motor.voltage / size) if size > 0.0 else 1.0
        # Stop the integrals while the voltage is at its limit, because they would then overshoot.
        if share == 1.0:
            state[D_SUM] += step * error_d
            state[Q_SUM] += step * error_q
        state[D] += (
            step * (share * voltage_d - motor.resistance * state[D] + back_d) / motor.inductance_d
        )
        state[Q] += (
            step * (share * voltage_q - motor.resistance * state[Q] - back_q) / motor.inductance_q
        )
    reluctance = (motor.inductance_d - motor.inductance_q) * state[D] * state[Q]
    return float(motor.gear * 1.5 * motor.pole_pairs * (motor.flux * state[Q] + reluctance))
