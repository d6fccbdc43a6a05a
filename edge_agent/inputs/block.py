"""Where signals come from: a recorded log, or a simulated fleet. A source gives blocks of
samples.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from schemas.numeric import FloatArray, IntArray
from schemas.thresholds import NS


@dataclass(frozen=True)
class Block:
    """Samples of N vehicles: t (T, N) [s], the same instants as time (T, N) [ns UTC], signals (T,
    N, channels).

    `context` (T, N, len(CONTEXT)) is what controllers and surroundings say; None where the source
    knows nothing of it.
    """

    t: FloatArray
    time: IntArray
    signals: FloatArray
    context: FloatArray | None = None


def to_utc_ns(t: FloatArray, start_ns: int) -> IntArray:
    """Seconds since the start as ns UTC, rounded to the ns; same shape."""
    whole = t.astype(np.int64)
    time: IntArray = start_ns + whole * NS + np.rint((t - whole) * NS).astype(np.int64)
    return time
