"""Cache of encoded tiles for readers. A tile is made on request or for publication, and reused
while it is fresh.

A returned tile is at most SHOWN_NS old and contains everything for which an acknowledgement or
alert was sent before the query. Under load, most queries cost only a look-up.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from contextlib import AbstractContextManager
from typing import Any, Final, NamedTuple

import numpy as np
import pyarrow as pa
from numpy.typing import NDArray

from fleet_service.serve.encode import arrow_stream, batch_of
from fleet_service.serve.map_state import MapState
from fleet_service.serve.public_cells import PublicCells
from fleet_service.serve.view import CellView, Readable, coarsen_cells, view_cells
from schemas import grid
from schemas.numeric import IntArray
from schemas.thresholds import NS

# [ns] Age up to which a cached tile is used; published tiles are up to a second old too.
SHOWN_NS: Final = NS
KEPT_BYTES: Final = 32 << 20
# Largest numbers of tiles and of cells that are made in one step. Making them takes some
# milliseconds, in which no other expensive query gets a reply.
TILES_TOGETHER: Final = 32
CELLS_TOGETHER: Final = 2_000
# columns by which a query selects cells
SELECTED_BY: Final = ("vehicles", "west", "south", "east", "north")

NOTHING: Final = (math.inf, math.inf, -math.inf, -math.inf)  # empty area, which no box touches


class ShownTile(NamedTuple):
    """Cells of a tile as readers see them.

    Attributes:
        cells: cells in the schema of the map.
        columns: the columns by which a query selects cells (SELECTED_BY), as arrays (k,).
        payload: all cells as an Arrow stream, ordered from south to north. It shares memory with
            `cells`. It is empty if the cells have another order and are used for one query only.
        least_vehicles: smallest number of vehicles of any cell. If a query requires no more
            vehicles, it selects every cell.
        common: box (west, south, east, north) [deg] for a quick test. If a query's box overlaps
            `common`, its range of longitudes overlaps that of every cell, so that cells must be
            selected only by latitude. West is the largest western edge of all cells, and east is
            the smallest eastern edge. South and north are infinite. If the cells are not ordered
            from south to north, `common` is NOTHING, which overlaps no box.
        made_at: time at which this tile was made [ns].
        change: number of the newest change of the map that this tile includes.
    """

    cells: pa.RecordBatch
    columns: Mapping[str, NDArray[Any]]
    payload: bytes = b""
    least_vehicles: int = 0
    common: tuple[float, float, float, float] = NOTHING
    made_at: int = 0
    change: int = 0


class TileCache:
    """Cached tiles of a map.

    Args:
        state: the map.
        guard: lock that is held while the map is read, but not while Arrow data are written.
        least: minimum number of vehicles that have ever visited a public cell.
        public: public copy of the cells, in which no single vehicle's passage is visible; None to
            show everything.
    """

    def __init__(
        self,
        state: MapState,
        guard: AbstractContextManager[Any],
        least: int,
        public: PublicCells | None = None,
    ) -> None:
        self.state = state
        self.guard = guard
        self._least = least
        self._public = public
        self._kept: dict[int, ShownTile] = {}
        self._held = 0  # [bytes] size of all cached tiles
        self._acknowledged = 0  # number of the newest change that each reader must see

    def acknowledge(self) -> None:
        """Record that the service has sent acknowledgements or alerts for its newest data. Tiles
        that were cached before these data reached the map are no longer shown.
        """
        self._acknowledged = self.state.change

    def read_tiles(self, tiles: Sequence[int], now: int) -> list[ShownTile]:
        """Return tiles that are recent enough for a query at `now` [ns]. Each is from the cache, or
        newly made.
        """
        found = {tile: self._recent_tile(tile, now) for tile in tiles}
        missing = [tile for tile, kept in found.items() if kept is None]
        made = dict(zip(missing, self.make_tiles(missing, now), strict=True))
        return [found[tile] or made[tile] for tile in tiles]

    def _recent_tile(self, tile: int, now: int) -> ShownTile | None:
        cached = self._kept.get(tile)
        if cached is None or not 0 <= now - cached.made_at <= SHOWN_NS:
            return None
        is_current = cached.change >= min(self._acknowledged, self.state.changed_at(tile))
        return cached if is_current else None

    def first_group(self, tiles: Sequence[int]) -> Sequence[int]:
        """Return the first of the given tiles that should be made in one step: at least one, and
        more only if they have few cells together.
        """
        counts = [self.state.count(tile) for tile in tiles[:TILES_TOGETHER]]
        return tiles[: max(int((np.cumsum(counts) <= CELLS_TOGETHER).sum()), 1)]

    def make_tiles(self, tiles: Sequence[int], now: int) -> list[ShownTile]:
        """Make tiles from the state of the map at `now` [ns], and store them in the cache. The
        beliefs of all tiles are read and encoded together, because for a single small tile most of
        the time would be the overhead of the calls.
        """
        if not tiles:
            return []
        with self.guard:
            change = self.state.change
            slots = np.concatenate([self.state.slots(tile) for tile in tiles])
            slots, owners = self._by_tile_from_south(self.public_slots(slots, now))
            cells = self.read_cells(slots, now)
        batch = batch_of(cells, now)
        first = np.searchsorted(owners, tiles, "left")
        last = np.searchsorted(owners, tiles, "right")
        made = []
        for k, tile in enumerate(tiles):
            payload = arrow_stream(batch.slice(first[k], last[k] - first[k]))
            batch_of_tile = pa.ipc.open_stream(payload).read_next_batch()
            columns = selected_by(batch_of_tile)
            made.append(
                ShownTile(batch_of_tile, columns, payload, *_common_bounds(columns), now, change)
            )
            self._keep(tile, made[-1])
        return made

    def read_cells(self, slots: IntArray, now: int) -> CellView:
        """Return the cells of public slots (one per cell and heading sector) in the form that
        readers see.
        """
        return self.coarsen(view_cells(self.source, slots, now))

    @property
    def source(self) -> Readable:
        """Return the object from which readers' cells are read. This is the public copy of the
        cells if the cache has one (for privacy), else the fusion (the true beliefs about friction).
        """
        return self.state.fusion if self._public is None else self._public

    def coarsen(self, cells: CellView) -> CellView:
        """Return the cells as readers may see them. If the cache has a public copy of the cells
        (for privacy), counts of vehicles and observations and their times are rounded down. Without
        a public copy, the cells are returned unchanged.
        """
        return cells if self._public is None else coarsen_cells(cells)

    def public_slots(self, slots: IntArray, now: int) -> IntArray:
        """Return those of the slots that are public at `now` [ns]."""
        slots = slots[self.state.fusion.live.vehicles[slots] >= self._least]
        return slots if self._public is None else self._public.select(slots, now)

    def _by_tile_from_south(self, slots: IntArray) -> tuple[IntArray, IntArray]:
        """Return the slots (row numbers) ordered by tile, and within a tile from south to north;
        also return the tile of each of them.
        """
        cell = self.state.fusion.live.key[slots] // grid.SECTORS
        _, row = grid.deinterleave(cell)
        tile = grid.tile_of(cell)
        order = np.lexsort((-row, tile))
        return slots[order], tile[order]

    def _keep(self, tile: int, made: ShownTile) -> None:
        with self.guard:
            self._drop(tile)
            self._kept[tile] = made
            self._held += len(made.payload)
            while self._held > KEPT_BYTES:
                self._drop(next(iter(self._kept)))

    def _drop(self, tile: int) -> None:
        dropped = self._kept.pop(tile, None)
        self._held -= len(dropped.payload) if dropped else 0


def used_once(cells: CellView, now: int) -> ShownTile:
    """Return a tile that contains the given cells in their order. It is used for one query only and
    never put into the cache.
    """
    batch = batch_of(cells, now)
    return ShownTile(batch, selected_by(batch))


def _common_bounds(
    columns: Mapping[str, NDArray[Any]],
) -> tuple[int, tuple[float, float, float, float]]:
    if not len(columns["vehicles"]):
        return 0, NOTHING
    west = float(columns["west"].max())
    east = float(columns["east"].min())
    return int(columns["vehicles"].min()), (west, -math.inf, east, math.inf)


def selected_by(cells: pa.RecordBatch) -> dict[str, NDArray[Any]]:
    """Return the columns by which a query selects cells, as arrays (k,) by name: `vehicles` (number
    of vehicles that visited the cell), and `west`, `south`, `east`, `north` (edges of the cell
    [deg]).
    """
    return {name: cells[name].to_numpy() for name in SELECTED_BY}
