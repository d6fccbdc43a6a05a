"""Drive with one motor per axle and a differential: paper 004, equations (4) to (6).

Legend
    omega_1, omega_2    speeds of an axle's wheels [rad/s]
    omega_c             rotational speed at the axle's midpoint [rad/s]
    T_di                drive torque at wheel i [N m]
    T_m                 motor torque [N m]
    i_t, eta_t          ratio and efficiency of the transmission [1]
    F_xi, F_x           longitudinal force of wheel i, and of the axle [N]
    J_w, R              inertia [kg m^2] and radius [m] of a wheel

    J_w*omega_i' = T_di - F_xi*R                    (4)
    2*J_w*omega_c' = T_m*i_t*eta_t - F_x*R          (5), (6)

The paper uses the larger of the two wheel speeds as midpoint speed. In a turn that is the speed of
the outer wheel, not of the midpoint; therefore the mean is used here. The signals are torques at
the wheels, so T_m*i_t*eta_t is the sum of an axle's two torques. The paper gives no values of i_t
and eta_t.
"""

from __future__ import annotations

from typing import Final

from schemas.runtime.jit import inlined

RATIO: Final = 9.0  # [1] transmission ratio i_t of an ordinary electric car
EFFICIENCY: Final = 0.95  # [1] efficiency eta_t of the transmission


@inlined
def midpoint_speed(left: float, right: float) -> float:
    """Return the rotational speed [rad/s] at the midpoint of an axle from the speeds of its
    wheels.
    """
    return 0.5 * (left + right)


@inlined
def axle_force(torque: float, turning: float, inertia: float, radius: float) -> float:
    """Return the longitudinal force F_x [N] of an axle: (torque - 2*inertia*turning)/radius.
    `torque` [N m] is the sum of the axle's wheel torques, and `turning` [rad/s^2] the rotational
    acceleration at its midpoint. `inertia` [kg m^2] and `radius` [m] are those of one wheel.
    """
    return (torque - 2.0 * inertia * turning) / radius


@inlined
def motor_torque(torque: float, ratio: float, efficiency: float) -> float:
    """Return the motor torque T_m [N m] from `torque` [N m], the sum of an axle's wheel torques.
    `ratio` [1] is the transmission ratio and `efficiency` [1] that of the transmission. While the
    motor brakes, the transmission losses brake too, so the motor needs less torque.
    """
    share = efficiency if torque >= 0.0 else 1.0 / efficiency
    return torque / (ratio * share)
