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
from typing import Final

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
    course: FloatArray
    course_yaw: FloatArray  # yaw angle of the log at the same times, not smoothed [rad]
    # 1 where the car moves and no wheel slips relative to the other wheels, else 0
    moving: FloatArray
    # 0 where all wheels spin or lock together: their speed differs from the one over ground
    grips: FloatArray
    yaw_front: FloatArray  # yaw rate from the front wheels alone [rad/s]
    yaw_rear: FloatArray  # yaw rate from the rear wheels alone [rad/s]
    wheelbase: float
    torque: FloatArray  # sum over all wheels [N·m]

    @property
    def v_dot(self) -> FloatArray:
        """Return the car's acceleration (n,) computed from the wheel speeds [m/s²]."""
        return np.asarray(np.gradient(self.v, self.t))


def smooth_twice(x: FloatArray, seconds: float = SMOOTH_S) -> FloatArray:
    """Return the evenly sampled signal x (n,) after a running mean over `seconds`, applied twice.
    The mean skips NaN.

    The result is NaN where x is NaN, or where less than about 40 % of the window is known.
    """
    width = min(max(1, round(seconds * RATE_HZ)), len(x))
    for _ in range(2):
        good = np.isfinite(x)
        total = np.convolve(np.where(good, x, 0.0), np.ones(width), "same")
        count = np.convolve(good.astype(float), np.ones(width), "same")
        x = np.where(good & (count > 0.4 * width), total / np.maximum(count, 1.0), np.nan)
    return x


def interpolate_near(t: FloatArray, x: FloatArray, at: FloatArray) -> FloatArray:
    """Return the readings x of a signal, recorded at the times `t` [s], interpolated linearly at
    the times `at` (n,) [s]. The result is NaN between two readings that are more than JOINED_S
    apart.
    """
    good = np.isfinite(x)
    if good.sum() < 2:
        return np.full(len(at), np.nan)
    known = t[good]
    values = x[good]
    place = np.clip(np.searchsorted(known, at), 1, len(known) - 1)
    near = (known[place] - known[place - 1] <= JOINED_S) & (at >= known[0]) & (at <= known[-1])
    return np.where(near, np.interp(at, known, values), np.nan)


def over_ground(
    t: FloatArray, latitude: FloatArray, longitude: FloatArray, at: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Return speed over ground [m/s] and course [rad] at the times `at` (n,) [s]. Both are computed
    from the positions FIX_S / 2 before and FIX_S / 2 after each time. `latitude` and `longitude`
    [deg] are the fixes at the times `t` [s].
    """
    north = interpolate_near(t, np.radians(latitude) * EARTH_RADIUS_M, at)
    east = interpolate_near(t, np.radians(longitude) * EARTH_RADIUS_M, at) * np.cos(
        np.radians(np.nanmean(latitude))
    )
    half = round(0.5 * FIX_S * RATE_HZ)
    speed = np.full(len(at), np.nan)
    course = np.full(len(at), np.nan)
    if len(at) > 2 * half:
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
    last = min(t[-1], t[0] + LONGEST_S)
    at = np.arange(t[0], last, 1.0 / RATE_HZ)

    def even_column(index: int) -> FloatArray:
        return smooth_twice(interpolate_near(t, signals[:, index], at))

    wheels = (
        np.stack([interpolate_near(t, signals[:, S.OMEGA + i], at) for i in range(4)], axis=1)
        * vehicle.wheel_radius
    )
    some = np.isfinite(wheels).any(axis=1)
    middle = np.full(len(at), np.nan)
    middle[some] = np.nanmedian(wheels[some], axis=1)
    raw = wheels
    wheels = np.where(
        np.abs(wheels - middle[:, None]) > 0.25 * np.abs(middle[:, None]) + 1.0, np.nan, wheels
    )
    rims = np.stack([smooth_twice(wheels[:, i]) for i in range(4)], axis=1)
    v = smooth_twice(np.where(np.isfinite(middle), middle, np.nan))
    tracks = vehicle.track_front, vehicle.track_rear
    axles = [(rims[:, 2 * k + 1] - rims[:, 2 * k]) / tracks[k] for k in range(2)]
    r_wheels = np.where(np.isfinite(axles[1]), axles[1], axles[0])
    fast = np.nanpercentile(np.abs(v), 95) if np.isfinite(v).any() else 0.0
    place = signals[:, S.LATITUDE], signals[:, S.LONGITUDE]
    located = np.isfinite(place[0]).sum() > 5
    nothing = np.full(len(at), np.nan)
    v_ground, course = over_ground(t, *place, at) if located else (nothing, nothing)
    if ground is not None and np.isfinite(ground).sum() > 5:
        v_ground = smooth_twice(interpolate_near(t, ground, at))
    yaw = signals[:, S.YAW]
    yaw_at = (
        interpolate_near(t, np.unwrap(yaw), at)
        if np.isfinite(yaw).all()
        else _nearest_yaw(t, yaw, at)
    )
    delta = signals[:, S.DELTA]
    return EvenDrive(
        t=at,
        ax=even_column(S.AX),
        ay=even_column(S.AY),
        r=even_column(S.YAW_RATE),
        delta=smooth_twice(
            interpolate_near(t, np.where(np.isfinite(delta), delta, signals[:, S.DELTA + 1]), at)
        ),
        wheels=rims,
        v=v,
        r_wheels=r_wheels,
        v_ground=v_ground,
        course=course,
        course_yaw=yaw_at,
        moving=((np.abs(v) > CREEP * fast) & ~is_slipping(raw, fast)).astype(float),
        grips=(~left_ground(v, v_ground, fast)).astype(float),
        wheelbase=vehicle.cg_to_front_axle + vehicle.cg_to_rear_axle,
        torque=smooth_twice(
            interpolate_near(t, signals[:, S.TORQUE : S.TORQUE + 4].sum(axis=1), at)
        ),
        yaw_front=axles[0],
        yaw_rear=axles[1],
    )


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
    speed = np.nanmedian(np.where(np.isfinite(wheels), wheels, 0.0), axis=1)
    size = np.maximum(np.abs(speed), CREEP * max(fast, 1e-9))
    moves = np.abs(speed) > CREEP * fast
    off = np.zeros(len(wheels), bool)
    for side in range(2):
        apart = (wheels[:, side] - wheels[:, 2 + side]) / size
        known = np.isfinite(apart) & moves
        if not known.any():
            continue
        usual = float(np.median(apart[known]))
        here = np.isfinite(apart) & (np.abs(apart - usual) > UNLIKE)
        if here[moves].mean() < 0.9:
            off |= here
    width = 2 * round(SLIP_S * RATE_HZ) + 1
    if not off.any():
        return off
    return np.asarray(np.convolve(off, np.ones(min(width, len(off))), "same") > 0.5)


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
