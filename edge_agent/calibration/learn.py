"""Errors of one car's devices from its own drives, each a mean over the drives with its standard deviation.

    quantity          from
    radius_fl … rr    turning of each wheel against the median of the four on calm moments, less what yaw makes of it
    ax, ay            median of a_x − dv/dt and of a_y − v·r, the latter on straights
    yaw_rate          intercept of the wheels' yaw rate over the gyro's
    steer_offset      intercept of δ over L·r/v with understeer beside it
    steer_gain        gain of the same
    understeer        δ beyond L·r/v per v·r [rad per m/s²]

A drive that was not excited enough for a quantity says nothing of it. The spread among drives (not less than FLOOR, as
few drives may agree by chance) over the root of their number is the standard deviation; BIAS, what all drives have in
common (crossfall of 2.5 %, a steering map that is bent, load), is added to it. Both were set on simulated rough cars.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Final, TypeAlias

import numpy as np

from edge_agent.inputs.doctor.drive import RATE_HZ, EvenDrive, prepare
from edge_agent.inputs.doctor.identities import fits
from schemas.errors import InputError
from schemas.numeric import FloatArray
from schemas.signals import WHEELS
from schemas.vehicle import Calibration, Vehicle

CALM: Final = 0.7  # [m/s^2] of acceleration, up to which wheels hardly slip
STRAIGHT: Final = 1.0  # [m/s^2] of v·r
LEAST_S: Final = 10.0  # of moments that count
# spread among drives that is always allowed for; and what drives have in common
FLOOR: Final = {"radius": 0.0008, "ax": 0.10, "ay": 0.05, "yaw_rate": 0.0015, "steer_offset": 0.0010,
                "steer_gain": 0.03, "understeer": 0.0015}  # fmt: skip
BIAS: Final = {"radius": 0.0007, "ax": 0.06, "ay": 0.25, "yaw_rate": 0.0005, "steer_offset": 0.0006,
               "steer_gain": 0.04, "understeer": 0.0010}  # fmt: skip

DriveEstimates: TypeAlias = dict[str, float]
"""Estimates of one drive, by quantity."""


def learn(drives: Sequence[tuple[FloatArray, FloatArray]], vehicle: Vehicle) -> Calibration:
    """Calibration of a vehicle from its drives, (t (T,), signals (T, 18)) each.

    Raises:
        InputError: none of them is excited enough.
    """
    calibration = weighed([one_drive(prepare(t, signals, vehicle), vehicle) for t, signals in drives])
    if calibration is None:
        raise InputError(
            "log", "no drive is excited enough to learn from", "give drives with turns, straights, braking"
        )
    return calibration


def weighed(drives: Sequence[DriveEstimates]) -> Calibration | None:
    """Means over several drives with standard deviations; None where no drive was excited."""
    estimates: dict[str, list[float]] = {}
    for drive in drives:
        for name, value in drive.items():
            estimates.setdefault(name, []).append(value)
    if not estimates:
        return None
    learned = {name: _mean(name, np.array(values)) for name, values in estimates.items()}
    return Calibration.model_validate({"drives": len(drives), **learned})


def surer(one: Calibration | None, other: Calibration | None) -> Calibration | None:
    """Of each quantity, the value with the smaller standard deviation of two calibrations of a car."""
    if one is None or other is None:
        return one or other
    better = {
        name: mine for name in Calibration.model_fields
        if isinstance(mine := getattr(one, name), tuple)
        and ((its := getattr(other, name)) is None or mine[1] < its[1])
    }  # fmt: skip
    return other.model_copy(update={**better, "drives": max(one.drives, other.drives)})


def _mean(name: str, values: FloatArray) -> tuple[float, float]:
    kind = name.partition("_")[0] if name.startswith("radius") else name
    spread = max(float(np.std(values, ddof=1)) if len(values) > 2 else 2.0 * FLOOR[kind], FLOOR[kind])
    centre = float(np.median(values)) if len(values) > 2 else float(np.mean(values))
    return round(centre, 6), round(float(np.hypot(spread / np.sqrt(len(values)), BIAS[kind])), 6)


def one_drive(drive: EvenDrive, vehicle: Vehicle) -> DriveEstimates:
    """Estimates of one drive, by quantity; those it was not excited for are left out."""
    moving, axle = drive.moving > 0, fits(drive)["axle"]
    quantities: DriveEstimates = {}
    if axle.known and axle.error < 0.1:
        quantities["yaw_rate"] = -axle.offset / axle.gain
        drive = replace(drive, r=drive.r - quantities["yaw_rate"])  # else taken for offsets of steering and a_y
    quantities |= _radii(drive, vehicle)
    calm = moving & np.isfinite(drive.ax) & np.isfinite(drive.v_dot)
    if calm.sum() > LEAST_S * RATE_HZ:
        quantities["ax"] = float(np.median((drive.ax - drive.v_dot)[calm]))
    straight = moving & (np.abs(drive.v * drive.r) < STRAIGHT) & np.isfinite(drive.ay)
    if straight.sum() > LEAST_S * RATE_HZ:
        quantities["ay"] = float(np.median((drive.ay - drive.v * drive.r)[straight]))
    steering = fits(drive)["steering"]
    if steering.known and steering.error < 0.1:
        quantities |= {"steer_offset": steering.offset, "steer_gain": steering.gain, "understeer": steering.beside[0]}
    return quantities


def _radii(drive: EvenDrive, vehicle: Vehicle) -> dict[str, float]:
    """How much faster each wheel turns than the mean of the four."""
    calm = (drive.moving > 0) & (np.abs(drive.v_dot) < CALM) & (np.abs(drive.v * drive.r) < STRAIGHT)
    calm &= np.isfinite(drive.wheels).all(axis=1) & np.isfinite(drive.r)
    if calm.sum() < LEAST_S * RATE_HZ:
        return {}
    half = 0.5 * np.array([-vehicle.track_front, vehicle.track_front, -vehicle.track_rear, vehicle.track_rear])
    rims = drive.wheels[calm] - half * drive.r[calm, None]
    ratio = np.median(rims / rims.mean(axis=1, keepdims=True), axis=0) - 1.0
    return {f"radius_{wheel}": float(value) for wheel, value in zip(WHEELS, ratio, strict=True)}
