"""Test that identifies the front axle: it meets a bump in the road before the rear axle does.

The speed difference between the left and right wheel of an axle, minus its mean over some metres,
consists of road unevenness and noise. As a function of distance, the rear axle repeats the signal
of the front axle after one wheelbase. Therefore the correlation of both signals has a peak one
wheelbase later if the channels are named correctly, and one wheelbase earlier if front and rear are
exchanged. A smooth road gives no peak.
"""

from __future__ import annotations

from typing import Final

import numpy as np

from edge_agent.inputs.doctor.drive import JOINED_S, wheel_median
from edge_agent.inputs.doctor.lags import correlate_by_spectra
from schemas.numeric import BoolArray, FloatArray
from schemas.signals import S
from schemas.vehicle import Vehicle

STEP_M: Final = 0.25  # [m] step of the distance at which wheel speeds are compared
WINDOW: Final = 4.0  # [wheelbases] length of the running mean that is subtracted
FAST_M_S: Final = 5.0
LEAST_M: Final = 300.0  # [m] minimum driven distance at more than FAST_M_S
LEAST_LIKE: Final = 0.2  # minimum correlation at a peak
NEAR_M: Final = 0.5  # [m] largest difference between the peak's shift and the wheelbase
# Largest correlation at the mirrored shift (rear axle first), as a share of the peak.
RIVAL: Final = 0.6
# Limit of the readings in standard deviations: larger ones come from potholes or errors.
CLIPPED: Final = 3.0


def leading_axle(t: FloatArray, signals: FloatArray, vehicle: Vehicle) -> int:
    """Return 1 if the channels named "front" meet bumps first, -1 if the channels named "rear" do,
    and 0 if the drive does not show the order. `t` are times (T,) [s] and `signals` readings (T,
    18).
    """
    omega = signals[:, S.OMEGA : S.OMEGA + 4]
    good = np.isfinite(omega).all(axis=1)
    if good.sum() < 2:
        return 0
    rims = (
        np.stack([np.interp(t, t[good], omega[good, wheel]) for wheel in range(4)], axis=1)
        * vehicle.wheel_radius
    )
    speed = wheel_median(rims)
    steps = np.diff(t)
    steps = np.where(steps > JOINED_S, 0.0, steps)  # nothing is known of the way in a gap
    way = np.concatenate([[0.0], np.cumsum(np.maximum(speed[:-1], 0.0) * steps)])
    way, rows = np.unique(way, return_index=True)
    at = np.arange(0.0, way[-1], STEP_M)
    fast = np.interp(at, way, speed[rows]) > FAST_M_S
    if fast.sum() * STEP_M < LEAST_M:
        return 0
    wheelbase = vehicle.cg_to_front_axle + vehicle.cg_to_rear_axle
    front = _side_unevenness(np.interp(at, way, (rims[:, 1] - rims[:, 0])[rows]), wheelbase)
    rear = _side_unevenness(np.interp(at, way, (rims[:, 3] - rims[:, 2])[rows]), wheelbase)
    return _travel_direction(front, rear, fast, wheelbase)


def _side_unevenness(speed_difference: FloatArray, wheelbase: float) -> FloatArray:
    """Return the difference in speed (n,) between the left and right wheel of an axle, minus its
    running mean over WINDOW wheelbases. What remains is road unevenness and noise.
    """
    width = 2 * round(0.5 * WINDOW * wheelbase / STEP_M) + 1
    if width >= len(speed_difference):
        return np.zeros_like(speed_difference)
    return np.asarray(
        speed_difference - np.convolve(speed_difference, np.ones(width) / width, "same")
    )


def _travel_direction(
    front: FloatArray, rear: FloatArray, fast: BoolArray, wheelbase: float
) -> int:
    most = round(2.0 * wheelbase / STEP_M)
    among = fast.copy()
    among[:most] = False
    among[len(among) - most :] = False
    if among.sum() * STEP_M < LEAST_M or front[among].std() == 0.0 or rear[among].std() == 0.0:
        return 0
    front = np.clip(front / front[among].std(), -CLIPPED, CLIPPED)
    rear = np.clip(rear / rear[among].std(), -CLIPPED, CLIPPED)
    like = correlate_by_spectra(front, rear, among, most)[::-1]
    metres = np.arange(-most, most + 1) * STEP_M
    top = int(np.argmax(like))
    near = abs(abs(metres[top]) - wheelbase) <= NEAR_M
    mirrored = like[np.abs(metres + metres[top]) <= NEAR_M].max()
    if not near or like[top] < LEAST_LIKE or mirrored > RIVAL * like[top]:
        return 0
    return 1 if metres[top] > 0.0 else -1
