"""Calibration against the truth of simulated rough cars: its errors in units of the standard deviations it claims."""

from __future__ import annotations

from typing import Final

import numpy as np

from edge_agent.calibration.learn import learn
from edge_agent.lab.evaluation.planted import drives
from edge_agent.lab.simulation.misaligned import Misaligned
from edge_agent.lab.simulation.place import GOTHENBURG
from edge_agent.lab.simulation.sensors import ROUGH_FLEET, ErrorColumn, error_row
from schemas.runtime.figures import Figure
from schemas.signals import WHEELS, S

DRIVES, DRIVE_S = 10, 60  # of each car; its road goes on from drive to drive
CARS_AT_ONCE: Final = 5


def truth(seed: int, car: int) -> dict[str, float]:
    """What the devices of a rough car are off by."""
    error = error_row(ROUGH_FLEET, GOTHENBURG, seed, car)
    mounted, offset = error[ErrorColumn.MOUNTED :], error[ErrorColumn.OFFSET :]
    radii = mounted[Misaligned.RADIUS : Misaligned.RADIUS + 4]
    off = (1.0 + radii) / (1.0 + radii.mean()) - 1.0
    return {
        **{f"radius_{wheel}": float(value) for wheel, value in zip(WHEELS, off, strict=True)},
        "ax": float(mounted[Misaligned.AX] + offset[S.AX]),
        "ay": float(mounted[Misaligned.AY] + offset[S.AY]),
        "yaw_rate": float(offset[S.YAW_RATE]),
        "steer_offset": float(mounted[Misaligned.ZERO] + offset[S.DELTA]),
        "steer_gain": float(1.0 + mounted[Misaligned.GAIN]),
    }


def figures(cars: int, seed: int) -> list[Figure]:
    """RMS of (learned − true) / standard deviation over cars, by quantity; the four radii as one."""
    away: dict[str, list[float]] = {}
    for first in range(0, cars, CARS_AT_ONCE):
        at = seed + first // CARS_AT_ONCE
        for car, drive in enumerate(drives(min(CARS_AT_ONCE, cars - first), at, rough=True, seconds=DRIVES * DRIVE_S)):
            size = len(drive.t) // DRIVES
            parts = [slice(k * size, (k + 1) * size) for k in range(DRIVES)]
            learned = learn([(drive.t[part], drive.signals[part]) for part in parts], drive.vehicle)
            for name, value in truth(at, car).items():
                if (estimate := getattr(learned, name)) is not None:
                    key = "radius" if name.startswith("radius") else name
                    away.setdefault(key, []).append((estimate[0] - value) / estimate[1])
    return [
        Figure(f"calibration.errors.{name}", float(np.sqrt(np.mean(np.square(values)))), "1", (0.7, 1.3), "within")
        for name, values in away.items()
    ]
