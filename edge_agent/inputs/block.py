"""Block of samples, the form in which every source of signals (a recorded log, a live source, a
simulated fleet) delivers them.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from schemas.numeric import FloatArray, IntArray
from schemas.thresholds import NS


@dataclass(frozen=True)
class Block:
    """Samples of N vehicles at T times.

    `t` (T, N) is the time in seconds [s], `time` (T, N) the same instants in [ns UTC], `signals`
    (T, N, channels) the readings of the sensors. `context` (T, N, len(CONTEXT)) has the flags of
    controllers (ABS, ESC, traction control), the air temperature and the wiper; it is None if the
    source has no such signals.
    """

    t: FloatArray
    time: IntArray
    signals: FloatArray
    context: FloatArray | None = None


def to_utc_ns(t: FloatArray, start_ns: int) -> IntArray:
    """Convert times t [s] since the start of a signal source to [ns UTC], rounded to 1 ns.
    `start_ns` is the time of the start [ns UTC]. The result has the shape of `t`.
    """
    whole = t.astype(np.int64)
    time: IntArray = start_ns + whole * NS + np.rint((t - whole) * NS).astype(np.int64)
    return time
