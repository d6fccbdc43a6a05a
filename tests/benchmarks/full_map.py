"""A map with many cells for benchmarks, and the memory of a service with such a map. This module
does not import Numba, like a service that takes its kernels from a shared library.
"""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from fleet_service.fusion import Fusion, Observations
from schemas import grid, mugrid
from schemas.runtime.process import trim_memory
from tests.benchmarks.measure import SEED

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
from fleet_service.app.native_library import use_service_library
use_service_library()
from tests.benchmarks.full_map import resident
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
        limited=np.zeros(rows, np.int8),
        share=np.ones(rows, np.float32),
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
