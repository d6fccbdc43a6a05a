"""Benchmark of the fusion (the map's computation from observations): processor time per observation
on one thread. It includes updates of beliefs, commits (final storage of older observations) and the
computation of trust in vehicles.
"""

from __future__ import annotations

import statistics
import subprocess
import sys
import time
from collections.abc import Iterator
from typing import Any

import numpy as np
from numba import njit, types
from numba.typed import Dict

from fleet_service.fusion import Fusion, Observations
from fleet_service.fusion.store.store import Store
from schemas import grid, mugrid
from schemas.numeric import IntArray
from schemas.runtime.figures import Figure
from schemas.runtime.process import trim_memory
from tests.benchmarks.measure import ROUNDS, SEED, time_in_turn

BATCH = 5_000  # rows that a loaded service processes per pass of its main loop
VEHICLES = 5_000
EXCITED = 1 / 9  # share of visits that measure the friction
SECOND = 10**9
START = 1_800_000_000 * SECOND
CELLS = 1_000_000
RESIDENT = """
from fleet_service.app import UNUSED
from schemas.runtime.process import limit_memory
limit_memory(*UNUSED)  # as a service's process begins
from tests.benchmarks.fusion import resident
resident()
"""


def make_visits(
    rng: np.random.Generator, rows: int, cells: int, begin_s: float, seconds: float
) -> Observations:
    """Return `rows` visits (passes of a vehicle through a cell) to random cells of a square of
    `cells` cells, at random times within `seconds`, in order of time.
    """
    side = int(np.ceil(np.sqrt(cells)))
    x, y = grid.deinterleave(grid.cell_of(57.7, 11.97))
    k = rng.integers(0, cells, rows)
    vehicle = rng.integers(0, VEHICLES, rows)
    cell = grid.interleave(x + k % side, y + k // side)
    time_ns = START + np.sort(((begin_s + seconds * rng.random(rows)) * SECOND).astype(np.int64))
    mu = rng.uniform(0.2, 0.9, rows)[:, None]
    value = -0.5 * np.square((mugrid.CENTRES - mu) / 0.06)
    bound = np.where(0.4 * mu > mugrid.CENTRES, -6.0, 0.0)
    evidence = mugrid.encode_log_likelihood(
        np.where((rng.random(rows) < EXCITED)[:, None], value, bound)
    )
    return Observations(
        time=time_ns,
        cell=cell,
        sector=np.zeros(rows, np.int8),
        second=np.full(rows, -1, np.int8),
        vehicle=vehicle,
        boot=vehicle + 1,
        region=grid.region_of(cell),
        sequence=np.arange(rows),
        evidence=evidence,
        reported=np.full((rows, 3), np.nan, np.float32),
        used=np.full(rows, 0.9, np.float32),
        manoeuvre=np.full(rows, -1, np.int8),
        limited=np.zeros(rows, np.bool_),
        other=np.full((rows, 1), -1),
        other_share=np.zeros((rows, 1), np.float32),
    )


def fill_fusion(cells: int, per_cell: int, seconds: float) -> tuple[Fusion, np.random.Generator]:
    """Fill a new map computation (`Fusion`) with `per_cell` visits in each of `cells` cells. Return
    it, together with the random generator that drew the visits.
    """
    rng = np.random.default_rng(SEED)
    fusion = Fusion(120.0)
    parts = max(cells * per_cell // 100_000, 1)
    for part in range(parts):
        for batch in split_batches(
            make_visits(
                rng, cells * per_cell // parts, cells, part * seconds / parts, seconds / parts
            )
        ):
            fusion.update(batch)
    return fusion, rng


def split_batches(o: Observations) -> Iterator[Observations]:
    """Yield the observations `o` in batches. Each batch has as many observations as the service
    processes in one pass of its main loop.
    """
    for rows in np.array_split(np.arange(len(o.time)), max(len(o.time) // BATCH, 1)):
        yield o.take(rows)


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


def resident() -> None:
    """Print the resident memory [MB] of a service's process with 10⁶ map cells. Vehicles visited
    each of these cells three times in a day.
    """
    import fleet_service.app.service  # noqa: F401 a service has loaded it
    from fleet_service.serve.map_state import MapState

    fusion, _ = fill_fusion(CELLS, 3, 86_400.0)
    MapState(fusion).tiles()
    trim_memory()  # the service's background jobs also do this
    with open("/proc/self/status") as status:  # noqa: PTH123
        kilobytes = next(int(line.split()[1]) for line in status if line.startswith("VmRSS"))
    print(kilobytes * 1024 / 1e6, fusion.size)


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
            400,
        ),
    ]
