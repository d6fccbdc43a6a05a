"""Cells that readers may see in a service that protects the privacy of persons: the passage of a
single vehicle changes nothing that is visible. Pure (no I/O).

Readers see a copy of the map. Cells are copied only at fixed times (every PERIOD_NS). A cell is
copied on two conditions. At least LEAST vehicles have visited the cell since its last copy, and at
least LEAST vehicles have been in its tile within the current hour. So neither the cell nor the time
of the copy points to one vehicle. Between copies, readers see the cell without the newer visits,
with its belief predicted to the time of reading. There is one exception for safety: a cell that has
become more slippery than shown is copied at once.

Legend
    LEAST    minimum number of vehicles: `public_vehicles` in the settings
    shown    True if a cell is public
    pending  set of the vehicles that visited a cell since its last copy, one bit per vehicle; a few
             vehicles may have the same bit
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from fleet_service.fusion import Fusion, Observations
from fleet_service.fusion.belief import FULL, quantiles
from fleet_service.fusion.fuse import voted_keys
from fleet_service.fusion.store.cells import Cells, cells_of, no_beliefs, rows_of_lines
from fleet_service.fusion.store.records import CELL, Rows
from fleet_service.serve.map_state import tile_of
from fleet_service.serve.visitors import Visitors, bit_of
from schemas import grid, mugrid
from schemas.numeric import FloatArray, IntArray
from schemas.thresholds import NS

PERIOD_NS: Final = 300 * NS  # [ns] time between two publications
WINDOW_NS: Final = 3600 * NS  # [ns] time within which enough vehicles must have visited a tile
# A cell is published at once if its P(slippery) rises, or its median falls, by at least this.
# Visits to one unchanged surface differ less.
MORE_SLIPPERY: Final = 0.05
LESS_MU: Final = 0.1
# names of tables in the result of `columns`
WAITING: Final = "waiting"
PRESENT: Final = "present"


class PublicCells:
    """Public copy of the cells of a fusion (beliefs about the friction of all cells); use it only
    while holding the lock of the map.

    Args:
        fusion: owner of the cells.
        visitors: recent vehicles per cell.
        least: minimum number of vehicles of a public cell, at least 2.
        tables: result of `columns` from a checkpoint (saved state of a service); None for a new
            start.

    Attributes:
        visitors: recent vehicles per cell.
    """

    def __init__(
        self,
        fusion: Fusion,
        visitors: Visitors,
        least: int,
        tables: Mapping[str, dict[str, IntArray]] | None = None,
    ) -> None:
        self._fusion = fusion
        self._least = least
        self.visitors = visitors
        self._rows = Rows(no_beliefs(0), np.zeros(0, CELL), fusion.store.state.live.reporters)
        self._shown = np.zeros(0, np.bool_)
        self._pending = np.zeros(0, np.uint64)
        self._size = 0  # number of slots in use
        self._present: dict[int, int] = {}  # set of vehicles of the hour per tile, as bits
        self._period = 0
        self._published: list[IntArray] = []
        self._add_slots()
        slots = np.arange(fusion.size)
        self._copy(slots)
        self._shown[slots] = visitors.count(slots, visitors.newest) >= least
        if tables:
            self._restore(tables)

    @property
    def live(self) -> Cells:
        """Return the cells in the state in which they were last copied for readers. The result also
        has rows of cells that are not public; these must not be shown to readers.
        """
        self._add_slots()
        return cells_of(self._rows)

    def beliefs(self, slots: IntArray, now: int) -> FloatArray:
        """Return the belief about the road (32 probabilities of μ) for each slot (cell and heading
        sector), (k, 32), as readers may see it at `now` [ns].
        """
        self._add_slots()
        return self._fusion.beliefs(slots, now, self._rows)

    def slots_of(self, cell: IntArray, sector: IntArray) -> IntArray:
        """Return the slot (row number) (n,) of each cell and heading sector; -1 if no vehicle has
        reported it.
        """
        return self._fusion.slots_of(cell, sector)

    @contextmanager
    def follow(self, observations: Observations) -> Iterator[None]:
        """Provide a context in which the caller adds `observations` to the beliefs about friction;
        at the end of the context, update the public copy of the cells.
        """
        now = int(observations.time.max(initial=0))
        self.publish(now)
        yield
        self.visitors.add(observations)
        self._add_slots()
        bits = bit_of(observations.vehicle)
        for sector in (observations.sector, observations.second):
            slots = self._fusion.slots_of(observations.cell, np.maximum(sector, 0))
            is_known = (sector >= 0) & (slots >= 0)
            np.bitwise_or.at(self._pending, slots[is_known], bits[is_known])
        tiles = grid.tile_of(observations.cell)
        for tile in np.unique(tiles).tolist():
            present = int(np.bitwise_or.reduce(bits[tiles == tile]))
            self._present[tile] = self._present.get(tile, 0) | present
        keys = voted_keys(observations)
        voted = np.unique(self._fusion.slots_of(keys // grid.SECTORS, keys % grid.SECTORS))
        self._copy_more_slippery(voted[voted >= 0], now)

    def select(self, slots: IntArray, now: int) -> IntArray:
        """Return those of the slots that are public at `now` [ns]."""
        self.publish(now)
        return slots[self._shown[slots]]

    def take_published(self) -> IntArray:
        """Return the slots that were copied for readers since the last call."""
        found = np.concatenate([np.zeros(0, np.int64), *self._published])
        self._published.clear()
        return found

    def renumber(self, place: IntArray) -> None:
        """Update the slot numbers after the slots were renumbered; `place` contains the new
        numbers, -1 for removed slots.
        """
        self.visitors.renumber(place)
        stay = np.flatnonzero(place[: self._size] >= 0)
        self._take_rows(stay)
        self._size = len(stay)

    def publish(self, now: int) -> None:
        """Copy the cells that enough vehicles have visited to the public copy, which readers see.
        Do this once in each period of PERIOD_NS: if no period has ended since the last call, change
        nothing. `now` is the present time [ns].
        """
        self._add_slots()
        if now // PERIOD_NS <= self._period:
            return
        is_new_hour = now // WINDOW_NS > self._period * PERIOD_NS // WINDOW_NS
        self._period = now // PERIOD_NS
        ready = [t for t, present in self._present.items() if present.bit_count() >= self._least]
        for tile in ready:
            del self._present[tile]
        if is_new_hour:
            self._present.clear()
            # Vehicles may have left the time window meanwhile, so count them again.
            slots = np.flatnonzero(self._shown)
            self._shown[slots] = self.visitors.count(slots, now) >= self._least
        if ready:
            slots = np.flatnonzero(self._pending)
            slots = slots[np.isin(tile_of(self._fusion, slots), ready)]
            since = np.bitwise_count(self._pending[slots]) >= self._least
            recent = self.visitors.count(slots, now) >= self._least
            slots = slots[np.where(self._shown[slots], since, recent)]
            self._shown[slots] = True
            self._pending[slots] = 0
            self._copy(slots)
            self._published.append(slots)

    def columns(self) -> dict[str, dict[str, IntArray]]:
        """Return the state as tables of integer columns for a checkpoint. They contain the cells
        whose public copy differs from the true beliefs, and the recent vehicles of each tile. The
        tables do not include the counts of `visitors`.
        """
        self._add_slots()
        used = slice(self._size)
        live = self._fusion.store.state.live
        waits = self._pending[used] != 0
        waits |= (self._rows.belief[used] != live.belief[used]).any(axis=1)
        waits |= self._rows.cells["visits"][used] != live.cells["visits"][used]
        slots = np.flatnonzero(waits)
        parts = (
            slots[:, None],
            self._shown[slots, None].astype(np.int64),
            self._pending[slots, None].view(np.int64),
            self._rows.belief[slots].view(np.int64),
            self._rows.cells[slots, None].view(np.int64),
        )
        tiles = np.array(list(self._present), np.int64)
        present = {
            "tile": tiles,
            "bits": np.array(list(self._present.values()), np.uint64).view(np.int64),
            "period": np.full(len(tiles), self._period),
        }
        return {WAITING: {"rows": np.concatenate(parts, axis=1).reshape(-1)}, PRESENT: present}

    def _restore(self, tables: Mapping[str, dict[str, IntArray]]) -> None:
        """Restore the public copy of the cells from the tables that `columns` returned."""
        belief = mugrid.BINS * FULL.itemsize // 8
        numbers = tables[WAITING]["rows"].reshape(-1, 3 + belief + CELL.itemsize // 8)
        slots = numbers[:, 0]
        self._shown[slots] &= numbers[:, 1] > 0
        self._pending[slots] = numbers[:, 2].view(np.uint64)
        self._rows.belief[slots] = numbers[:, 3 : 3 + belief].copy().view(np.uint16)
        self._rows.cells[slots] = numbers[:, 3 + belief :].copy().view(CELL)[:, 0]
        present = tables[PRESENT]
        bits = present["bits"].view(np.uint64)
        self._present = dict(zip(present["tile"].tolist(), bits.tolist(), strict=True))
        self._period = int(present["period"].max(initial=0))

    def _copy_more_slippery(self, slots: IntArray, now: int) -> None:
        """Publish (copy for readers) those of the slots that have become clearly more slippery than
        readers see.
        """
        current = self._fusion.beliefs(slots, now)
        shown = self.beliefs(slots, now)
        worse = (current - shown) @ mugrid.SLIPPERY_SHARE >= MORE_SLIPPERY
        worse |= quantiles(shown, (0.5,))[0] - quantiles(current, (0.5,))[0] >= LESS_MU
        slots = slots[worse]
        self._copy(slots)
        self._pending[slots[self._shown[slots]]] = 0

    def _copy(self, slots: IntArray) -> None:
        """Copy the current state of the slots to the public copy, which readers see."""
        live = self._fusion.store.state.live
        self._rows.belief[slots] = live.belief[slots]
        self._rows.cells[slots] = live.cells[slots]

    def _add_slots(self) -> None:
        """Add new slots to the public copy, in the state of an unvisited cell. The memory is
        doubled when it is full, so that this is rare.
        """
        if self._size == self._fusion.size:
            return
        new = np.arange(self._size, self._fusion.size)
        if len(self._shown) < self._fusion.size:
            self._take_rows(np.arange(self._size), 2 * self._fusion.size)
        live = self._fusion.store.state.live.cells[new]
        self._rows.belief[new] = FULL
        self._rows.cells["key"][new] = live["key"]
        # The time is needed only for the age of the belief. The cell counts no vehicles yet.
        self._rows.cells["time"][new] = live["time"]
        self._size = self._fusion.size

    def _take_rows(self, slots: IntArray, room: int | None = None) -> None:
        """Keep only the rows `slots` of the public copy, in arrays with room for `room` rows."""
        room = len(slots) if room is None else room
        rows = Rows(no_beliefs(room), rows_of_lines(room, CELL), self._rows.reporters)
        rows.belief[: len(slots)] = self._rows.belief[slots]
        rows.cells[: len(slots)] = self._rows.cells[slots]
        self._rows = rows
        self._shown = _resized(self._shown[slots], room)
        self._pending = _resized(self._pending[slots], room)


def _resized(column: NDArray[Any], size: int) -> NDArray[Any]:
    out = np.zeros(size, column.dtype)
    out[: len(column)] = column
    return out
