"""Findings of the signal doctor about constant errors: offsets of sensors, wheels of another
radius, and exchanged axles.
"""

from __future__ import annotations

from typing import Final, NamedTuple

import numpy as np

from edge_agent.inputs.doctor.diagnosis import Finding
from edge_agent.inputs.doctor.drive import RATE_HZ, EvenDrive, median_of_others
from edge_agent.inputs.doctor.identities import Fit, fit_robustly
from edge_agent.inputs.doctor.slip import RADIUS_PARTS, is_steady, spread_of_parts
from schemas.numeric import BoolArray, FloatArray
from schemas.signals import WHEELS
from schemas.vehicle import Vehicle

# Largest constant errors that come from the ordinary tilt or zero error of a device; larger ones
# are faults. In usual cars the standard deviations are 0.35 m/s^2 (a_x), 0.15 m/s^2 (a_y),
# 0.003 rad/s (yaw rate) and 0.003 to 0.015 rad (steering). Wheel radii differ by 0.15 to 1.6 %.
LARGEST_AX = 1.3  # [m/s^2]
LARGEST_AY = 0.75  # [m/s^2]
LARGEST_RATE = 0.02  # [rad/s]
LARGEST_STEER = 0.02  # [rad]
LARGEST_RADIUS = 0.025  # [1] relative difference from the other wheels
# Limit of a_x for drives of at least AVERAGED_M, over which the mean slope is below 8 %.
LARGEST_AX_FAR = 0.9  # [m/s^2]
AVERAGED_M = 300.0
# Accelerations up to which wheels hardly slip, even on ice.
CALM = 0.5  # [m/s^2] along the car
CALM_ACROSS = 0.5  # [m/s^2] across the car
# [m/s^2] largest lateral acceleration of turns in which the speeds of the two axles are compared
GENTLE_ACROSS: Final = 3.5
# (L r / v)^2 on a circle with a radius of eight wheelbases. On larger circles, slip hides the
# difference between the axles.
TIGHT = 0.015
TIGHT_S = 1.5  # [s] minimum duration of tight turns
FEWEST_OFFSET_S: Final = 8.0  # [s] minimum duration of the readings for an offset
SURE: Final = 2.0  # number of standard deviations by which an offset must exceed its limit


def find_radii(drive: EvenDrive, vehicle: Vehicle, doubts: set[str]) -> list[Finding]:
    """Return findings about wheels that turn faster or slower than the others while the car drives
    straight and calmly, and about exchanged axles.

    A tyre force changes the speed of a wheel by slip, so only moments with hardly any force count.
    An error of a wheel must also appear while the car coasts. If it does not, it is not reported,
    and the wheel speeds are added to `doubts`, the channels that are neither confirmed nor faulty.
    """
    tracks = (vehicle.track_front, vehicle.track_front, vehicle.track_rear, vehicle.track_rear)
    half = np.array([(-0.5 if i % 2 == 0 else 0.5) * tracks[i] for i in range(4)])
    calm = (
        (drive.moving > 0)
        & (np.abs(drive.v_dot) < CALM)
        & (np.abs(drive.v * drive.r) < CALM_ACROSS)
        & np.isfinite(drive.r)
        & drive.follows_steering
    )
    rims = drive.wheels - half * drive.r[:, None]
    good = np.flatnonzero(calm & np.isfinite(rims).all(axis=1))
    findings = []
    if len(good) >= 10 * RATE_HZ:
        findings = _compare_wheels(rims[good], drive.v_dot[good], doubts)
    return findings + _compare_axles(drive)


def _compare_wheels(rims: FloatArray, v_dot: FloatArray, doubts: set[str]) -> list[Finding]:
    """Return a finding for each wheel with another radius than the others, from calm moments of a
    drive: rim speeds without the part from yaw (n, 4) [m/s], and accelerations (n,) [m/s^2]. See
    `find_radii` for `doubts`.
    """
    findings = []
    coasts = v_dot < -0.1  # a wheel can spin only while it is driven
    medians = median_of_others(rims)
    for i, wheel in enumerate(WHEELS):
        other_wheels = medians[:, i]
        ratio = rims[:, i] / np.where(other_wheels == 0, np.nan, other_wheels) - 1.0
        parts = np.array(
            [float(np.nanmedian(part)) for part in np.array_split(ratio, RADIUS_PARTS)]
        )
        off = float(np.median(parts))
        if not abs(off) > LARGEST_RADIUS:  # also if `off` is NaN
            continue
        tolerance = 0.3 * abs(off)
        if coasts.sum() < 2 * RATE_HZ or abs(float(np.nanmedian(ratio[coasts])) - off) > tolerance:
            doubts.add("v")
        elif np.all(np.abs(parts - off) < tolerance):
            words = f"turns {off:+.1%} faster than the other wheels: another tyre, or its own scale"
            findings.append(Finding(f"omega_{wheel}", "radius", words, 1.0 / (1.0 + off)))
    # Three wheels cannot all differ from the median of the others. Such a result means common slip,
    # or an axle with other tyres.
    return findings if len(findings) <= 2 else []


