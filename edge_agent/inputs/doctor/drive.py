"""Preparation of a recorded drive for the search for faults: signals are evenly sampled and
smoothed, and the motion is computed from the wheels alone.

Legend
    v    speed of the car from its wheels [m/s]: wheel radius of the vehicle file times the median
         of the four wheel speeds [rad/s]
    r    yaw rate [rad/s]
    r_w  yaw rate from the wheels [rad/s]: (right − left) / track width, of the rear axle, or of the
         front axle where the rear has no value
    v_g  speed over ground from position fixes [m/s]
    course  direction of travel from position fixes, counter-clockwise from east [rad]
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import Final, NamedTuple

import numpy as np

from schemas.numeric import BoolArray, FloatArray
from schemas.signals import CHANNELS, S
from schemas.thresholds import EARTH_RADIUS_M
from schemas.vehicle import Vehicle

RATE_HZ: Final = 50.0
# [s] width of the running mean, which is applied twice: the motion of cars lies below 1 Hz
SMOOTH_S: Final = 0.5
JOINED_S: Final = 1.5  # [s] no interpolation between readings that are further apart
FIX_S: Final = 1.0  # [s] interval between the two positions that give a speed and a course
TOO_FEW_FIXES: Final = 5  # number of fixes of a drive that give no speed over ground
LONGEST_S: Final = 1800.0  # [s] only this first part of a drive is examined; more adds little
# A wheel slips if it differs by more than this share from the other wheel on its side.
UNLIKE: Final = 0.1
# All wheels slip if the ratio of their speed to the speed over ground is unusual by more than this
# share.
LEFT: Final = 0.2
SLIP_S: Final = 1.0  # [s] time before and after a moment of slip that is also left out
# Share of the drive's high speed below which the car counts as standing. It does not depend on the
# unit of the wheel speeds.
CREEP: Final = 0.15
FOLLOWED: Final = 0.25  # relative difference allowed between the driven and the steered curvature


@dataclass(frozen=True)
class EvenDrive:
    """Signals of a drive, smoothed, at even time steps (n,); NaN where there is no reading. Letters
    are explained in the module's legend: v, r and course. `wheels` (n, 4) are the wheel speeds at
    the rim [m/s], `delta` is the steering angle [rad].
    """

    t: FloatArray
    ax: FloatArray
    ay: FloatArray
    r: FloatArray
    delta: FloatArray
    wheels: FloatArray
    v: FloatArray
    r_wheels: FloatArray
    v_ground: FloatArray
    v_positions: FloatArray  # speed over ground from positions alone [m/s]
    course: FloatArray
    course_yaw: FloatArray  # yaw angle of the log at the same times, not smoothed [rad]
    # 1 where the car moves and no wheel slips relative to the other wheels, else 0
    moving: FloatArray
    # 0 where all wheels spin or lock together: their speed differs from the one over ground
    grips: FloatArray
    yaw_front: FloatArray  # yaw rate from the front wheels alone [rad/s]
    yaw_rear: FloatArray  # yaw rate from the rear wheels alone [rad/s]
    fast: float  # 95 % quantile of the size of v, 0 if v is unknown
    wheelbase: float
    torque: FloatArray  # sum over all wheels [N·m]

    @cached_property
    def v_dot(self) -> FloatArray:
        """Return the car's acceleration (n,) computed from the wheel speeds [m/s²]."""
        return np.asarray(np.gradient(self.v, self.t))

    @cached_property
    def follows_steering(self) -> BoolArray:
        """Return a mask (n,) that is True at the samples at which the car turns as its steering
        predicts, that is, does not slide.
        """
        fast = np.maximum(np.abs(self.v), 1.0)
        needed_tangent = self.wheelbase * self.r / fast
        steered = np.isfinite(self.delta) & np.isfinite(needed_tangent)
        return steered & (
            np.abs(np.tan(np.clip(self.delta, -1.0, 1.0)) - needed_tangent)
            < FOLLOWED * np.abs(needed_tangent) + 0.01
        )


def smooth_twice(x: FloatArray, seconds: float = SMOOTH_S) -> FloatArray:
    """Return the evenly sampled signal x (n,) after a running mean over `seconds`, applied twice.
    The mean skips NaN.

    The result is NaN where x is NaN, or where less than about 40 % of the window is known.
    """
    width = min(max(1, round(seconds * RATE_HZ)), len(x))
    known = np.isfinite(x)
    count = sum_windows(known.astype(float), width)
    for _ in range(2):
        total = sum_windows(np.where(known, x, 0.0), width)
        good = known & (count > 0.4 * width)
        x = np.where(good, total / np.maximum(count, 1.0), np.nan)
        if (good != known).any():
            known = good
            count = sum_windows(known.astype(float), width)
    return x


