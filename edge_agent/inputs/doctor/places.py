"""Faults of position and heading: positions in a wrong unit, exchanged latitude and longitude, or a
compass angle in place of yaw.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Final

import numpy as np

from edge_agent.inputs.doctor.diagnosis import Finding
from edge_agent.inputs.doctor.drive import CREEP, EvenDrive, EvenTimes, over_ground
from schemas.numeric import FloatArray
from schemas.signals import S

FEWEST: Final = 200  # minimum number of samples, four seconds
# Required gain in agreement with the course (mean cosine) by another interpretation of the yaw.
BETTER: Final = 0.25
SOUND: Final = 0.9  # minimum agreement with the course at which another interpretation is reported
# [rad] minimum change of both yaw and course. In a slide, the yaw changes but the course does not.
LEAST_TURN: Final = 0.5
# Exchanging latitude and longitude must reduce the spread of ground speed over wheel speed to this
# share.
STEADIER: Final = 0.5
STRAY: Final = 0.01  # largest share of positions out of range that counts as errors of transmission
# Largest |ln| of the ratio between the speed from positions and that of receiver or wheels.
PLACES_AGREE: Final = 0.4
# Angles that a log may contain in place of yaw [rad, counter-clockwise from east], each with its
# conversion to yaw.
COMPASS: Final[dict[str, Callable[[FloatArray], FloatArray]]] = {
    "compass": lambda yaw: np.pi / 2.0 - yaw,
    "deg": np.radians,
    "compass, deg": lambda yaw: np.pi / 2.0 - np.radians(yaw),
    "sign": lambda yaw: -yaw,
}


def position_findings(signals: FloatArray, drive: EvenDrive) -> list[Finding]:
    """Return findings (reported faults) about positions outside the degrees of the globe, or that
    move neither at the speed that the receiver reports nor at that of the wheels.
    """
    findings = []
    for channel, index, limit in (("latitude", S.LATITUDE, 90), ("longitude", S.LONGITUDE, 180)):
        size = np.abs(signals[:, index])
        known = size[np.isfinite(size)]
        if len(known) and np.mean(known > limit) > STRAY:
            words = f"reaches {known.max():.6g}, beyond {limit} deg: its unit?"
            findings.append(Finding(channel, "range", words))
    moves = np.isfinite(drive.v_positions) & (np.abs(drive.v) > CREEP * drive.fast)
    if findings or moves.sum() < FEWEST:
        return findings
    ratios = [
        float(np.nanmedian(drive.v_positions[moves] / np.maximum(np.abs(other[moves]), 1e-3)))
        for other in (drive.v_ground, drive.v)
    ]
    if min(abs(np.log(max(ratio, 1e-9))) for ratio in ratios) > PLACES_AGREE:
        words = f"positions move {ratios[0]:.3g} times as fast as the receiver reports: their unit?"
        findings.append(Finding("latitude", "scale", words))
    return findings


def yaw_findings(signals: FloatArray, drive: EvenDrive) -> list[Finding]:
    """Return findings (reported faults) about the yaw angle, for example that it is a compass
    angle. The angle in `signals` is compared with the course and the turns of the drive.
    """
    findings = []
    if np.isfinite(signals[:, S.LATITUDE]).sum() < 10:
        return []
    good = (
        np.isfinite(drive.course)
        & np.isfinite(drive.course_yaw)
        & (np.abs(drive.v) > 0.3 * drive.fast)
    )
    if good.sum() > FEWEST and np.ptp(np.unwrap(drive.course[good])) > 0.5:
        yaw = drive.course_yaw[good]
        course = drive.course[good]
        fits = {name: _course_agreement(convert(yaw), course) for name, convert in COMPASS.items()}
        best = max(fits, key=lambda name: fits[name])
        turns = min(_total_turn(COMPASS[best](yaw)), _total_turn(course))
        if turns > LEAST_TURN and fits[best] > max(_course_agreement(yaw, course) + BETTER, SOUND):
            words = f"agrees with the course over ground only as {best} ({fits[best]:.2f} of 1)"
            findings.append(Finding("yaw", best, words))
    return findings


def _total_turn(angle: FloatArray) -> float:
    """Return how much an angle (n,) [rad] varies over a drive: its 95 % quantile minus its 5 %
    quantile, after jumps by 2π have been removed.
    """
    unwrapped = np.unwrap(angle)
    low, high = np.percentile(unwrapped, (5, 95))
    return float(high - low)


def _course_agreement(yaw: FloatArray, course: FloatArray) -> float:
    """Return the mean cosine of the difference between the yaw angle and the course over ground,
    (n,) [rad] each. It is 1 if both are always equal.
    """
    return float(np.mean(np.cos(yaw - course)))


def has_exchanged_position(t: FloatArray, signals: FloatArray, drive: EvenDrive) -> bool:
    """Return True if the motion of the positions agrees with the wheel speeds only after latitude
    and longitude are exchanged.
    """
    latitude = signals[:, S.LATITUDE]
    longitude = signals[:, S.LONGITUDE]
    if np.isfinite(latitude).sum() < 10:
        return False
    if np.nanmax(np.abs(latitude)) > 90.0:
        return bool(np.nanmax(np.abs(longitude)) <= 90.0)
    if np.nanmax(np.abs(longitude)) > 90.0:
        return False
    good = (np.abs(drive.v) > CREEP * drive.fast) & np.isfinite(drive.v_ground) & (drive.v != 0.0)
    if good.sum() < FEWEST:
        return False
    other, course = over_ground(EvenTimes(t), longitude, latitude)

    def ratio_spread(speed: FloatArray) -> float:
        ratio = np.log(np.maximum(speed[good], 1e-3) / np.abs(drive.v[good]))
        low, high = np.percentile(ratio, (16, 84))
        return float(high - low)

    if ratio_spread(other) >= STEADIER * ratio_spread(drive.v_ground):
        return False
    turns = [
        float(np.sum(np.diff(np.unwrap(way[good])) * drive.r[good][1:]))
        for way in (drive.course, course)
    ]
    return turns[1] * turns[0] <= 0.0