def _compare_axles(drive: EvenDrive) -> list[Finding]:
    """Return a finding (fault) if the front and rear wheel speeds are exchanged; else an empty
    list.

    In a turn the front wheels travel further than the rear wheels: v_f² = v_r² + (L r)², with the
    speeds v_f and v_r of the axles, the wheelbase L and the yaw rate r.
    """
    front = drive.wheels[:, :2].mean(axis=1)
    rear = drive.wheels[:, 2:].mean(axis=1)
    good = (
        (drive.moving > 0)
        & np.isfinite(front)
        & np.isfinite(rear)
        & (np.abs(drive.v_dot) < 1.0)
        & (rear > 1.0)
    )
    turn = np.square(drive.wheelbase * drive.r / np.where(good, rear, 1.0))
    good &= np.isfinite(turn) & drive.follows_steering & (np.abs(drive.v * drive.r) < GENTLE_ACROSS)
    tight = good & (turn > TIGHT)
    if tight.sum() < TIGHT_S * RATE_HZ:
        return []
    x = 0.5 * turn[good]
    y = front[good] / rear[good] - 1.0
    table = np.stack([x, np.ones(len(x))], axis=1)
    solution = fit_robustly(table, y)
    spread = 1.4826 * float(np.median(np.abs(y - table @ solution)))
    count = max(len(x) / RATE_HZ, 1.0)
    error = spread / max(float(x.std()) * np.sqrt(count), 1e-12)
    if abs(solution[0] + 1.0) < 0.4 and error < 0.45:
        words = "the rear wheels travel farther in turns: front and rear exchanged?"
        return [Finding("omega", "front and rear exchanged", words)]
    return []


class _Offset(NamedTuple):
    """Measured constant error of a channel: its value and standard deviation, and the largest usual
    size, all in `unit`.
    """

    channel: str
    value: float
    error: float
    largest: float
    unit: str


def find_offsets(drive: EvenDrive, found: dict[str, Fit]) -> list[Finding]:
    """Return findings (faults) about constant errors (offsets) of sensors. An offset is a fault if
    it exceeds the largest usual offset by SURE standard deviations. `found` are the fitted
    identities by name (`identities`).
    """
    straight = (drive.moving > 0) & (np.abs(drive.v * drive.r) < 1.0)
    if np.isfinite(drive.delta).any():
        straight &= drive.follows_steering
    measured = (
        _measure_ax_offset(drive),
        _measure_ay_offset(drive, straight),
        _measure_yaw_rate_offset(drive, found, straight),
        _measure_steering_offset(found["steering"]),
    )
    return [
        Finding(
            one.channel,
            "offset",
            f"{one.value:+.3g} {one.unit}; expected about 0",
            offset=-one.value,
        )
        for one in measured
        if one is not None
        and np.isfinite(one.value)
        and abs(one.value) > one.largest + SURE * one.error
    ]


def _measure_ax_offset(drive: EvenDrive) -> _Offset | None:
    """Return the offset of a_x relative to the acceleration of the wheels; None if the car moves
    for less than FEWEST_OFFSET_S.
    """
    difference = (drive.ax - drive.v_dot)[drive.moving > 0]
    if np.isfinite(difference).sum() <= FEWEST_OFFSET_S * RATE_HZ:
        return None
    driven_m = float(np.nansum(np.abs(drive.v))) / RATE_HZ
    largest = LARGEST_AX if driven_m < AVERAGED_M else LARGEST_AX_FAR
    value = float(np.nanmedian(difference))
    return _Offset("ax", value, spread_of_parts(difference), largest, "m/s^2")


def _measure_ay_offset(drive: EvenDrive, straight: BoolArray) -> _Offset | None:
    """Return the offset of a_y relative to speed times yaw rate, at the samples (n,) at which the
    car drives `straight`; None if these are too few.
    """
    difference = (drive.ay - drive.v * drive.r)[straight]
    if np.isfinite(difference).sum() <= FEWEST_OFFSET_S * RATE_HZ:
        return None
    value = float(np.nanmedian(difference))
    return _Offset("ay", value, spread_of_parts(difference), LARGEST_AY, "m/s^2")


def _measure_yaw_rate_offset(
    drive: EvenDrive, found: dict[str, Fit], straight: BoolArray
) -> _Offset | None:
    """Return the offset of the yaw rate: relative to that of the wheels, or else its median while
    the car stands. Return None if the drive permits neither. See `find_offsets` for the arguments.
    """
    axle = found["axle"]
    if axle.is_known and abs(abs(axle.gain) - 1.0) < 0.2 and axle.correlation > 0.9:
        spread = spread_of_parts((drive.r_wheels - drive.r)[drive.moving > 0])
        error = float(np.hypot(axle.offset_error, spread))
        # If the car always turns the same way, an offset cannot be separated from a gain.
        if np.sum(straight & np.isfinite(drive.r)) < 2 * RATE_HZ:
            error = np.inf
        return _Offset("yaw_rate", -axle.offset / axle.gain, error, LARGEST_RATE, "rad/s")
    if found["lateral"].is_known and np.isfinite(drive.r).any():
        still = (drive.moving == 0) & (np.abs(drive.v) < 0.05)
        if still.sum() > RATE_HZ:
            value = float(np.nanmedian(drive.r[still]))
            return _Offset("yaw_rate", value, 0.0, LARGEST_RATE, "rad/s")
    return None


def _measure_steering_offset(steering: Fit) -> _Offset | None:
    """Return the offset of the steering angle from its fitted identity; None if the fit is
    unreliable.
    """
    is_reliable = (
        steering.is_known
        and abs(steering.correlation) > 0.9
        and 0.7 < steering.gain < 1.6
        and is_steady(steering)
    )
    if not is_reliable:
        return None
    return _Offset("delta", steering.offset, steering.offset_error, LARGEST_STEER, "rad")
