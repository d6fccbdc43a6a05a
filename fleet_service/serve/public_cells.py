"""Cells that readers may see where persons are kept private: a lone vehicle changes nothing. Pure.

A cell is shown as if the visits since its last publication had not happened, aged to the time of
reading. It is published again at a moment of a time grid at which LEAST vehicles have visited the
cell since, and as many have been in its tile within the running hour. So neither a cell nor its
moment points at one vehicle: one that comes late completes no count that others began. Nothing that
is more slippery than shown waits: it is published when the map is read next.

Legend
    k        LEAST, `public_vehicles` of the settings
    shown    True if a cell is public
    pending  vehicles that visited a cell since its publication, as bits
    held     row of a cell as it was published; NONE if nobody has visited it since
"""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from fleet_service.fusion import Fusion, Observations
from fleet_service.fusion.belief import SLIPPERY_SHARE, quantiles
from fleet_service.fusion.fuse import voted_keys
from fleet_service.fusion.store.records import CELL, NONE
from fleet_service.serve.map_state import tile_of
from fleet_service.serve.view import CellView, coarsen_cells, view_cells
from fleet_service.serve.visitors import Visitors, bit_of
from schemas import grid, mugrid
from schemas.numeric import IntArray
from schemas.thresholds import NS

PERIOD_NS: Final = 300 * NS  # of the time grid of publications
WINDOW_NS: Final = 3600 * NS  # in which enough vehicles must be in a tile
# A change towards slippery is published at once: P(slippery) grew, or the median fell, by as much.
# Values of visits to one surface scatter less.
MORE_SLIPPERY: Final = 0.05
LESS_MU: Final = 0.1


