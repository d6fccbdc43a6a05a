"""Sensor faults as a table, which has for each kind of fault the function that applies it to a
channel's readings.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import Final

import numpy as np

from schemas.errors import InputError
from schemas.numeric import BoolArray, FloatArray
from schemas.signals import CHANNELS


@dataclass(frozen=True)
class Fault:
    """Fault of a `kind` in FAULTS on one channel for `start` <= t < `end` [s].

    A channel name without wheel, such as "omega", means all wheels. `size` is in the channel's
    unit; only the kinds "spike" and "bias" use it.
    """

    kind: str
    channel: str
    start: float = -math.inf
    end: float = math.inf
    size: float = 0.0

    def __post_init__(self) -> None:
        if self.kind not in FAULTS:
            raise InputError(
                "fault", f"there is no fault {self.kind!r}", f"choose one of {', '.join(FAULTS)}"
            )
        if not self.indices:
            raise InputError(
                "channel",
                f"there is no channel {self.channel!r}",
                f"choose one of {', '.join(CHANNELS)}",
            )

    @property
    def indices(self) -> list[int]:
        """Return the indices, in the signals' last axis, of the channels that the fault affects."""
        if self.channel in CHANNELS:  # a full name: "yaw" does not also select "yaw_rate"
            return [CHANNELS.index(self.channel)]
        return [i for i, name in enumerate(CHANNELS) if name.startswith(self.channel + "_")]


Effect = Callable[[FloatArray, BoolArray, float], None]
"""Function that applies a fault. Its arguments are the values (T,) of one channel, which it changes
in place; `when` (T,), which is True during the fault; and the size of the fault.
"""


def drop_readings(values: FloatArray, affected: BoolArray, _size: float) -> None:
    """Apply the fault "no reading": replace a channel's readings with NaN where `affected` (T,) is
    True.
    """
    values[affected] = np.nan


def hold_reading(values: FloatArray, affected: BoolArray, _size: float) -> None:
    """Apply the fault "frozen": replace a channel's readings where `affected` (T,) is True with the
    last reading before the fault.
    """
    if affected.any():
        first = int(np.argmax(affected))
        values[affected] = values[max(first - 1, 0)]


def add_spikes(values: FloatArray, affected: BoolArray, size: float) -> None:
    """Apply the fault "spikes": add `size` to every tenth reading of a channel where `affected`
    (T,) is True.
    """
    values[np.flatnonzero(affected)[::10]] += size


def add_bias(values: FloatArray, affected: BoolArray, size: float) -> None:
    """Apply the fault "offset": add the constant `size` to a channel's readings where `affected`
    (T,) is True.
    """
    values[affected] += size


FAULTS: Final[dict[str, Effect]] = {
    "dropout": drop_readings,
    "missing": drop_readings,  # during the whole drive: the vehicle does not have the channel
    "stuck": hold_reading,
    "spike": add_spikes,
    "bias": add_bias,
}


def apply_faults(t: FloatArray, signals: FloatArray, faults: tuple[Fault, ...]) -> FloatArray:
    """Return a copy of the signals (T, 18) at times t (T,) with the faults applied one after the
    other.
    """
    faulty = signals.copy()
    for fault in faults:
        affected = (t >= fault.start) & (t < fault.end)
        for i in fault.indices:
            FAULTS[fault.kind](faulty[:, i], affected, fault.size)
    return faulty
