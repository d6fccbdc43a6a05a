"""Code that runs before the compiled function ("kernel") of every estimator bank: it checks the
samples, and divides the vehicles equally among threads.

Threads run in parallel because kernels release the interpreter's lock and share no state.
"""

from __future__ import annotations

from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor

import numpy as np

from schemas.errors import InputError
from schemas.numeric import BoolArray, FloatArray
from schemas.signals import CHANNELS

CHANNEL_COUNT = len(CHANNELS)
DOUBLE = np.dtype(np.float64)


def check_arrays(
    t: FloatArray, signals: FloatArray, closes: BoolArray | None, count: int
) -> tuple[FloatArray, FloatArray]:
    """Check the shapes of the arrays for a bank of `count` vehicles. Return t (T, N) and signals
    (T, N, 18) as contiguous float64 arrays.

    Raises:
        InputError: shapes do not agree with the bank or with each other.
    """
    t = np.ascontiguousarray(t, DOUBLE)
    signals = np.ascontiguousarray(signals, DOUBLE)
    shape = t.shape
    if len(shape) != 2 or shape[1] != count:
        raise InputError("t", f"shape {shape} for a bank of {count}", "give (T, N)")
    if signals.shape != (*shape, CHANNEL_COUNT):
        raise InputError("signals", f"shape {signals.shape}", f"give {(*shape, CHANNEL_COUNT)}")
    if closes is not None and closes.shape != shape:
        raise InputError("closes", f"shape {closes.shape}", f"give {shape}")
    return t, signals


def in_shares(work: Callable[[int, int, int], None], count: int, threads: int) -> None:
    """Call work(share, first, last) concurrently for `threads` ranges [first, last) of vehicles.
    `share` is the index of the range. Together the ranges cover 0 to `count`.

    Raises:
        InputError: threads is below 1.
    """
    if threads < 1:
        raise InputError("threads", f"{threads} is below 1", "give at least one thread")
    if threads == 1 or count <= 1:
        return work(0, 0, count)
    threads = min(threads, count)
    cuts = [count * share // threads for share in range(threads + 1)]
    with ThreadPoolExecutor(threads) as pool:
        list(pool.map(work, range(threads), cuts[:-1], cuts[1:]))
    return None
