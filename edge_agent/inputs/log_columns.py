"""Names of the columns of a signal log, and steering angles for wheels without a column."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Final

from schemas.numeric import FloatArray
from schemas.signals import S, per_wheel

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