def sum_windows(x: FloatArray, width: int) -> FloatArray:
    """Return the sums (n,) of the values x (n,) in a window of `width` samples around each sample.
    Sums over 1, 2, 4, ... samples are added, so that a large value changes only the windows that
    contain it.
    """
    n = len(x)
    part = np.zeros(n + width - 1)
    part[width // 2 : width // 2 + n] = x
    total = np.zeros(n)
    size = 1
    done = 0
    while done < width:
        if width & size:
            total += part[done : done + n]
            done += size
        part = part[:-size] + part[size:]
        size *= 2
    return total


def correlate_series(x: FloatArray, y: FloatArray) -> float:
    """Return the correlation coefficient of x (n,) and y (n,), or 0 if one of them is constant."""
    x = x - x.mean()
    y = y - y.mean()
    size = np.sqrt(x @ x) * np.sqrt(y @ y)
    return float(x @ y / size) if size > 0.0 else 0.0


def find_median(x: FloatArray) -> float:
    """Return the median of x (n,), which has no NaN. One partition is several times faster than
    `numpy.median`.
    """
    half = len(x) // 2
    ordered = np.partition(x, half)
    return float(ordered[half] if len(x) % 2 else 0.5 * (ordered[:half].max() + ordered[half]))


def wheel_median(wheels: FloatArray) -> FloatArray:
    """Return the median (n,) of the known values in each row of `wheels` (n, k); NaN if no value of
    the row is known.
    """
    ordered = np.sort(wheels, axis=1)  # NaN is last
    rows = np.arange(len(wheels))
    count = wheels.shape[1] - np.isnan(wheels).sum(axis=1)
    return np.asarray(0.5 * (ordered[rows, (count - 1) // 2] + ordered[rows, count // 2]))


def median_of_others(wheels: FloatArray) -> FloatArray:
    """Return, for each of the known `wheels` (n, 4), the median (n, 4) of the other three."""
    ordered = np.sort(wheels, axis=1)
    low = ordered[:, 1:2]
    return np.where(wheels <= low, ordered[:, 2:3], low)


class EvenTimes:
    """Even time steps `at` (n,) [s], at which the readings of a log with the times `t` (T,) [s] are
    interpolated. Only the first `longest` seconds of the log are used.
    """

    def __init__(self, t: FloatArray, longest: float = LONGEST_S) -> None:
        self.t = t
        self.at = np.arange(t[0], min(t[-1], t[0] + longest), 1.0 / RATE_HZ)
        if len(self.at) < 2:  # a derivative needs two samples; the log has no reading at the second
            self.at = t[0] + np.arange(2) / RATE_HZ
        self._is_covered = _is_between(t, self.at) if len(t) > 1 else np.zeros(len(self.at), bool)

    def interpolate_channel(self, x: FloatArray) -> FloatArray:
        """Return the readings x (T,) of a signal at the even time steps (n,); see
        `interpolate_near`.
        """
        if not np.isfinite(x).all():
            return interpolate_near(self.t, x, self.at)
        return np.where(self._is_covered, np.interp(self.at, self.t, x), np.nan)

    def smooth_channel(self, x: FloatArray, seconds: float = SMOOTH_S) -> FloatArray:
        """Return the readings x (T,) of a signal at the even time steps (n,), smoothed."""
        return smooth_twice(self.interpolate_channel(x), seconds)


def interpolate_near(t: FloatArray, x: FloatArray, at: FloatArray) -> FloatArray:
    """Return the readings x of a signal, recorded at the times `t` [s], interpolated linearly at
    the times `at` (n,) [s]. The result is NaN between two readings that are more than JOINED_S
    apart.
    """
    good = np.isfinite(x)
    if good.sum() < 2:
        return np.full(len(at), np.nan)
    known = t[good]
    return np.where(_is_between(known, at), np.interp(at, known, x[good]), np.nan)


def _is_between(known: FloatArray, at: FloatArray) -> BoolArray:
    """Return a mask that is True for the times `at` (n,) [s] between two of the times `known` [s]
    that are at most JOINED_S apart.
    """
    place = np.clip(np.searchsorted(known, at), 1, len(known) - 1)
    interval = np.diff(known)[place - 1]
    return np.asarray((interval <= JOINED_S) & (at >= known[0]) & (at <= known[-1]))


def over_ground(
    even: EvenTimes, latitude: FloatArray, longitude: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Return speed over ground [m/s] and course [rad] at the even time steps (n,). Both are
    computed from the positions FIX_S / 2 before and FIX_S / 2 after each time. `latitude` and
    `longitude` [deg] are the recorded fixes (T,). With TOO_FEW_FIXES or fewer, both are NaN.
    """
    if np.isfinite(latitude).sum() <= TOO_FEW_FIXES:
        return np.full(len(even.at), np.nan), np.full(len(even.at), np.nan)
    north = even.interpolate_channel(np.radians(latitude) * EARTH_RADIUS_M)
    east = even.interpolate_channel(np.radians(longitude) * EARTH_RADIUS_M) * np.cos(
        np.radians(np.nanmean(latitude))
    )
    half = round(0.5 * FIX_S * RATE_HZ)
    speed = np.full(len(north), np.nan)
    course = np.full(len(north), np.nan)
    if len(north) > 2 * half:
        d_east = east[2 * half :] - east[: -2 * half]
        d_north = north[2 * half :] - north[: -2 * half]
        speed[half:-half] = np.hypot(d_east, d_north) / FIX_S
        course[half:-half] = np.arctan2(d_north, d_east)
    return speed, course


def prepare_drive(
    t: FloatArray, signals: FloatArray, vehicle: Vehicle, ground: FloatArray | None = None
) -> EvenDrive:
    """Return the signals of a recorded drive, evenly sampled and smoothed.

    Args:
        t: times (T,) [s].
        signals: readings (T, 18); a wheel speed far from the median of the four wheels is left out.
        vehicle: its wheel radius, track widths and wheelbase are used.
        ground: speed measured by the position receiver (T,) [m/s], if it was recorded; it is more
            accurate than the speed computed from positions.
    """
    even = EvenTimes(t)
    rolling = _measure_rolling(even, signals, vehicle)
    v = rolling.v
    fast = float(np.nanpercentile(np.abs(v), 95)) if np.isfinite(v).any() else 0.0
    v_positions, course = over_ground(even, signals[:, S.LATITUDE], signals[:, S.LONGITUDE])
    v_ground = v_positions
    if ground is not None and np.isfinite(ground).sum() > TOO_FEW_FIXES:
        v_ground = even.smooth_channel(ground)
    delta = signals[:, S.DELTA]
    return EvenDrive(
        t=even.at,
        ax=even.smooth_channel(signals[:, S.AX]),
        ay=even.smooth_channel(signals[:, S.AY]),
        r=even.smooth_channel(signals[:, S.YAW_RATE]),
        delta=even.smooth_channel(np.where(np.isfinite(delta), delta, signals[:, S.DELTA + 1])),
        wheels=rolling.wheels,
        v=v,
        r_wheels=np.where(np.isfinite(rolling.yaw_rear), rolling.yaw_rear, rolling.yaw_front),
        v_ground=v_ground,
        v_positions=v_positions,
        course=course,
        course_yaw=_yaw_at_even_times(even, signals[:, S.YAW]),
        moving=((np.abs(v) > CREEP * fast) & ~is_slipping(rolling.raw, fast)).astype(float),
        grips=(~left_ground(v, v_ground, fast)).astype(float),
        fast=fast,
        wheelbase=vehicle.cg_to_front_axle + vehicle.cg_to_rear_axle,
        torque=even.smooth_channel(signals[:, S.TORQUE : S.TORQUE + 4].sum(axis=1)),
        yaw_front=rolling.yaw_front,
        yaw_rear=rolling.yaw_rear,
    )


class _Rolling(NamedTuple):
    """Motion of the wheels at the even time steps: rim speeds as recorded and smoothed without
    outliers (n, 4) [m/s], speed of the car (n,) [m/s], yaw rates of the two axles (n,) [rad/s].
    """

    raw: FloatArray
    wheels: FloatArray
    v: FloatArray
    yaw_front: FloatArray
    yaw_rear: FloatArray


def _measure_rolling(even: EvenTimes, signals: FloatArray, vehicle: Vehicle) -> _Rolling:
    """Return the motion of the wheels, from the recorded signals (T, 18). A wheel speed far from
    the median of the four wheels is left out, except in `raw`.
    """
    omega = [even.interpolate_channel(signals[:, S.OMEGA + i]) for i in range(4)]
    raw = np.stack(omega, axis=1) * vehicle.wheel_radius
    middle = wheel_median(raw)
    is_outlier = np.abs(raw - middle[:, None]) > 0.25 * np.abs(middle[:, None]) + 1.0
    plausible = np.where(is_outlier, np.nan, raw)
    wheels = np.stack([smooth_twice(plausible[:, i]) for i in range(4)], axis=1)
    yaw_front = (wheels[:, 1] - wheels[:, 0]) / vehicle.track_front
    yaw_rear = (wheels[:, 3] - wheels[:, 2]) / vehicle.track_rear
    return _Rolling(raw, wheels, smooth_twice(middle), yaw_front, yaw_rear)


def _yaw_at_even_times(even: EvenTimes, yaw: FloatArray) -> FloatArray:
    """Return the yaw angle (n,) [rad] at the even time steps, from the readings `yaw` (T,) [rad].
    Readings are interpolated if none is missing; else the nearest one counts.
    """
    if np.isfinite(yaw).all():
        return even.interpolate_channel(np.unwrap(yaw))
    return _nearest_yaw(even.t, yaw, even.at)


def is_slipping(wheels: FloatArray, fast: float) -> BoolArray:
    """Return a mask (n,) that is True where a wheel spins or locks. The function compares the wheel
    speeds with each other, so their unit does not matter.

    The front and rear wheel of a side roll nearly alike, in turns too. A constant difference
    between them is attributed to different tyres. A wheel that differs all the time is not
    compared, because the complete drive would then count as slip. Such a wheel is reported as a
    separate fault.

    Args:
        wheels: wheel speeds (n, 4), in any unit.
        fast: 95 % quantile of the car's speed in this drive, in the same unit. A car slower than
            the share CREEP of this speed counts as standing.
    """
    speed = wheel_median(np.where(np.isfinite(wheels), wheels, 0.0))
    size = np.maximum(np.abs(speed), CREEP * max(fast, 1e-9))
    moves = np.abs(speed) > CREEP * fast
    off = np.zeros(len(wheels), bool)
    for side in range(2):
        difference = (wheels[:, side] - wheels[:, 2 + side]) / size
        known = np.isfinite(difference) & moves
        if not known.any():
            continue
        usual = float(np.median(difference[known]))
        here = np.isfinite(difference) & (np.abs(difference - usual) > UNLIKE)
        if here[moves].mean() < 0.9:
            off |= here
    width = 2 * round(SLIP_S * RATE_HZ) + 1
    if not off.any():
        return off
    return sum_windows(off.astype(float), min(width, len(off))) > 0.5


def left_ground(v: FloatArray, v_ground: FloatArray, fast: float) -> BoolArray:
    """Return a mask (n,) that is True where all wheels spin or lock together. There the ratio of
    the speed over ground to the wheels' speed differs from its usual value in this drive.

    Args:
        v: speed of the wheels (n,), in any unit, because only changes of the ratio count.
        v_ground: speed over ground (n,).
        fast: 95 % quantile of the car's speed in this drive, in the unit of `v`. Samples below 0.3
            times this speed are not compared.
    """
    known = np.isfinite(v) & np.isfinite(v_ground) & (np.abs(v) > 0.3 * fast)
    if known.sum() < 5 * RATE_HZ:
        return np.zeros(len(v), bool)
    ratio = np.where(
        known,
        smooth_twice(v_ground, 1.0) / np.where(v == 0.0, np.nan, smooth_twice(v, 1.0)),
        np.nan,
    )
    usual = float(np.nanmedian(ratio))
    with np.errstate(invalid="ignore"):
        return np.asarray(np.abs(ratio - usual) > LEFT * abs(usual))


def _nearest_yaw(t: FloatArray, yaw: FloatArray, at: FloatArray) -> FloatArray:
    """Return, for each time in `at` (n,) [s], the nearest reading of the yaw angle. `yaw` are the
    readings [rad] at the times `t` [s]. They are recorded less often than other signals. They are
    not averaged, because averages of angles near ±π would be wrong.
    """
    good = np.flatnonzero(np.isfinite(yaw))
    if len(good) < 2:
        return np.full(len(at), np.nan)
    near = good[np.clip(np.searchsorted(t[good], at), 0, len(good) - 1)]
    return np.where(np.abs(t[near] - at) < JOINED_S, yaw[near], np.nan)


assert len(CHANNELS) == S.YAW + 1
