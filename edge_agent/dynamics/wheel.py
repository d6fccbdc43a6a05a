"""Torque balance of a wheel: J*omega' = T - R*F_x.

Legend
    T       torque at the wheel, driving positive [N m]
    J       inertia [kg m^2]
    omega   wheel speed [rad/s]
    R       wheel radius [m]
    F_x     longitudinal tyre force [N]

Torque gives the force with little noise. Wheel speed is used as a measurement, never as an exact
input (see the errata of the papers).
"""

from __future__ import annotations

from schemas.runtime.jit import compiled


@compiled
def force_from_torque(
    torque: float, wheel_acceleration: float, inertia: float, radius: float
) -> float:
    """Return the longitudinal tyre force (T - J*omega')/R [N] that follows from the wheel torque T,
    the wheel acceleration omega', inertia J and radius R.
    """
    return (torque - inertia * wheel_acceleration) / radius


@compiled
def wheel_acceleration(torque: float, force_x: float, inertia: float, radius: float) -> float:
    """Return the wheel acceleration (T - R*F_x)/J [rad/s^2] from the wheel torque T, the
    longitudinal tyre force F_x, radius R and inertia J.
    """
    return (torque - radius * force_x) / inertia
