"""Systematic errors of one car's sensors, learned from its own drives. Each quantity gets a value
and a standard deviation.

    quantity          estimate from one drive
    radius_fl … rr    speed of the wheel relative to the mean of the four wheels, minus the
                      difference that yaw and slip explain; only at small accelerations
    ax                median of a_x − dv/dt
    ay                median of a_y − v·r, only on straights
    yaw_rate          gyroscope reading at which the wheel speeds show no yaw, by regression
    steer_offset, steer_gain, understeer    coefficients of one regression:
                      δ = gain · L r/v + understeer · v r + offset
    force_gain        torque over radius, divided by mass times acceleration, if torque is
                      recorded: errors of torque gain and mass
    wheel_lag, steer_lag    delay relative to the inertial unit: lags.py

Symbols: v speed, r yaw rate, δ steering angle, L wheelbase, a_x and a_y accelerometer readings. A
quantity that a drive does not excite enough is left out for that drive.

At a single speed, steering gain and understeer have the same effect, so their regression needs a
prior. The prior is the same for all cars, with mean and standard deviation from ERRORS. The
standard deviations of the regression include the uncertainty that remains.

Wheels slip under force. The driven axle therefore turns faster, and the other one slower. The radii
are corrected for this with the stiffness and the driven axle of the vehicle file, and with usual
air and rolling resistance.

The value of a quantity is the median over the drives. Its standard deviation has two parts. The
first is the median deviation between drives, divided by the square root of their number. That
deviation is at least `floor`, because few drives may agree by chance. The second is `bias`, the
error common to all drives (crossfall of 2.5 %, a nonlinear steering ratio, load). Both were set on
60 simulated cars with large errors, with other seeds than those of the published results.

Finally, the value is combined with the prior, unless its regression has already included this
prior. A quantity with little excitation is therefore moved towards its usual value.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Final, NamedTuple, TypeAlias

import numpy as np

from edge_agent.inputs.doctor.drive import RATE_HZ, EvenDrive, prepare_drive
from edge_agent.inputs.doctor.identities import CORRELATED_S, fit_identities, fit_robustly
from edge_agent.inputs.doctor.lags import find_lags
from schemas.errors import InputError
from schemas.numeric import BoolArray, FloatArray
from schemas.signals import WHEELS
from schemas.thresholds import GRAVITY
from schemas.vehicle import Calibration, Vehicle

CALM: Final = 0.7  # [m/s^2] longitudinal acceleration up to which wheels hardly slip
PULLED: Final = 0.5  # [m/s^2] minimum acceleration at which torque shows its gain
STRAIGHT: Final = 1.0  # [m/s^2] largest v·r on a straight
LEAST_S: Final = 10.0  # [s] minimum duration of the usable moments
STEERED_M_S: Final = 5.0  # [m/s] minimum speed at which the path shows the steering angle
LINEAR: Final = 4.0  # [m/s^2] largest v·r at which understeer is proportional to it
# [rad] minimum standard deviation of the steering angle from the regression. A steering ratio that
# varies with the angle, and tyres on slippery road, make errors of this size for seconds. With .001
# the errors of the gain were 1.7 of their standard deviations instead of 1.3, and larger by 30 %.
LEAST_ANGLE: Final = 0.003
TRACED: Final = ("steer_offset", "steer_gain", "understeer")
# Ratio of the standard deviation to the median absolute deviation of a normal distribution.
ROBUST: Final = 1.4826
UNKNOWN_SPLIT: Final = 0.003  # bias of the radii if the vehicle file does not name the driven axle
DRAG: Final = 0.4  # [kg/m] half of 1.2 kg/m^3 (air) · 0.3 (drag coefficient) · 2.2 m^2 (area)
ROLLING: Final = 0.008  # [1] rolling resistance divided by load
BRAKED_FRONT: Final = 0.7  # [1] share of the braking force at the front axle


class ErrorStatistics(NamedTuple):
    """Statistics of one quantity of the calibration, in its unit."""

    floor: float  # minimum of the standard deviation between drives
    bias: float  # standard deviation of the error that all drives of a car have in common
    usual: float  # standard deviation between cars (prior)
    mean: float = 0.0  # mean over cars (prior)


ERRORS: Final = {
    "radius": ErrorStatistics(floor=0.0004, bias=0.0001, usual=0.006),
    "ax": ErrorStatistics(floor=0.10, bias=0.02, usual=0.4),
    "ay": ErrorStatistics(floor=0.05, bias=0.25, usual=0.2),
    "yaw_rate": ErrorStatistics(floor=0.0015, bias=0.0007, usual=0.004),
    "steer_offset": ErrorStatistics(floor=0.0006, bias=0.0004, usual=0.005),
    "steer_gain": ErrorStatistics(floor=0.02, bias=0.02, usual=0.04, mean=1.0),
    "force_gain": ErrorStatistics(floor=0.02, bias=0.008, usual=0.08, mean=1.0),
    "understeer": ErrorStatistics(floor=0.0005, bias=0.0002, usual=0.001, mean=0.0005),
    "wheel_lag": ErrorStatistics(floor=0.012, bias=0.006, usual=0.04),
    "steer_lag": ErrorStatistics(floor=0.012, bias=0.009, usual=0.04),
}

DriveEstimates: TypeAlias = dict[str, float]
"""Estimates of one drive, by the name of the quantity. The key QUANTITY_std has the standard
deviation that the regression states for QUANTITY.
"""


def learn_calibration(
    drives: Sequence[tuple[FloatArray, FloatArray]], vehicle: Vehicle
) -> Calibration:
    """Return the calibration of a vehicle learned from its drives, each a pair (t (T,) [s], signals
    (T, 18)) of times and readings.

    Raises:
        InputError: no drive has enough excitation.
    """
    estimates = [one_drive(t, signals, vehicle) for t, signals in drives]
    calibration = weigh_estimates(estimates, vehicle)
    if calibration is None:
        raise InputError(
            "log",
            "no drive has enough excitation to learn from",
            "give drives with turns, straights and braking",
        )
    return calibration


def weigh_estimates(drives: Sequence[DriveEstimates], vehicle: Vehicle) -> Calibration | None:
    """Combine the estimates of several drives into one calibration (sensor errors of a car), with
    mean and standard deviation for each quantity; None if no drive has an estimate.
    """
    estimates: dict[str, list[float]] = {}
    for drive in drives:
        for name, value in drive.items():
            estimates.setdefault(name, []).append(value)
    if not estimates:
        return None
    errors = dict(ERRORS)
    if vehicle.drive_split_front is None:
        errors["radius"] = errors["radius"]._replace(bias=UNKNOWN_SPLIT)
    learned = {}
    for name, values in estimates.items():
        if name.endswith("_std"):
            continue
        kind = name.partition("_")[0] if name.startswith("radius") else name
        unknown = min(estimates.get(f"{name}_std", [0.0]))
        learned[name] = _posterior_of(errors[kind], np.array(values), unknown)
    return Calibration.model_validate({"drives": len(drives), **learned})


def surer_values(one: Calibration | None, other: Calibration | None) -> Calibration | None:
    """Combine two calibrations (sensor errors) of one car: for each quantity, return the value with
    the smaller standard deviation.
    """
    if one is None or other is None:
        return one or other
    better = {}
    for name in Calibration.model_fields.keys() - {"version", "drives"}:
        first: tuple[float, float] | None = getattr(one, name)
        second: tuple[float, float] | None = getattr(other, name)
        if first is not None and (second is None or first[1] < second[1]):
            better[name] = first
    return other.model_copy(update={**better, "drives": max(one.drives, other.drives)})


def _posterior_of(
    errors: ErrorStatistics, values: FloatArray, unknown: float
) -> tuple[float, float]:
    """Return the posterior (mean, standard deviation) of a quantity of the calibration from its
    estimates in several drives, `values` (n,), and from the statistics of its errors.

    `unknown` is the smallest standard deviation that the steering regression reports for the
    quantity; 0 for quantities from other methods. That regression already includes the prior.
    Therefore the median is moved towards the prior mean only if `unknown` is 0.
    """
    centre = float(np.median(values))
    around = ROBUST * float(np.median(np.abs(values - centre)))
    spread = max(around, errors.floor * (1.0 if len(values) > 2 else 2.0))
    std = float(np.hypot(spread / np.sqrt(len(values)), errors.bias))
    share = errors.usual**2 / (errors.usual**2 + std**2)
    if unknown:
        return round(centre, 6), round(float(np.hypot(np.sqrt(share) * std, unknown)), 6)
    mean = errors.mean + share * (centre - errors.mean)
    return round(mean, 6), round(float(np.sqrt(share)) * std, 6)


def one_drive(t: FloatArray, signals: FloatArray, vehicle: Vehicle) -> DriveEstimates:
    """Return the sensor and vehicle errors estimated from one drive, by quantity, for times t (T,)
    [s] and signals (T, 18).

    Quantities that the drive does not excite enough are left out.
    """
    return _estimate_quantities(prepare_drive(t, signals, vehicle), vehicle) | find_lags(
        t, signals, vehicle
    )


def _estimate_quantities(drive: EvenDrive, vehicle: Vehicle) -> DriveEstimates:
    moving = drive.moving > 0
    axle = fit_identities(drive)["axle"]
    quantities: DriveEstimates = {}
    if axle.is_known and axle.error < 0.1:
        quantities["yaw_rate"] = -axle.offset / axle.gain
        # Subtract the offset, which would otherwise appear as offsets of steering and a_y.
        drive = replace(drive, r=drive.r - quantities["yaw_rate"])
    quantities |= _estimate_radii(drive, vehicle) | _force_gain(drive, vehicle)
    calm = moving & np.isfinite(drive.ax) & np.isfinite(drive.v_dot)
    if calm.sum() > LEAST_S * RATE_HZ:
        quantities["ax"] = float(np.median((drive.ax - drive.v_dot)[calm]))
    straight = moving & (np.abs(drive.v * drive.r) < STRAIGHT) & np.isfinite(drive.ay)
    if straight.sum() > LEAST_S * RATE_HZ:
        quantities["ay"] = float(np.median((drive.ay - drive.v * drive.r)[straight]))
    return quantities | trace_steering(drive)


def trace_steering(drive: EvenDrive) -> DriveEstimates:
    """Return offset [rad], gain [1] and understeer gradient of the steering with their standard
    deviations, by regression of the steering angle on path curvature and lateral acceleration.
    """
    fast = np.maximum(drive.v, STEERED_M_S)
    across = drive.v * drive.r
    rows = (drive.moving > 0) & np.isfinite(drive.delta) & np.isfinite(across)
    rows &= (drive.v > STEERED_M_S) & (np.abs(across) < LINEAR)
    if rows.sum() < LEAST_S * RATE_HZ:
        return {}
    table = np.stack(
        [np.ones(int(rows.sum())), drive.wheelbase * (drive.r / fast)[rows], across[rows]], axis=1
    )
    angle = drive.delta[rows]
    residual = angle - table @ fit_robustly(table, angle)
    spread = max(ROBUST * float(np.median(np.abs(residual))), LEAST_ANGLE)
    near = np.abs(residual) <= 3.0 * spread
    usual = np.array([ERRORS[name].usual for name in TRACED])
    centre = np.array([ERRORS[name].mean for name in TRACED])
    weight = 1.0 / (CORRELATED_S * RATE_HZ * spread**2)
    information = weight * (table[near].T @ table[near]) + np.diag(1.0 / usual**2)
    covariance = np.linalg.inv(information)
    found = covariance @ (weight * (table[near].T @ angle[near]) + centre / usual**2)
    std = np.sqrt(np.diag(covariance))
    estimates = zip(TRACED, found.tolist(), std.tolist(), strict=True)
    return {
        key: value
        for name, mean, error in estimates
        for key, value in ((name, mean), (f"{name}_std", error))
    }


def _estimate_radii(drive: EvenDrive, vehicle: Vehicle) -> dict[str, float]:
    """Return, for each wheel, the relative difference between its speed and the mean speed of the
    four wheels, corrected for yaw and slip.
    """
    calm = (
        (drive.moving > 0) & (np.abs(drive.v_dot) < CALM) & (np.abs(drive.v * drive.r) < STRAIGHT)
    )
    calm &= np.isfinite(drive.wheels).all(axis=1) & np.isfinite(drive.r) & np.isfinite(drive.ax)
    if calm.sum() < LEAST_S * RATE_HZ:
        return {}
    half = 0.5 * np.array(
        [-vehicle.track_front, vehicle.track_front, -vehicle.track_rear, vehicle.track_rear]
    )
    rims = drive.wheels[calm] - half * drive.r[calm, None]
    faster = rims / rims.mean(axis=1, keepdims=True) - _wheel_slips(drive, vehicle, calm)
    ratio = np.median(faster, axis=0) - 1.0
    return {f"radius_{wheel}": float(value) for wheel, value in zip(WHEELS, ratio, strict=True)}


def _force_gain(drive: EvenDrive, vehicle: Vehicle) -> DriveEstimates:
    """Return the ratio of the measured wheel torque to the torque that would accelerate a car with
    the mass stated in the vehicle file.

    The acceleration comes from the wheel speeds, because an accelerometer tilts when the body
    pitches. Slope, air and rolling resistance do not vary with acceleration. Therefore the fit
    represents their forces by one constant term.
    """
    rows = (drive.moving > 0) & np.isfinite(drive.torque) & np.isfinite(drive.v_dot)
    if np.sum(rows & (np.abs(drive.v_dot) > PULLED)) < LEAST_S * RATE_HZ:
        return {}
    moved = vehicle.mass + 4.0 * vehicle.wheel_inertia / vehicle.wheel_radius**2
    table = np.stack([moved * drive.v_dot[rows], np.ones(int(rows.sum()))], axis=1)
    return {"force_gain": float(fit_robustly(table, drive.torque[rows] / vehicle.wheel_radius)[0])}


def _wheel_slips(drive: EvenDrive, vehicle: Vehicle, rows: BoolArray) -> FloatArray:
    """Return the slip of each wheel minus the mean slip of the four wheels, (n, 4), for the n
    samples that the mask `rows` selects. Slip is computed from the driving force and the rolling
    resistance of each axle.

    The driving force comes from the accelerometer, which measures tyre force minus air drag, also
    on slopes. The offset of the accelerometer is estimated as the difference between its reading
    and dv/dt, and subtracted.
    """
    if vehicle.drive_split_front is None:
        return np.zeros((int(rows.sum()), 4))
    offset = np.nanmedian((drive.ax - drive.v_dot)[drive.moving > 0])
    pull = (
        drive.ax[rows] - offset + DRAG * np.square(drive.v[rows]) / vehicle.mass + ROLLING * GRAVITY
    )
    front = np.where(pull > 0.0, vehicle.drive_split_front, BRAKED_FRONT) * pull
    share = vehicle.cg_to_rear_axle / (vehicle.cg_to_front_axle + vehicle.cg_to_rear_axle)
    turned = ROLLING * GRAVITY
    per_slip = 2.0 * vehicle.longitudinal_stiffness / vehicle.mass
    axles = (
        np.stack([front - share * turned, pull - front - (1.0 - share) * turned], axis=1) / per_slip
    )
    return np.repeat(axles - axles.mean(axis=1, keepdims=True), 2, axis=1)
