"""Names of the columns of a signal log, and values for missing columns and readings."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Final

import numpy as np

from schemas.numeric import FloatArray
from schemas.signals import S, per_wheel
from schemas.vehicle import Vehicle

GROUND: Final = "gnss_speed"  # column in addition to the channels; only the signal doctor reads it
NEEDED: Final = ("ax", "ay", "yaw_rate", *per_wheel("omega"))
FRONT_STEERING: Final = per_wheel("delta")[:2]
REAR_STEERING: Final = per_wheel("delta")[2:]


def fill_steering(signals: FloatArray, missing: Sequence[bool]) -> None:
    """Write steering angles into `signals` for the wheels that have no column in the log. `missing`
    (4,) is True for these wheels.

    A front wheel gets the angle of the other front wheel, a rear wheel gets zero. A wheel whose
    column exists but has no readings is not changed.
    """
    if missing[0]:
        signals[:, S.DELTA] = signals[:, S.DELTA + 1]
    if missing[1]:
        signals[:, S.DELTA + 1] = signals[:, S.DELTA]
    for wheel in (2, 3):
        if missing[wheel]:
            signals[:, S.DELTA + wheel] = 0.0


def split_front_angle(signals: FloatArray, vehicle: Vehicle) -> None:
    """Replace the front wheels' steering angles in `signals` (T, 18) by those of two wheels, if
    both columns contain the same measured angle, the mean of the two wheels.

    The axes of the wheels meet at one point on the line of the rear axle (Ackermann geometry), so
    the inner wheel turns more than the outer one. In a turn of 6 m radius the two angles differ by
    0.1 rad, more than the slip angle of the tyres.
    """
    per_metre = np.tan(signals[:, S.DELTA]) / (vehicle.cg_to_front_axle + vehicle.cg_to_rear_axle)
    nearer = 0.5 * vehicle.track_front * per_metre
    for wheel, side in ((0, 1.0), (1, -1.0)):
        signals[:, S.DELTA + wheel] = np.arctan2(
            np.tan(signals[:, S.DELTA + wheel]), 1.0 - side * nearer
        )


def remove_null_positions(signals: FloatArray) -> None:
    """Set positions at exactly 0° latitude and 0° longitude in `signals` (T, 18) to NaN. Many
    receivers send these values while they have no fix.
    """
    place = slice(S.LATITUDE, S.LONGITUDE + 1)
    signals[(signals[:, place] == 0.0).all(axis=1), place] = np.nan
