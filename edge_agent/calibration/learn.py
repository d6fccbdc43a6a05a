"""Errors of one car's devices from its own drives, each a mean over the drives with its standard deviation.

    quantity          from
    radius_fl … rr    turning of each wheel against the mean of the four on calm moments, less what yaw and slip explain
    ax, ay            median of a_x − dv/dt and of a_y − v·r, the latter on straights
    yaw_rate          intercept of the wheels' yaw rate over the gyro's
    steer_offset      intercept of δ over L·r/v with understeer beside it
    steer_gain        gain of the same
    force_gain        torque over radius, over mass times acceleration: torque gain and mass, where torque is recorded
    wheel_lag, steer_lag    by which they speak later than the inertial unit: lags.py
    understeer        δ beyond L·r/v per v·r [rad per m/s²]

Wheels under force slip: what the driven axle turns faster for it, and the dragged one slower, is taken off a radius by
the file's stiffness, its driven axle, and what usual cars lose to air and to the tyres' rolling.

A drive that was not excited enough for a quantity leaves it out. The median deviation among drives (not less than
FLOOR, as few drives may agree by chance) over the root of their number, and BIAS, what all drives have in common
(crossfall of 2.5 %, a steering map that is bent, load), make the standard deviation. Both were set on 40 simulated
rough cars with other seeds than those of the figures. A quantity that was hardly seen is drawn to what cars usually
have (USUAL): value and standard deviation are those of the posterior.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Final, TypeAlias

import numpy as np

from edge_agent.inputs.doctor.drive import RATE_HZ, EvenDrive, prepare
from edge_agent.inputs.doctor.identities import fits, robust
from edge_agent.inputs.doctor.lags import lags
from schemas.errors import InputError
from schemas.numeric import BoolArray, FloatArray
from schemas.signals import WHEELS
from schemas.thresholds import GRAVITY
from schemas.vehicle import Calibration, Vehicle

CALM: Final = 0.7  # [m/s^2] of acceleration, up to which wheels hardly slip
PULLED: Final = 0.5  # [m/s^2] from which on torque tells its gain
STRAIGHT: Final = 1.0  # [m/s^2] of v·r
LEAST_S: Final = 10.0  # of moments that count
# spread among drives that is always allowed for; what drives have in common; and spread among cars
FLOOR: Final = {"radius": 0.0004, "ax": 0.10, "ay": 0.05, "yaw_rate": 0.0015, "steer_offset": 0.0006,
                "steer_gain": 0.03, "force_gain": 0.02, "understeer": 0.0015, "wheel_lag": 0.012,
                "steer_lag": 0.012}  # fmt: skip
BIAS: Final = {"radius": 0.0001, "ax": 0.02, "ay": 0.25, "yaw_rate": 0.0005, "steer_offset": 0.0004,
               "steer_gain": 0.03, "force_gain": 0.002, "understeer": 0.0005, "wheel_lag": 0.009,
               "steer_lag": 0.009}  # fmt: skip
USUAL: Final = {"radius": 0.006, "ax": 0.4, "ay": 0.2, "yaw_rate": 0.004, "steer_offset": 0.005, "steer_gain": 0.04,
                "force_gain": 0.08, "understeer": 0.01, "wheel_lag": 0.04, "steer_lag": 0.04}  # fmt: skip
ROBUST: Final = 1.4826  # standard deviations in the median of absolute deviations
UNKNOWN_SPLIT: Final = 0.0008  # BIAS of radii where the file does not say which axle drives
DRAG: Final = 0.4  # [kg/m] half of 1.2 kg/m^3 x .3 x 2.2 m^2
ROLLING: Final = 0.008  # [1] rolling resistance over load
BRAKED_FRONT: Final = 0.7  # [1] share of the front axle in braking

DriveEstimates: TypeAlias = dict[str, float]
"""Estimates of one drive, by quantity."""


def learn(drives: Sequence[tuple[FloatArray, FloatArray]], vehicle: Vehicle) -> Calibration:
    """Calibration of a vehicle from its drives, (t (T,), signals (T, 18)) each.

    Raises:
        InputError: none of them is excited enough.
    """
    estimates = [one_drive(t, signals, vehicle) for t, signals in drives]
    calibration = weighed(estimates, vehicle)
    if calibration is None:
        raise InputError(
            "log", "no drive is excited enough to learn from", "give drives with turns, straights, braking"
        )
    return calibration


def weighed(drives: Sequence[DriveEstimates], vehicle: Vehicle) -> Calibration | None:
    """Means over several drives with standard deviations; None where no drive was excited."""
    estimates: dict[str, list[float]] = {}
    for drive in drives:
        for name, value in drive.items():
            estimates.setdefault(name, []).append(value)
    if not estimates:
        return None
    bias = BIAS if vehicle.drive_split_front is not None else BIAS | {"radius": UNKNOWN_SPLIT}
    learned = {}
    for name, values in estimates.items():
        kind = name.partition("_")[0] if name.startswith("radius") else name
        learned[name] = _posterior(kind, np.array(values), bias[kind])
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


def _posterior(kind: str, values: FloatArray, bias: float) -> tuple[float, float]:
    """Value and standard deviation by the estimates of drives (n,)."""
    sound = 1.0 if kind.endswith("gain") else 0.0
    centre = float(np.median(values))
    around = ROBUST * float(np.median(np.abs(values - centre))) if len(values) > 2 else 2.0 * FLOOR[kind]
    spread = max(around, FLOOR[kind])
    std = float(np.hypot(spread / np.sqrt(len(values)), bias))
    share = USUAL[kind] ** 2 / (USUAL[kind] ** 2 + std**2)
    return round(sound + share * (centre - sound), 6), round(float(np.sqrt(share)) * std, 6)


def one_drive(t: FloatArray, signals: FloatArray, vehicle: Vehicle) -> DriveEstimates:
    """Estimates of one drive, t (T,) [s] and signals (T, 18), by quantity; what it was not excited for is left out."""
    return _quantities(prepare(t, signals, vehicle), vehicle) | lags(t, signals, vehicle)


def _quantities(drive: EvenDrive, vehicle: Vehicle) -> DriveEstimates:
    moving, axle = drive.moving > 0, fits(drive)["axle"]
    quantities: DriveEstimates = {}
    if axle.known and axle.error < 0.1:
        quantities["yaw_rate"] = -axle.offset / axle.gain
        drive = replace(drive, r=drive.r - quantities["yaw_rate"])  # else taken for offsets of steering and a_y
    quantities |= _radii(drive, vehicle) | _force_gain(drive, vehicle)
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
    """How much faster each wheel turns than the mean of the four, but for yaw and slip."""
    calm = (drive.moving > 0) & (np.abs(drive.v_dot) < CALM) & (np.abs(drive.v * drive.r) < STRAIGHT)
    calm &= np.isfinite(drive.wheels).all(axis=1) & np.isfinite(drive.r) & np.isfinite(drive.ax)
    if calm.sum() < LEAST_S * RATE_HZ:
        return {}
    half = 0.5 * np.array([-vehicle.track_front, vehicle.track_front, -vehicle.track_rear, vehicle.track_rear])
    rims = drive.wheels[calm] - half * drive.r[calm, None]
    faster = rims / rims.mean(axis=1, keepdims=True) - _slips(drive, vehicle, calm)
    ratio = np.median(faster, axis=0) - 1.0
    return {f"radius_{wheel}": float(value) for wheel, value in zip(WHEELS, ratio, strict=True)}


def _force_gain(drive: EvenDrive, vehicle: Vehicle) -> DriveEstimates:
    """Torque against what moves the file's mass, by the wheels: an accelerometer pitches with the body.

    Slope, air and rolling are beside it: they do not go with acceleration.
    """
    rows = (drive.moving > 0) & np.isfinite(drive.torque) & np.isfinite(drive.v_dot)
    if np.sum(rows & (np.abs(drive.v_dot) > PULLED)) < LEAST_S * RATE_HZ:
        return {}
    moved = vehicle.mass + 4.0 * vehicle.wheel_inertia / vehicle.wheel_radius**2
    table = np.stack([moved * drive.v_dot[rows], np.ones(int(rows.sum()))], axis=1)
    return {"force_gain": float(robust(table, drive.torque[rows] / vehicle.wheel_radius)[0])}


def _slips(drive: EvenDrive, vehicle: Vehicle, rows: BoolArray) -> FloatArray:
    """Slip of the wheels against the mean of the four, (n, 4): what drives, less what it takes to turn the others.

    The accelerometer feels the tyres' force less the air's, on slopes too; its offset is what it reads beside dv/dt.
    """
    if vehicle.drive_split_front is None:
        return np.zeros((int(rows.sum()), 4))
    offset = np.nanmedian((drive.ax - drive.v_dot)[drive.moving > 0])
    pull = drive.ax[rows] - offset + DRAG * np.square(drive.v[rows]) / vehicle.mass + ROLLING * GRAVITY
    front = np.where(pull > 0.0, vehicle.drive_split_front, BRAKED_FRONT) * pull
    share = vehicle.cg_to_rear_axle / (vehicle.cg_to_front_axle + vehicle.cg_to_rear_axle)
    turned = ROLLING * GRAVITY
    per_slip = 2.0 * vehicle.longitudinal_stiffness / vehicle.mass
    axles = np.stack([front - share * turned, pull - front - (1.0 - share) * turned], axis=1) / per_slip
    return np.repeat(axles - axles.mean(axis=1, keepdims=True), 2, axis=1)
