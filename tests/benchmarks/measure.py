"""Functions that measure durations (medians of rounds after a warm-up) and memory."""

from __future__ import annotations

import gc
import statistics
import time
from collections.abc import Callable
from pathlib import Path

ROUNDS = 5
SEED = 0


def median_s(work: Callable[[], object], rounds: int = ROUNDS) -> float:
    """Return the median duration [s] of `rounds` calls of the function `work`, after one call as a
    warm-up.
    """
    work()
    spent = []
    for _ in range(rounds):
        began = time.perf_counter()
        work()
        spent.append(time.perf_counter() - began)
    return statistics.median(spent)


def time_in_turn(
    ours: Callable[[], object], other: Callable[[], object], rounds: int = ROUNDS
) -> tuple[float, float]:
    """Call the functions `ours` and `other` alternately, `rounds` times each, after a warm-up.
    Return the median duration [s] of each function.
    """
    ours(), other()
    spent: tuple[list[float], list[float]] = ([], [])
    for _ in range(rounds):
        for work, times in zip((ours, other), spent, strict=True):
            began = time.perf_counter()
            work()
            times.append(time.perf_counter() - began)
    return statistics.median(spent[0]), statistics.median(spent[1])


def read_resident_bytes() -> int:
    """Return the resident memory of this process [bytes], after a garbage collection."""
    gc.collect()
    lines = Path("/proc/self/status").read_text().splitlines()
    return next(int(line.split()[1]) for line in lines if line.startswith("VmRSS:")) * 1024
