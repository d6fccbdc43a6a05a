"""Tiles as they are shown: made when they are asked for or put, and shown again while they are good.

A tile that is shown is at most SHOWN_NS old and holds everything that was acknowledged, or alerted, before it was asked
for: what an answer can be no fresher than by more than a put can. Most questions under load then cost a look.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from contextlib import AbstractContextManager
from typing import Any, Final, NamedTuple

import numpy as np
import pyarrow as pa
from numpy.typing import NDArray

from fleet_service.serve.map_state import MapState, arrow_stream, cells_at, map_batch
from schemas import grid
from schemas.numeric import IntArray
from schemas.thresholds import NS

SHOWN_NS: Final = NS  # as old as a tile that is put once a second may be
KEPT_BYTES: Final = 32 << 20
FILTERED: Final = ("vehicles", "west", "south", "east", "north")  # columns by which a question chooses cells


class Shown(NamedTuple):
    """A tile's public cells.

    Attributes:
        payload: as an Arrow stream.
        cells: the same, from south to north; shares the payload's memory.
        columns: FILTERED as arrays (k,).
        common: what all cells have: so many vehicles, an eastern border east of this and a western one west of this.
        made: when [ns].
        change: the last change of the map that is in it.
    """

    payload: bytes
    cells: pa.RecordBatch
    columns: Mapping[str, NDArray[Any]]
    common: tuple[int, float, float]
    made: int
    change: int


class Tiles:
    """The tiles of a map.

    Args:
        state: the map.
        guard: held while the map is read; not while Arrow is written.
        least: vehicles of a cell that is public.
    """

    def __init__(self, state: MapState, guard: AbstractContextManager[Any], least: int) -> None:
        self.state, self.guard, self._least = state, guard, least
        self._kept: dict[int, Shown] = {}
        self._held = 0  # bytes
        self._settled = 0  # change up to which all must be seen

    def settle(self) -> None:
        """All that the map holds now is promised to somebody: no tile without it is shown from here on."""
        self._settled = self.state.change

    def shown(self, tile: int, now: int) -> Shown:
        """A tile that is good enough for a question at `now` [ns]."""
        kept = self._kept.get(tile)
        if kept is None or not 0 <= now - kept.made <= SHOWN_NS:
            return self.make(tile, now)
        whole = kept.change >= min(self._settled, self.state.changed_at(tile))
        return kept if whole else self.make(tile, now)

    def make(self, tile: int, now: int) -> Shown:
        """A tile as it is believed at `now` [ns]."""
        with self.guard:
            change = self.state.change
            cells = cells_at(self.state.fusion, self._public(self.state.slots(tile)), now)
        payload = arrow_stream(map_batch(cells))
        batch = pa.ipc.open_stream(payload).read_next_batch()
        columns = filtered(batch)
        made = Shown(payload, batch, columns, _common(columns), now, change)
        self._keep(tile, made)
        return made

    def _public(self, slots: IntArray) -> IntArray:
        """The public ones, from south to north."""
        live = self.state.fusion.live
        public = slots[live.vehicles[slots] >= self._least]
        _, row = grid.deinterleave(live.key[public] // grid.SECTORS)
        return public[np.argsort(-row, kind="stable")]

    def _keep(self, tile: int, made: Shown) -> None:
        with self.guard:
            self._drop(tile)
            self._kept[tile] = made
            self._held += len(made.payload)
            while self._held > KEPT_BYTES:
                self._drop(next(iter(self._kept)))

    def _drop(self, tile: int) -> None:
        kept = self._kept.pop(tile, None)
        self._held -= len(kept.payload) if kept else 0


def _common(columns: Mapping[str, NDArray[Any]]) -> tuple[int, float, float]:
    if not len(columns["vehicles"]):
        return 0, -math.inf, math.inf
    return int(columns["vehicles"].min()), float(columns["east"].min()), float(columns["west"].max())


def filtered(cells: pa.RecordBatch) -> dict[str, NDArray[Any]]:
    """The columns by which a question chooses cells."""
    return {name: cells[name].to_numpy() for name in FILTERED}
