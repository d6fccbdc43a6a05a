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

from typing import Final

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
        driven = rear if split < 0.25 else 1.0 - rear if split > 0.75 else 1.0
        car = np.array([vehicle.wheel_radius, base, 0.5 * vehicle.track_front, driven])
        period = float(t[1, n] - t[0, n]) if len(t) > 1 else 0.01
        out[:, n] = _follow(np.ascontiguousarray(signals[:, n]), car, period)
    return out


@compiled
def _median(values: FloatArray, count: int) -> float:
    ordered = np.sort(values[:count])
    middle = count // 2
    return float(ordered[middle] if count % 2 else 0.5 * (ordered[middle - 1] + ordered[middle]))


@compiled
def _follow(signals: FloatArray, car: FloatArray, period: float) -> FloatArray:
    """Return the friction (T,) that ordinary ABS and ESC logic would report for one car; infinite
    where neither the slip flag nor the yaw flag is set.

    The slip flag is set while a wheel's speed differs much from the car's speed. The yaw flag is
    set while the yaw rate differs much from that expected from steering. While a flag is set, the
    friction is the car's measured acceleration divided by gravity.

    Args:
        signals: sensor readings (T, channels).
        car: wheel radius, wheelbase and half of the track [m], and the driven axle's share of the
            load.
        period: sampling interval [s].
    """
    out = np.full(signals.shape[0], np.inf)
    smooth = 1.0 - np.exp(-period / SMOOTH_S)
    rim = np.zeros(4)
    found = np.zeros(4)
    ax = ay = yaw_rate = steer = speed = 0.0
    agreed = slipping = yawing = 0.0
    since_slip = since_yaw = np.inf
    begun = False
    for k in range(signals.shape[0]):
        row = signals[k]
        if np.isfinite(row[S.AX]):
            ax += smooth * (row[S.AX] - ax)
        if np.isfinite(row[S.AY]):
            ay += smooth * (row[S.AY] - ay)
        if np.isfinite(row[S.YAW_RATE]):
            yaw_rate = row[S.YAW_RATE]
        if np.isfinite(row[S.DELTA]):
            steer = 0.5 * (row[S.DELTA] + row[S.DELTA + 1])
        count = 0
        for i in range(4):
            if np.isfinite(row[S.OMEGA + i]):
                side = -1.0 if i % 2 == 0 else 1.0
                rim[i] = row[S.OMEGA + i] * car[0] - side * car[2] * yaw_rate
                found[count] = rim[i]
                count += 1
        if count == 0:
            continue
        middle = _median(found, count)
        most = found[:count].max()
        least = found[:count].min()
        target = most if ax < -BRAKING else least if ax > BRAKING else middle
        if not begun:
            speed = middle
            begun = True
        speed = min(max(target, speed + (ax - FREE) * period), speed + (ax + FREE) * period)
        agrees = most - least < AGREE * max(middle, SLOWEST) and abs(middle - speed) < FAR * max(
            speed, SLOWEST
        )
        agreed = agreed + period if agrees else 0.0
        if agreed > AGREE_S:
            speed = middle
        v = max(speed, SLOWEST)
        slips = False
        for i in range(4):
            moves = max(rim[i], speed) > SLOWEST
            if (
                moves
                and np.isfinite(row[S.OMEGA + i])
                and abs(rim[i] - speed) > (SLIP_FRONT if i < 2 else SLIP_REAR) * v
            ):
                slips = True
        off = abs(yaw_rate - v * np.tan(steer) / car[1])
        turns = speed > SLOWEST and off > YAW_OFF + YAW_SHARE * abs(yaw_rate)
        since_slip = 0.0 if slips else since_slip + period
        slipping = slipping + period if since_slip <= GAP_S else 0.0
        since_yaw = 0.0 if turns else since_yaw + period
        yawing = yawing + period if since_yaw <= GAP_S else 0.0
        if (slipping > SLIP_S and since_slip == 0.0) or (yawing > YAW_S and since_yaw == 0.0):
            along = ax / car[3] if ax > 0.0 else ax
            out[k] = np.hypot(along, ay) / GRAVITY
    return out
