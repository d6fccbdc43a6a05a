"""Block of samples, as every source of signals (a recorded log, a simulated fleet) delivers it."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from schemas.numeric import FloatArray, IntArray
from schemas.thresholds import NS


@dataclass(frozen=True)
class Block:
    """Samples of N vehicles: t (T, N) [s], the same instants as time (T, N) [ns UTC], signals (T,
    N, channels).

    `context` (T, N, len(CONTEXT)) has the flags of controllers and the state of the surroundings;
    None if the source has no such signals.
    """

    t: FloatArray
    time: IntArray
    signals: FloatArray
    context: FloatArray | None = None


def to_utc_ns(t: FloatArray, start_ns: int) -> IntArray:
    """Return seconds since the start as ns UTC, rounded to the ns; same shape."""
    whole = t.astype(np.int64)
    time: IntArray = start_ns + whole * NS + np.rint((t - whole) * NS).astype(np.int64)
    return time
