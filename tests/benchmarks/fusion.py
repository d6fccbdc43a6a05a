"""Benchmark of the fusion (the map's computation from observations): processor time per observation
on one thread. It includes updates of beliefs, commits (final storage of older observations) and the
computation of trust in vehicles.
"""

from __future__ import annotations

import statistics
import subprocess
import sys
import time
from typing import Any

import numpy as np
from numba import njit, types
from numba.typed import Dict

from fleet_service.fusion.store.store import Store
from schemas import grid
from schemas.numeric import IntArray
from schemas.runtime.figures import Figure
from tests.benchmarks.full_map import (
    BATCH,
    CELLS,
    RESIDENT,
    fill_fusion,
    make_visits,
    split_batches,
)
from tests.benchmarks.measure import ROUNDS, SEED, time_in_turn


def per_observation_s(cells: int, per_s: int = 5_000) -> float:
    """Return the processor time per observation [s] of a map computation (`Fusion`) with `cells`
    cells, the median over ROUNDS simulated minutes.
    """
    fusion, rng = fill_fusion(cells, 1, 600.0)
    spent = []
    for minute in range(ROUNDS + 3):  # the first three passes fill the window
        parts = list(
            split_batches(make_visits(rng, 60 * per_s, cells, 660.0 + 60.0 * minute, 60.0))
        )
        began = time.process_time()
        for part in parts:
            fusion.update(part)
        spent.append((time.process_time() - began) / (60 * per_s))
    return statistics.median(spent[3:])


def table_vs_dict() -> float:
    """Compare the look-up of BATCH keys among 10⁶ stored keys in two hash tables: numba's typed
    dictionary, and the table of the product's map store. Return the time of the dictionary divided
    by the time of the map store's table.
    """
    keys = np.random.default_rng(SEED).permutation(CELLS) * grid.SECTORS
    turns = np.random.default_rng(SEED + 1).choice(keys, (100, BATCH))
    store = Store()
    known = Dict.empty(types.int64, types.int64)
    store.slots_for(keys)
    _fill_dict(known, keys)

    def look_up_in_table() -> None:
        for turn in turns:
            store.slots_of(turn)

    def look_up_in_dict() -> None:
        for turn in turns:
            _look_up(known, turn)

    ours, other = time_in_turn(look_up_in_table, look_up_in_dict)
    return other / ours


@njit
def _fill_dict(known: Any, keys: IntArray) -> None:  # noqa: ANN401 Numba has no types
    for slot in range(len(keys)):
        known[keys[slot]] = slot


@njit
def _look_up(known: Any, keys: IntArray) -> IntArray:  # noqa: ANN401 Numba has no types
    out = np.empty(len(keys), np.int64)
    for i in range(len(keys)):
        out[i] = known.get(keys[i], -1)
    return out


def fusion() -> list[Figure]:
    """Run the benchmarks of the map computation (fusion): observations per second with 10⁶ cells,
    slowdown with more cells, and memory. Return the figures.
    """
    few = per_observation_s(10_000)
    many = per_observation_s(CELLS)
    command = [sys.executable, "-c", RESIDENT]
    megabytes, _ = subprocess.run(
        command, check=True, capture_output=True, text=True
    ).stdout.split()
    return [
        Figure(
            "bench.fusion.per_s", 1.0 / many, "observations/s, commits included", 1_000_000, "more"
        ),
        Figure(
            "bench.fusion.table_vs_dict",
            table_vs_dict(),
            "times the look-up of a typed dictionary",
            1.5,
            "more",
        ),
        Figure("bench.growth.cells_ratio", many / few, "cost in 10^6 cells over that in 10^4", 1.3),
        Figure(
            "bench.state.resident_mb",
            float(megabytes),
            "MB, a service's process with 10^6 cells",
            350,
        ),
    ]
