"""The motion of one drive that the friction filters of papers 000 and 003 require as input.

Wheel order fl, fr, rl, rr; ISO 8855 signs.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from edge_agent.dynamics.parameters import Parameter, parameter_row
from schemas.numeric import FloatArray
from schemas.signals import S
from schemas.thresholds import GRAVITY
from schemas.vehicle import Vehicle


@dataclass(frozen=True)
class GivenMotion:
    """One drive with T samples: true motion of the body, and sensor readings.

    Attributes:
        vehicle: parameters of the vehicle.
        t: time [s] (T,).
        vx, vy: forward and left velocity of the centre of gravity [m/s] (T,).
        signals: readings in the order of schemas.signals.CHANNELS (T, 18).
        rolling: rolling resistance over load [1], known to the filter.
        drag: air drag force per squared speed [N s^2/m^2], known to the filter.
    """

    vehicle: Vehicle
    t: FloatArray
    vx: FloatArray
    vy: FloatArray
    signals: FloatArray
    rolling: float = 0.0
    drag: float = 0.0

    @property
    def step(self) -> float:
        """Return the interval [s] between two samples of the drive."""
        return float(self.t[1] - self.t[0])

    @property
    def row(self) -> FloatArray:
        """Return the parameters of the vehicle as an array (15,) indexed by `Parameter`."""
        return parameter_row(self.vehicle)

    def wheel_forces(self) -> FloatArray:
        """Return the longitudinal forces F_x = (T - J*omega')/R - k_r*F_z [N] of the wheels, (T,
        4).

        They are computed from torque T and wheel speed omega; k_r is the rolling resistance.
        """
        row = self.row
        omega = self.signals[:, S.OMEGA : S.OMEGA + 4]
        torque = self.signals[:, S.TORQUE : S.TORQUE + 4]
        turning = np.diff(omega, axis=0, prepend=omega[:1]) / self.step
        force = (torque - row[Parameter.WHEEL_INERTIA] * turning) / row[Parameter.RADIUS]
        return np.asarray(force - self.rolling * self.wheel_loads())

    def wheel_loads(self) -> FloatArray:
        """Return the wheel loads [N], (T, 4), at the measured accelerations (equation 9)."""
        row = self.row
        p = Parameter
        ax = self.signals[:, S.AX]
        ay = self.signals[:, S.AY]
        base = row[p.TO_FRONT] + row[p.TO_REAR]
        weight = row[p.MASS] * GRAVITY
        pitch = row[p.MASS] * row[p.CG_HEIGHT] / base * ax
        front = weight * row[p.TO_REAR] / base - pitch
        rear = weight * row[p.TO_FRONT] / base + pitch
        roll = ay * row[p.CG_HEIGHT] / GRAVITY
        shift_front = front * roll / row[p.TRACK_FRONT]
        shift_rear = rear * roll / row[p.TRACK_REAR]
        halves = (0.5 * front, 0.5 * front, 0.5 * rear, 0.5 * rear)
        shifts = (-shift_front, shift_front, -shift_rear, shift_rear)
        return np.stack([half + shift for half, shift in zip(halves, shifts, strict=True)], axis=1)
