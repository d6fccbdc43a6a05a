"""Names of the columns of a signal log, and values for missing columns and readings."""

from __future__ import annotations

from collections.abc import Collection
from typing import Final

import numpy as np

from schemas.numeric import FloatArray
from schemas.signals import S, per_wheel
from schemas.vehicle import Vehicle

GROUND: Final = "gnss_speed"  # column in addition to the channels; only the signal doctor reads it
NEEDED: Final = ("ax", "ay", "yaw_rate", *per_wheel("omega"))
FRONT_STEERING: Final = per_wheel("delta")[:2]
REAR_STEERING: Final = per_wheel("delta")[2:]


def fill_steering(signals: FloatArray, columns: Collection[str]) -> bool:
    """Write steering angles into `signals` (T, 18) for the wheels that are not among the names
    `columns` of the recorded channels.

    A front wheel gets the angle of the other front wheel, a rear wheel gets zero. A wheel whose
    column exists but has no readings is not changed. Return True if only one front angle was
    recorded.
    """
    left, right, *rear = (name not in columns for name in (*FRONT_STEERING, *REAR_STEERING))
    if left:
        signals[:, S.DELTA] = signals[:, S.DELTA + 1]
    if right:
        signals[:, S.DELTA + 1] = signals[:, S.DELTA]
    for wheel, is_missing in enumerate(rear, 2):
        if is_missing:
            signals[:, S.DELTA + wheel] = 0.0
    return left != right


def split_front_angle(signals: FloatArray, vehicle: Vehicle) -> None:
    """Replace the front wheels' steering angles in `signals` (T, 18) by those of two wheels, if
    both columns contain the same measured angle, the mean of the two wheels.

    The axes of the wheels meet at one point on the line of the rear axle (Ackermann geometry), so
    the inner wheel turns more than the outer one. In a turn of 6 m radius the two angles differ by
    0.1 rad, more than the slip angle of the tyres.
    """
    slope = np.tan(signals[:, S.DELTA])
    curvature = slope / (vehicle.cg_to_front_axle + vehicle.cg_to_rear_axle)
    shift = 0.5 * vehicle.track_front * curvature
    signals[:, S.DELTA] = np.arctan2(slope, 1.0 - shift)
    signals[:, S.DELTA + 1] = np.arctan2(slope, 1.0 + shift)


def remove_null_positions(signals: FloatArray) -> None:
    """Set positions at exactly 0° latitude and 0° longitude in `signals` (T, 18) to NaN. Many
    receivers send these values while they have no fix.
    """
    place = slice(S.LATITUDE, S.LONGITUDE + 1)
    signals[(signals[:, place] == 0.0).all(axis=1), place] = np.nan
