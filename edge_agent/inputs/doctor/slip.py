"""Tests that distinguish a sliding wheel from a faulty sensor. They look for signs of slip, and for
errors that stay constant throughout a drive.
"""

from __future__ import annotations

from typing import Final

import numpy as np

from edge_agent.inputs.doctor.drive import RATE_HZ, EvenDrive, correlate_series, smooth_twice
from edge_agent.inputs.doctor.identities import Fit
from edge_agent.inputs.doctor.lags import find_lags
from schemas.numeric import BoolArray, FloatArray
from schemas.vehicle import Vehicle

FEWEST_STEPS: Final = 5  # minimum number of sudden steps in a wheel speed for `has_equal_steps`
# Minimum number of samples in motion before a wheel that disagrees with the others counts as
# foreign.
FOREIGN_ROWS: Final = 3000
RADIUS_PARTS: Final = 4
# largest difference of ln gain at which a part of the drive agrees with the fit
STEADY: Final = 0.4
STEADY_SHARE: Final = 0.75  # minimum share of the parts that agree with the fit

# Minimum correlation of each axle's yaw rate with the gyroscope at which the signs are compared.
AXLES_LIKE: Final = 0.7
LAGS_APART_S: Final = 0.05  # [s] largest difference between the lags of the two halves of a drive
HALF_LIKE: Final = 0.7  # minimum correlation at which the lag of a half counts
# Maximum difference between the lags of the halves as a share of the lag. The halves may contain
# different numbers of bends.
LAGS_APART: Final = 0.25
# [1/m] minimum root mean square of the curvature at which a locked axle can be recognised
LEAST_CURVATURE: Final = 0.004
LOCKED_LIKE: Final = 0.75  # minimum correlation of the other axle's yaw rate with the gyroscope
LOCKED_GAIN: Final = 0.2  # largest ratio of the locked axle's yaw rate to the gyroscope's
# Minimum correlation of the yaw rate with steering or course; below it the car may spin.
TURNS_LIKE: Final = 0.8


def has_equal_steps(above: FloatArray, off: BoolArray) -> bool:
    """Return True if a wheel speed jumps away from the other wheels at least FEWEST_STEPS times, by
    one of a few fixed amounts. Such steps indicate a sensor fault, not slip.

    `above` (n,) is the wheel's speed minus that of the other wheels, and `off` (n,) is True where
    the difference is large.
    """
    enters = np.flatnonzero(~off[:-1] & off[1:])
    if len(enters) < FEWEST_STEPS:
        return False
    steps = above[enters + 1] - above[enters]
    whole = np.abs(
        above[np.minimum(enters + 2, len(above) - 1)] - above[enters + 1]
    ) < 0.1 * np.abs(steps)
    sudden = np.abs(steps) > 0.9 * np.abs(above[enters + 1])
    usual = float(np.median(np.abs(steps)))
    is_multiple = (
        np.abs(np.abs(steps) / usual - np.maximum(np.round(np.abs(steps) / usual), 1.0)) < 0.1
    )
    return bool(np.mean(sudden & is_multiple) > 0.8 and (np.mean(whole) > 0.3 or off.mean() > 0.1))


def is_foreign(rest: FloatArray, other_speed: FloatArray, off: BoolArray, fast: float) -> bool:
    """Return True if a wheel disagrees with the other three wheels most of the time while those
    agree with each other. No wheel spins for that long, so the caller reports that the signal is
    not the speed of this wheel.

    Args:
        rest: speeds of the other wheels (n, 3), in any unit.
        other_speed: common speed of the other wheels (n,), in the same unit.
        off: True where the wheel differs from `other_speed` (n,).
        fast: 95 % quantile of the car's speed in this drive, in the same unit. Samples below 0.3
            times this speed are not used.
    """
    agree = np.ptp(rest, axis=1) < 0.1 * np.abs(other_speed) + 0.02 * fast
    moves = np.abs(other_speed) > 0.3 * fast
    return bool(
        moves.sum() > FOREIGN_ROWS
        and agree[moves].mean() > 0.6
        and np.mean(off[moves & agree]) > 0.6
    )


def find_exchanged_axles(drive: EvenDrive) -> list[tuple[str, tuple[int, int]]]:
    """Return a list with the axle whose left and right wheels are exchanged, as (name, indices of
    its two wheels); an empty list if no such axle is found.

    If the sides are exchanged on both axles, the axles agree with each other, and this test finds
    nothing. The comparison of the wheels' yaw rate with the gyroscope then shows the fault.
    """

    def yaw_likeness(yaw: FloatArray) -> float:
        good = np.isfinite(yaw) & np.isfinite(drive.r) & (drive.moving > 0)
        return correlate_series(yaw[good], drive.r[good]) if good.sum() >= 10 * RATE_HZ else 0.0

    front = yaw_likeness(drive.yaw_front)
    rear = yaw_likeness(drive.yaw_rear)
    if min(abs(front), abs(rear)) < AXLES_LIKE or front * rear > 0.0:
        return []
    good = np.isfinite(drive.ay) & np.isfinite(drive.r) & (drive.moving > 0)
    steered = np.isfinite(drive.delta) & good
    sign = 0.0
    if steered.sum() > 10 * RATE_HZ:
        sign = float(
            np.sign(
                np.sum(drive.ay[good] * drive.r[good])
                * np.sum(drive.delta[steered] * drive.r[steered])
            )
        )
    if sign < 0.0:
        # The sign of a_y, yaw rate or steering is wrong, so the correct axle is unknown.
        return []
    return [("front", (0, 1))] if front < 0.0 else [("rear", (2, 3))]


