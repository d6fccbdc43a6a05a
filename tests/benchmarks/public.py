"""Benchmark of the privacy rules (a cell is shown only after visits of several vehicles): their
cost per cell and visit, compared with a map that shows every visit.
"""

from __future__ import annotations

from contextlib import nullcontext

import numpy as np

from fleet_service.fusion import Fusion, Observations
from fleet_service.serve.map_state import MapState
from fleet_service.serve.public_cells import PERIOD_NS, PublicCells
from fleet_service.serve.tile_cache import TileCache
from fleet_service.serve.visitors import Visitors
from schemas import grid
from schemas.numeric import IntArray
from schemas.runtime.figures import Figure
from tests.benchmarks.measure import ROUNDS, time_in_turn
from tests.fleet_service.examples import CELL, SECOND, START, observations, value

CELLS = 10_000
LEAST = 3
BATCH = 500  # visits per pass
_NOW = START + 10 * PERIOD_NS


def public() -> list[Figure]:
    """Measure a map with privacy rules, which shows a cell only after LEAST vehicles have visited
    it. Return the time [µs] to read one cell, the time [µs] to add one visit (pass of a vehicle
    through a cell), and the ratios of both times to those of a map that shows every visit at once.
    """
    private = _Map(1)
    public = _Map(LEAST)
    seen, plain = (1e6 * s / CELLS for s in time_in_turn(public.read, private.read))
    # Each measurement has one warm-up pass and ROUNDS timed passes.
    followed, fused = (1e6 * s / CELLS for s in time_in_turn(public.drive, private.drive, ROUNDS))
    return [
        Figure("bench.public.read_us", seen, "us per cell of a tile that one vehicle visited"),
        Figure(
            "bench.public.read_ratio", seen / plain, "over that of a map that shows every visit"
        ),
        Figure("bench.public.visit_us", followed, "us per visit, fusion included"),
        Figure("bench.public.visit_ratio", followed / fused, "over that of the fusion alone"),
    ]


class _Map:
    """Map of CELLS cells that readers may see. Each cell was visited by one more vehicle after its
    last publication, so that every cell has unpublished data.
    """

    def __init__(self, least: int) -> None:
        fusion = Fusion(120.0)
        self._fusion = fusion
        self._public = PublicCells(fusion, Visitors(fusion), least) if least > 1 else None
        self._tiles = TileCache(MapState(fusion), nullcontext(), least, self._public)
        self._slots = np.arange(CELLS)
        self._turn = 0
        x, y = grid.deinterleave(np.int64(CELL))
        side = int(np.sqrt(CELLS))
        self._cells: IntArray = grid.interleave(
            int(x) + self._slots % side, int(y) + self._slots // side
        )
        for vehicle in range(1, LEAST + 3):
            self._visit(vehicle, 0.0)
        shown = self._tiles.public_slots(self._slots, START + 2 * PERIOD_NS)
        assert len(shown) == CELLS, "all cells are public"
        self.drive()

    def read(self) -> None:
        """Read all published cells, as a reader of the map does."""
        self._tiles.read_cells(self._slots, _NOW)

    def drive(self) -> None:
        """Let one further vehicle visit all cells of the map."""
        self._turn += 1
        self._visit(100 + self._turn, 2 * PERIOD_NS / SECOND + self._turn)

    def _visit(self, vehicle: int, second: float) -> None:
        for cells in np.array_split(self._cells, CELLS // BATCH):
            n = len(cells)
            o: Observations = observations(
                np.full(n, second), np.full(n, vehicle), value(np.full(n, 0.8)), cells
            )
            with nullcontext() if self._public is None else self._public.follow(o):
                self._fusion.update(o)
