"""Slip flag: the friction that ordinary ABS, traction control and ESC logic would report without
any estimator.

The slip flag is the baseline for the detection of slippery road. It uses the recorded wheel speeds,
accelerometers, yaw rate and steering, and the vehicle file.

    reference speed  estimate v of the car's speed. While the car brakes, v follows the fastest
                     wheel. While the car accelerates, v follows the slowest wheel. Otherwise v
                     follows the median of the wheels. The rate of change of v differs from the
                     measured a_x by at most FREE [m/s^2]. Once the speeds of all wheels have agreed
                     for AGREE_S, v is their median.
    slip flag        set if |R ω − v_i| > SLIP max(v, SLOWEST) at a wheel i for longer than SLIP_S.
                     SLIP is SLIP_FRONT or SLIP_REAR; v_i is v plus the effect of the yaw rate at
                     the wheel. A wheel is checked only if v or its own speed is above SLOWEST.
    yaw flag         set if |r − v tan δ / l| > YAW_OFF + YAW_SHARE |r| for longer than YAW_S, with
                     yaw rate r, steering angle δ and wheelbase l
    friction         |a| / g while a flag is set. While the car accelerates, a_x is first divided by
                     the share of the load on the driven wheels, because only they use grip.
"""

from __future__ import annotations

from typing import Final, NamedTuple

import numpy as np

from schemas.numeric import FloatArray
from schemas.runtime.jit import compiled
from schemas.signals import S
from schemas.thresholds import GRAVITY
from schemas.vehicle import Vehicle

SLIP_FRONT: Final = 0.08
SLIP_REAR: Final = 0.048
SLIP_S: Final = 0.12
GAP_S: Final = 0.10  # [s] shorter gaps, which anti-lock control causes, do not end a flag
YAW_OFF: Final = 0.1  # [rad/s]
YAW_SHARE: Final = 0.12
YAW_S: Final = 0.15
FREE: Final = 1.0  # [m/s^2]
AGREE: Final = 0.04
AGREE_S: Final = 0.3
# Relative difference from the reference speed beyond which equal wheel speeds are ignored, because
# all wheels may slide.
FAR: Final = 0.15
SLOWEST: Final = 1.5  # [m/s]
SMOOTH_S: Final = 0.1
BRAKING: Final = 0.6  # [m/s^2]
FLAGGED_MU: Final = 0.35  # a lower flagged friction reports the road as slippery


class CarGeometry(NamedTuple):
    """Vehicle data of the slip flag: wheel radius, wheelbase and half of the track [m], and the
    driven axle's share of the load.
    """

    radius: float
    base: float
    half_track: float
    driven: float


class InertialReading(NamedTuple):
    """Latest accelerations [m/s^2], smoothed, and latest yaw rate [rad/s] and steering angle [rad]
    of a car.
    """

    ax: float
    ay: float
    yaw_rate: float
    steer: float


class FlagTimer(NamedTuple):
    """Time [s] for which the cause of a flag has lasted, short gaps included, and time [s] since
    the cause was last present.
    """

    lasted: float
    since: float


def friction_flagged(t: FloatArray, signals: FloatArray, vehicles: list[Vehicle]) -> FloatArray:
    """Return the friction (T, N) that ordinary ABS and ESC logic would report from wheel slip and
    yaw rate; infinite where no flag is set.

    Args:
        t: (T, N) [s].
        signals: sensor readings (T, N, channels); NaN is a missing reading.
        vehicles: the N vehicle files that the cars' controllers know.
    """
    out = np.empty(t.shape)
    for n, vehicle in enumerate(vehicles):
        split = 0.5 if vehicle.drive_split_front is None else vehicle.drive_split_front
        base = vehicle.cg_to_front_axle + vehicle.cg_to_rear_axle
        rear = vehicle.cg_to_front_axle / base
        driven = 1.0
        if split < 0.25:
            driven = rear
        elif split > 0.75:
            driven = 1.0 - rear
        car = CarGeometry(vehicle.wheel_radius, base, 0.5 * vehicle.track_front, driven)
        period = float(t[1, n] - t[0, n]) if len(t) > 1 else 0.01
        out[:, n] = _flag_friction(np.ascontiguousarray(signals[:, n]), car, period)
    return out