def find_locked_axles(drive: EvenDrive) -> list[str]:
    """Return the axles whose wheels turn at the same speed, "front" or "rear": a locked
    differential, or one sensor for both wheels.

    An axle is reported only if the other axle agrees with the yaw rate. The fault matters because
    in a turn the wheels of a locked axle lack the usual difference in speed. A filter would
    interpret this as slip, and see a slide in every tight turn.
    """
    locked = []
    for name, own, other in (
        ("front", drive.yaw_front, drive.yaw_rear),
        ("rear", drive.yaw_rear, drive.yaw_front),
    ):
        good = np.isfinite(own) & np.isfinite(other) & np.isfinite(drive.r) & (drive.moving > 0)
        if good.sum() < 20 * RATE_HZ:
            continue
        speed = np.maximum(np.abs(drive.v[good]), 1.0)
        turns = float(np.sqrt(np.mean(np.square(drive.r[good] / speed))))
        covariance = np.cov(np.stack([drive.r[good], own[good], other[good]]) / speed)
        if turns < LEAST_CURVATURE or covariance[0, 0] <= 0.0 or covariance[2, 2] <= 0.0:
            continue
        follows = covariance[0, 2] / np.sqrt(covariance[0, 0] * covariance[2, 2])
        gain = covariance[0, 2] / covariance[0, 0]
        own_gain = covariance[0, 1] / covariance[0, 0]
        if follows > LOCKED_LIKE and 0.6 < gain < 1.6 and abs(own_gain) < LOCKED_GAIN:
            locked.append(name)
    return locked


def is_same_when_coasting(drive: EvenDrive, gain: float) -> bool:
    """Return True if the ratio of speed over ground to wheel speed equals `gain` both while the car
    gains speed and while it loses speed. Then a wrong wheel radius, and not slip, explains the
    ratio.

    Spinning wheels turn too fast while they are driven, and braked wheels turn too slowly. A wrong
    radius changes the ratio equally in both cases.
    """
    ratio = smooth_twice(drive.v_ground, 1.0) / np.where(
        drive.v == 0.0, np.nan, smooth_twice(drive.v, 1.0)
    )
    known = np.isfinite(ratio) & (drive.moving > 0)
    for rows in (known & (drive.v_dot > 0.1), known & (drive.v_dot < -0.1)):
        if rows.sum() < 2 * RATE_HZ or abs(float(np.median(ratio[rows])) / gain - 1.0) > 0.04:
            return False
    return True


def spread_of_parts(readings: FloatArray) -> float:
    """Return the variation of a quantity, given by its readings (n,), over a drive: the standard
    deviation of its medians in RADIUS_PARTS equal parts of the drive.

    A sensor error, such as a tilted mount, is about the same in all parts, so the result is small.
    A slide affects only some parts, so the result is large.
    """
    parts = [
        float(np.nanmedian(part))
        for part in np.array_split(readings, RADIUS_PARTS)
        if np.isfinite(part).any()
    ]
    return float(np.std(parts))


def is_steady(fit: Fit) -> bool:
    """Return True if the fitted gain of an identity (ratio of two quantities that are equal by
    physics) is about the same in most parts of the drive as over the complete drive.
    """
    return share_of_parts(fit, fit.gain) >= STEADY_SHARE


def share_of_parts(fit: Fit, gain: float, within: float = STEADY) -> float:
    """Return the share of a drive's parts in which the ratio of two quantities is near `gain`. Both
    quantities are equal by physics, and `fit` contains their ratio in each part. A ratio is near
    `gain` if it has the same sign and its logarithm differs by less than `within`.
    """
    if not fit.parts:
        return 0.0
    near = [g * gain > 0.0 and abs(np.log(abs(g / gain))) < within for g in fit.parts if g]
    return float(np.mean(near)) if near else 0.0


def measure_lags_twice(
    t: FloatArray, signals: FloatArray, vehicle: Vehicle, found: dict[str, Fit]
) -> dict[str, float]:
    """Return the lags [s] of the wheel speeds and of the steering behind the inertial unit.

    The lag of a device is returned only under two conditions: the yaw rate computed from the device
    follows the gyroscope's throughout the drive, and each half of the drive gives about the same
    lag as the whole drive. The two conditions reject lags that slides have distorted. In a slide,
    the car turns earlier or later than its steering predicts, by a different time in each slide.
    """
    trusted = [
        name
        for name, identity in (("wheel_lag", "axle"), ("steer_lag", "steering"))
        if _holds_with_lag(found[identity])
    ]
    whole = find_lags(t, signals, vehicle, names=trusted) if trusted else {}
    half = len(t) // 2
    halves = [
        find_lags(t[rows], signals[rows], vehicle, HALF_LIKE, tuple(whole))
        for rows in (slice(None, half), slice(half, None))
        if whole
    ]
    consistent_lags = {}
    for name in whole:
        values = [part[name] for part in (whole, *halves) if name in part]
        lag = float(np.median(values))
        tolerance = max(LAGS_APART_S, LAGS_APART * abs(lag))
        if len(values) == 1 + len(halves) and np.ptp(values) < tolerance:
            consistent_lags[name] = lag
    return consistent_lags


def _holds_with_lag(fit: Fit) -> bool:
    """Return True if an identity (two sides that are equal by physics) holds throughout a drive. A
    lag between its sides then comes from a late device and not from a slide.
    """
    return (
        fit.is_known
        and fit.correlation > TURNS_LIKE
        and abs(np.log(abs(fit.gain))) < 0.35
        and is_steady(fit)
    )