class PublicCells:
    """Public cells of a fusion; use it under the lock of the map.

    Args:
        fusion: owner of the cells.
        visitors: recent vehicles per cell.
        least: minimum number of vehicles of a public cell, at least 2.

    Attributes:
        visitors: see above.
    """

    def __init__(self, fusion: Fusion, visitors: Visitors, least: int) -> None:
        self._fusion = fusion
        self._least = least
        self.visitors = visitors
        self._shown = np.zeros(0, np.bool_)
        self._pending = np.zeros(0, np.uint64)
        self._held = np.zeros(0, np.int32)
        self._beliefs = np.zeros((0, mugrid.BINS), np.uint16)
        self._cells = np.zeros(0, CELL)
        self._free: list[int] = []
        self._present: dict[int, int] = {}  # vehicles per tile within the hour, as bits
        self._period = 0
        self._published: list[IntArray] = []
        self._grow()
        slots = np.arange(fusion.size)
        self._shown[slots] = visitors.count(slots, visitors.newest) >= least

    @contextmanager
    def follow(self, o: Observations) -> Iterator[None]:
        """Follow the fusion of observations, which happens within this context."""
        now = int(o.time.max(initial=0))
        self.publish(now)
        keys = voted_keys(o)
        before = np.unique(self._fusion.slots_of(keys // grid.SECTORS, keys % grid.SECTORS))
        self._hold(before[before >= 0], now)
        yield
        self.visitors.add(o)
        self._grow()
        bits = bit_of(o.vehicle)
        for sector in (o.sector, o.second):
            slots = self._fusion.slots_of(o.cell, np.maximum(sector, 0))
            mine = (sector >= 0) & (slots >= 0)
            np.bitwise_or.at(self._pending, slots[mine], bits[mine])
        tiles = grid.tile_of(o.cell)
        for tile in np.unique(tiles).tolist():
            present = int(np.bitwise_or.reduce(bits[tiles == tile]))
            self._present[tile] = self._present.get(tile, 0) | present

    def select(self, slots: IntArray, now: int) -> IntArray:
        """Return the slots that are public at `now` [ns]."""
        self.publish(now)
        slots = slots[self._shown[slots]]
        return slots[self.visitors.count(slots, now) >= self._least]

    def view(self, slots: IntArray, now: int) -> CellView:
        """Return public cells as readers see them at `now` [ns]; publish those that became more
        slippery.
        """
        waiting = np.flatnonzero(self._held[slots] != NONE)
        if len(waiting):
            current = self._fusion.beliefs(slots[waiting], now)
            with self.as_published(slots):
                published = self._fusion.beliefs(slots[waiting], now)
            worse = current @ SLIPPERY_SHARE - published @ SLIPPERY_SHARE >= MORE_SLIPPERY
            worse |= quantiles(published, (0.5,))[0] - quantiles(current, (0.5,))[0] >= LESS_MU
            self._release(np.unique(slots[waiting[worse]]))
        with self.as_published(slots):
            return coarsen_cells(view_cells(self._fusion, slots, now))

    @contextmanager
    def as_published(self, slots: IntArray) -> Iterator[None]:
        """Let the fusion hold these slots as they were published, within this context."""
        self._grow()
        slots = np.unique(slots[self._held[slots] != NONE])
        live = self._fusion.store.state.live
        beliefs = live.belief[slots].copy()
        cells = live.cells[slots].copy()
        live.belief[slots] = self._beliefs[self._held[slots]]
        live.cells[slots] = self._cells[self._held[slots]]
        try:
            yield
        finally:
            live.belief[slots] = beliefs
            live.cells[slots] = cells

    def take_published(self) -> IntArray:
        """Return the slots that were published since the last call."""
        found = np.concatenate([np.zeros(0, np.int64), *self._published])
        self._published.clear()
        return found

    def renumber(self, place: IntArray) -> None:
        """Update slots after the fusion renumbered them; `place` is the new number, -1 for
        removed ones.
        """
        self._grow(len(place))
        self._free_rows(np.flatnonzero(place < 0))
        self.visitors.renumber(place)
        stay = np.flatnonzero(place >= 0)
        self._shown = self._shown[stay]
        self._pending = self._pending[stay]
        self._held = self._held[stay]

    def publish(self, now: int) -> None:
        """Publish the cells that enough vehicles visited, if a moment of the time grid has passed
        by `now` [ns].
        """
        self._grow()
        if now // PERIOD_NS <= self._period:
            return
        is_new_hour = now // WINDOW_NS > self._period * PERIOD_NS // WINDOW_NS
        self._period = now // PERIOD_NS
        ready = [t for t, present in self._present.items() if present.bit_count() >= self._least]
        for tile in ready:
            del self._present[tile]
        if is_new_hour:
            self._present.clear()
        if ready:
            slots = np.flatnonzero(self._pending)
            slots = slots[np.isin(tile_of(self._fusion, slots), ready)]
            since = np.bitwise_count(self._pending[slots]) >= self._least
            recent = self.visitors.count(slots, now) >= self._least
            slots = slots[np.where(self._shown[slots], since, recent)]
            self._shown[slots] = True
            self._release(slots)
            self._published.append(slots)

    def _hold(self, slots: IntArray, now: int) -> None:
        """Hide slots that too few vehicles visited lately, and hold the others as they are."""
        self._grow()
        slots = slots[self._shown[slots]]
        is_public = self.visitors.count(slots, now) >= self._least
        self._shown[slots[~is_public]] = False
        self._free_rows(slots[~is_public])
        slots = slots[is_public & (self._held[slots] == NONE)]
        rows = self._take_rows(len(slots))
        live = self._fusion.store.state.live
        self._beliefs[rows] = live.belief[slots]
        self._cells[rows] = live.cells[slots]
        self._held[slots] = rows

    def _release(self, slots: IntArray) -> None:
        """Publish slots as they are now."""
        self._free_rows(slots)
        self._pending[slots] = 0

    def _free_rows(self, slots: IntArray) -> None:
        rows = self._held[slots]
        self._free += rows[rows != NONE].tolist()
        self._held[slots] = NONE

    def _take_rows(self, count: int) -> IntArray:
        if len(self._free) < count:
            known = len(self._cells)
            more = max(known, count, 64)
            self._beliefs = np.concatenate([self._beliefs, np.zeros((more, mugrid.BINS), "u2")])
            self._cells = np.concatenate([self._cells, np.zeros(more, CELL)])
            self._free += range(known, known + more)
        return np.array([self._free.pop() for _ in range(count)], np.int64)

    def _grow(self, size: int = 0) -> None:
        """Make room for new slots; the size doubles, so this is rare."""
        wanted = max(size, self._fusion.size)
        if len(self._shown) < wanted:
            self._shown = _longer(self._shown, 2 * wanted, False)
            self._pending = _longer(self._pending, 2 * wanted, 0)
            self._held = _longer(self._held, 2 * wanted, NONE)


def _longer(column: NDArray[Any], size: int, value: int) -> NDArray[Any]:
    out = np.full(size, value, column.dtype)
    out[: len(column)] = column
    return out