@compiled
def _flag_friction(signals: FloatArray, car: CarGeometry, period: float) -> FloatArray:
    """Return the friction (T,) that ordinary ABS and ESC logic would report for one car; infinite
    where neither the slip flag nor the yaw flag is set.

    Args:
        signals: sensor readings (T, channels).
        car: vehicle data.
        period: sampling interval [s].
    """
    out = np.full(signals.shape[0], np.inf)
    rim = np.empty(4)
    inertial = InertialReading(0.0, 0.0, 0.0, 0.0)
    slip = FlagTimer(0.0, np.inf)
    yaw = FlagTimer(0.0, np.inf)
    speed = np.nan
    agreed = 0.0
    for k in range(signals.shape[0]):
        inertial = _read_inertial(signals[k], inertial, period)
        _read_rims(signals[k], car, inertial.yaw_rate, rim)
        if np.isnan(rim).all():
            continue
        speed, agreed = _follow_rims(speed, agreed, rim, inertial.ax, period)
        slip = _advance_timer(slip, _slips(rim, speed), period)
        yaw = _advance_timer(yaw, _turns_unexpectedly(inertial, speed, car.base), period)
        slip_flag = slip.since == 0.0 and slip.lasted > SLIP_S
        yaw_flag = yaw.since == 0.0 and yaw.lasted > YAW_S
        if slip_flag or yaw_flag:
            ax = inertial.ax
            along = ax / car.driven if ax > 0.0 else ax
            out[k] = np.hypot(along, inertial.ay) / GRAVITY
    return out


@compiled
def _read_inertial(row: FloatArray, before: InertialReading, period: float) -> InertialReading:
    """Return the inertial reading after one sample `row` (channels,), of which NaN is missing."""
    smooth = 1.0 - np.exp(-period / SMOOTH_S)
    ax, ay, yaw_rate, steer = before
    if np.isfinite(row[S.AX]):
        ax += smooth * (row[S.AX] - ax)
    if np.isfinite(row[S.AY]):
        ay += smooth * (row[S.AY] - ay)
    if np.isfinite(row[S.YAW_RATE]):
        yaw_rate = row[S.YAW_RATE]
    if np.isfinite(row[S.DELTA]):
        steer = 0.5 * (row[S.DELTA] + row[S.DELTA + 1])
    return InertialReading(ax, ay, yaw_rate, steer)


@compiled
def _read_rims(row: FloatArray, car: CarGeometry, yaw_rate: float, rim: FloatArray) -> None:
    """Write the speeds of the wheel rims [m/s] without the effect of the yaw rate to `rim` (4,),
    NaN where the reading is missing.
    """
    for i in range(4):
        rim[i] = np.nan
        if np.isfinite(row[S.OMEGA + i]):
            side = -1.0 if i % 2 == 0 else 1.0
            rim[i] = row[S.OMEGA + i] * car.radius - side * car.half_track * yaw_rate


@compiled
def _follow_rims(
    speed: float, agreed: float, rim: FloatArray, ax: float, period: float
) -> tuple[float, float]:
    """Return the reference speed [m/s] after one sample, and the time [s] for which the speeds of
    all wheels have agreed. At least one wheel speed in `rim` (4,) must be known.

    `speed` and `agreed` are the previous results, NaN and 0 at the start, and `ax` the measured
    acceleration [m/s^2].
    """
    middle = np.nanmedian(rim)
    most = np.nanmax(rim)
    least = np.nanmin(rim)
    target = middle
    if ax < -BRAKING:
        target = most
    elif ax > BRAKING:
        target = least
    if np.isnan(speed):
        speed = middle
    speed = min(max(target, speed + (ax - FREE) * period), speed + (ax + FREE) * period)
    are_equal = most - least < AGREE * max(middle, SLOWEST)
    is_near = abs(middle - speed) < FAR * max(speed, SLOWEST)
    agreed = agreed + period if are_equal and is_near else 0.0
    if agreed > AGREE_S:
        speed = middle
    return speed, agreed


@compiled
def _slips(rim: FloatArray, speed: float) -> bool:
    """Return True if the speed of a wheel's rim differs much from the reference speed [m/s]."""
    for i in range(4):
        if np.isnan(rim[i]) or max(rim[i], speed) <= SLOWEST:
            continue
        limit = SLIP_FRONT if i < 2 else SLIP_REAR
        if abs(rim[i] - speed) > limit * max(speed, SLOWEST):
            return True
    return False


@compiled
def _turns_unexpectedly(inertial: InertialReading, speed: float, base: float) -> bool:
    """Return True if the yaw rate differs much from the one that the steering angle causes at the
    reference speed [m/s] of a car with the wheelbase `base` [m].
    """
    expected = max(speed, SLOWEST) * np.tan(inertial.steer) / base
    limit = YAW_OFF + YAW_SHARE * abs(inertial.yaw_rate)
    return bool(speed > SLOWEST and abs(inertial.yaw_rate - expected) > limit)


@compiled
def _advance_timer(timer: FlagTimer, is_present: bool, period: float) -> FlagTimer:
    """Return the timer after one sample. A gap of at most GAP_S does not end the cause."""
    since = 0.0 if is_present else timer.since + period
    return FlagTimer(timer.lasted + period if since <= GAP_S else 0.0, since)
