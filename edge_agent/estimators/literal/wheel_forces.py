"""Tyre forces at one sample, computed in one call for many values of friction, in double or single
precision.

Legend: s_x, s_y longitudinal and lateral slip; k_x, k_y slip stiffness over load [1]; f Dugoff's
curve; F_z load; mu friction.

    proportional   F = mu*F_z*f(theta)*direction    theta = |(k_x*s_x, k_y*s_y)|
                   stiffness mu*k*F_z, as printed in the papers
    similarity     F = mu*F_z*f(theta/mu)*direction, stiffness k*F_z, as on a real tyre

With the printed tyre the force is linear in friction. Therefore it is defined for negative friction
too, and the filter need not limit its friction estimates between two samples.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from edge_agent.dynamics.parameters import Parameter
from edge_agent.dynamics.slip import SLOWEST_M_S
from edge_agent.estimators.literal.given_motion import GivenMotion
from schemas.numeric import FloatArray
from schemas.signals import S

TINY = 1e-12  # a smaller slip counts as zero: it has no direction and no force
# [1] smallest friction by which slip is divided, if stiffness is not proportional to friction
LEAST_MU = 0.02


@dataclass(frozen=True)
class WheelForces:
    """Slips, loads and steering angles of the wheels at each sample of a drive, with the kind of
    tyre stiffness (proportional to friction or not).
    """

    free: FloatArray  # (T, 4, 2) slip stiffness times slip, along and across the wheels
    loads: FloatArray  # (T, 4) [N]
    turned: FloatArray  # (T, 4, 2) cosine and sine of the steering angles
    places: FloatArray  # (4, 2) positions x and y of the wheels [m]
    mass: FloatArray  # (2,) mass [kg] and yaw inertia [kg m^2]
    air: FloatArray  # (T,) deceleration by air drag [m/s^2]
    proportional: bool

    @classmethod
    def for_drive(cls, motion: GivenMotion, *, proportional: bool, single: bool) -> WheelForces:
        """Return slips, loads and steering angles of the wheels in a drive, in single precision if
        `single` is True.
        """
        kind: Any = np.float32 if single else np.float64
        row = motion.row
        p = Parameter
        half_front = 0.5 * row[p.TRACK_FRONT]
        half_rear = 0.5 * row[p.TRACK_REAR]
        front = row[p.TO_FRONT]
        rear = -row[p.TO_REAR]
        places = np.array(
            [[front, half_front], [front, -half_front], [rear, half_rear], [rear, -half_rear]]
        )
        delta = motion.signals[:, S.DELTA : S.DELTA + 4]
        omega = motion.signals[:, S.OMEGA : S.OMEGA + 4]
        rate = motion.signals[:, S.YAW_RATE, None]
        ahead = motion.vx[:, None] - places[:, 1] * rate
        left = motion.vy[:, None] + places[:, 0] * rate
        turned = np.stack([np.cos(delta), np.sin(delta)], axis=-1)
        along = turned[..., 0] * ahead + turned[..., 1] * left
        across = turned[..., 0] * left - turned[..., 1] * ahead
        speed = np.maximum(np.abs(along), SLOWEST_M_S)
        slip_x = (row[p.RADIUS] * omega - along) / speed
        free = np.stack([row[p.SLOPE_X] * slip_x, -row[p.SLOPE_Y] * across / speed], axis=-1)
        mass = np.array([row[p.MASS], row[p.YAW_INERTIA]])
        air = motion.drag * motion.vx * np.abs(motion.vx) / row[p.MASS]
        return cls(
            np.asarray(free, kind),
            np.asarray(motion.wheel_loads(), kind),
            np.asarray(turned, kind),
            np.asarray(places, kind),
            np.asarray(mass, kind),
            np.asarray(air, kind),
            proportional,
        )

    def tyre_forces(self, k: int, mu: FloatArray) -> FloatArray:
        """Return the tyre forces [N] in the wheels' axes at sample `k`, (P, 4, 2), for P sets of
        frictions (P, 4).
        """
        free = self.free[k]
        size = np.maximum(np.hypot(free[:, 0], free[:, 1]), TINY)
        theta = size if self.proportional else size / np.maximum(mu, LEAST_MU)
        curve = np.where(theta <= 0.5, theta, 1.0 - 0.25 / np.maximum(theta, 0.5)).astype(
            free.dtype
        )
        pull = mu * self.loads[k] * curve / size
        return np.asarray(pull[..., None] * free)

    def body_accelerations(self, k: int, force: FloatArray) -> FloatArray:
        """Return a_x, a_y [m/s^2] and yaw acceleration [rad/s^2], (P, 3), for tyre forces (P, 4, 2)
        at sample `k`.
        """
        cos = self.turned[k, :, 0]
        sin = self.turned[k, :, 1]
        ahead = cos * force[..., 0] - sin * force[..., 1]
        left = sin * force[..., 0] + cos * force[..., 1]
        moment = (self.places[:, 0] * left - self.places[:, 1] * ahead).sum(axis=-1)
        ax = ahead.sum(axis=-1) / self.mass[0] - self.air[k]
        return np.stack([ax, left.sum(axis=-1) / self.mass[0], moment / self.mass[1]], axis=-1)
