"""Measurement of durations: medians of rounds after a warm-up."""

from __future__ import annotations

import statistics
import time
from collections.abc import Callable

ROUNDS = 5
SEED = 0


def median_s(work: Callable[[], object], rounds: int = ROUNDS) -> float:
    """Median duration [s] after one call that warms up."""
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
    """Median durations [s] of two works in turn, after a warm-up of each, so that both see the
    same machine.
    """
    ours(), other()
    spent: tuple[list[float], list[float]] = ([], [])
    for _ in range(rounds):
        for work, times in zip((ours, other), spent, strict=True):
            began = time.perf_counter()
            work()
            times.append(time.perf_counter() - began)
    return statistics.median(spent[0]), statistics.median(spent[1])
