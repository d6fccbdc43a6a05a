"""The map: beliefs as the cells of tiles, and which tiles changed. Pure."""

from __future__ import annotations

from collections import defaultdict
from typing import Any, Final, NamedTuple

import numpy as np
import pyarrow as pa
from numpy.typing import NDArray

from fleet_service.fusion import Fusion
from fleet_service.fusion.belief import SLIPPERY_SHARE
from fleet_service.fusion.store.store import distinct
from schemas import grid, mugrid, tables
from schemas.numeric import BoolArray, Float32Array, FloatArray, IntArray
from schemas.thresholds import GRAVITY

CountArray = NDArray[np.integer[Any]]
LOWER, UPPER = 0.05, 0.95  # of the interval
PRIOR_UPPER: Final = float(mugrid.quantiles(mugrid.PRIOR, UPPER))
PRIOR_WIDTH: Final = PRIOR_UPPER - float(mugrid.quantiles(mugrid.PRIOR, LOWER))
# A cell is `measured` when a value brought its upper end down by more than numerics and forgetting move it, or halved
# the interval; else all that is known is a lower bound.
MEASURED_DROP: Final = 0.02
MEASURED_WIDTH: Final = 0.5
PARTS: Final = 32  # of a tile's index before they are joined: each costs as much as thirty slots


class MapState:
    """The tiles of a fusion.

    Args:
        fusion: whose cells they are.
    """

    def __init__(self, fusion: Fusion) -> None:
        self.fusion = fusion
        self._slots: dict[int, list[NDArray[np.int32]]] = defaultdict(
            list
        )  # in parts, which are joined when they are asked for
        self._indexed = 0
        self._dirty: set[int] = set()
        self._changed: dict[int, int] = {}
        self.change = 0  # how often anything changed

    def changed(self, slots: IntArray) -> None:
        """Note cells that were updated."""
        self._index()
        self.change += 1
        tiles = distinct(tile_of(self.fusion, slots)).tolist()
        self._dirty.update(tiles)
        self._changed.update(dict.fromkeys(tiles, self.change))

    def changed_at(self, tile: int) -> int:
        """Value of `change` when the tile changed the last time; 0 if it did not."""
        return self._changed.get(tile, 0)

    def take_dirty(self) -> list[int]:
        """Tiles that changed since the last call."""
        dirty, self._dirty = sorted(self._dirty), set()
        return dirty

    def tiles(self) -> list[int]:
        """All tiles with a cell."""
        self._index()
        return sorted(self._slots)

    def slots(self, tile: int) -> IntArray:
        """Slots of a tile, in the order in which they were first visited."""
        self._index()
        if tile not in self._slots:
            return np.zeros(0, np.int64)
        parts = self._slots[tile]
        parts[:] = [np.concatenate(parts)]
        return parts[0].astype(np.int64)

    def _index(self) -> None:
        if self._indexed == self.fusion.size:
            return
        new = np.arange(self._indexed, self.fusion.size)
        tiles = tile_of(self.fusion, new)
        order = np.argsort(tiles, kind="stable")
        names, begin = np.unique(tiles[order], return_index=True)
        for tile, part in zip(names.tolist(), np.split(new[order].astype(np.int32), begin[1:]), strict=True):
            parts = self._slots[tile]
            parts.append(part)
            if len(parts) > PARTS:
                parts[:] = [np.concatenate(parts)]
        self._indexed = self.fusion.size


def tile_of(fusion: Fusion, slots: IntArray) -> IntArray:
    """Tile of each slot."""
    return grid.tile_of(fusion.live.key[slots] // grid.SECTORS)


def measured(lower: FloatArray, upper: FloatArray, values: Float32Array) -> BoolArray:
    """Whether a value, and not only bounds, made beliefs what they are: (k,), of the interval's ends and how many votes
    with a value there were (k,)."""
    narrow = upper - lower < MEASURED_WIDTH * PRIOR_WIDTH
    return np.asarray((values > 0) & ((upper < PRIOR_UPPER - MEASURED_DROP) | narrow))


class CellView(NamedTuple):
    """What a fusion knows of cells: columns (k,) and beliefs (k, 32), read at `now` [ns].

    `values` are the votes with a value; None where all is borrowed.
    """

    cell: IntArray
    sector: IntArray
    belief: FloatArray
    values: Float32Array | None
    vehicles: CountArray
    observations: CountArray
    first: IntArray
    last: IntArray
    now: int


def cells_at(fusion: Fusion, slots: IntArray, now: int) -> CellView:
    """The cells of `slots` as they are believed at `now` [ns]; copies, so that the fusion may go on."""
    belief, live = fusion.beliefs(slots, now), fusion.live
    key = live.key[slots]
    return CellView(
        key // grid.SECTORS, key % grid.SECTORS, belief, live.values[slots], live.vehicles[slots],
        live.visits[slots], live.first[slots], live.time[slots], now,
    )  # fmt: skip


def cell_table(fusion: Fusion, slots: IntArray, now: int) -> pa.Table:
    """The cells of `slots` as they are believed at `now` [ns], in the schema of the map."""
    return pa.Table.from_batches([map_batch(cells_at(fusion, slots, now))])


def map_batch(cells: CellView) -> pa.RecordBatch:
    """Cells in the schema of the map."""
    latitude, longitude = grid.centre(cells.cell)
    west, south, east, north = grid.bounds(cells.cell)
    lower, middle, upper = (mugrid.quantiles(cells.belief, q) for q in (LOWER, 0.5, UPPER))
    basis = np.full(len(lower), _BORROWED) if cells.values is None else measured(lower, upper, cells.values)
    columns: dict[str, Any] = {
        "cell": cells.cell, "sector": cells.sector, "mu": middle, "mu_lower": lower, "mu_upper": upper,
        "p_slippery": cells.belief @ SLIPPERY_SHARE, "basis": _BASES.take(basis.astype(np.int8)),
        "vehicles": cells.vehicles,
        "observations": cells.observations, "first_time": cells.first, "last_time": cells.last,
        "age_s": np.maximum(cells.now - cells.last, 0) * 1e-9,
        "latitude": latitude, "longitude": longitude, "west": west, "south": south, "east": east, "north": north,
        "safe_deceleration": GRAVITY * lower,
    }  # fmt: skip
    arrays = [pa.array(columns[f.name]).cast(f.type, safe=False) for f in tables.MAP_SCHEMA]
    return pa.RecordBatch.from_arrays(arrays, schema=tables.MAP_SCHEMA)


def arrow_stream(cells: pa.RecordBatch) -> bytes:
    """Cells as an Arrow stream, of one batch."""
    return b"".join([_SCHEMA, cells.serialize(), _END])


_BASES: Final = pa.array(["bound", "measured", "borrowed"])
_BORROWED: Final = 2
_SCHEMA: Final = tables.MAP_SCHEMA.serialize().to_pybytes()
_END: Final = b"\xff\xff\xff\xff\x00\x00\x00\x00"  # a message without a head: the stream's end
