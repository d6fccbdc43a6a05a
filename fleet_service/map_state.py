"""The map: beliefs as the cells of tiles, and which tiles changed. Pure."""

from __future__ import annotations

from collections import defaultdict
from typing import Any, Final

import numpy as np
import pyarrow as pa
from numpy.typing import NDArray

from fleet_service.fusion import Fusion
from fleet_service.fusion.belief import SLIPPERY_SHARE
from schemas import grid, mugrid, tables
from schemas.numeric import Float32Array, FloatArray, IntArray

CountArray = NDArray[np.integer[Any]]
LOWER, UPPER = 0.05, 0.95  # of the interval
GRAVITY: Final = 9.81  # [m/s²]
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

    def changed(self, slots: IntArray) -> None:
        """Note cells that were folded into."""
        self._index()
        self._dirty.update(np.unique(tile_of(self.fusion, slots)).tolist())

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


def basis_of(belief: FloatArray, values: Float32Array) -> list[str]:
    """`measured` or `bound` of each belief (k, 32), given how many votes with a value it had (k,)."""
    upper = mugrid.quantiles(belief, UPPER)
    width = upper - mugrid.quantiles(belief, LOWER)
    measured = (values > 0) & ((upper < PRIOR_UPPER - MEASURED_DROP) | (width < MEASURED_WIDTH * PRIOR_WIDTH))
    return ["measured" if is_so else "bound" for is_so in measured.tolist()]


def cell_table(fusion: Fusion, slots: IntArray, now: int) -> pa.Table:
    """The cells of `slots` as they are believed at `now` [ns], in the schema of the map."""
    belief, live = fusion.beliefs(slots, now), fusion.live
    key = live.key[slots]
    return map_table(
        key // grid.SECTORS, key % grid.SECTORS, belief, basis_of(belief, live.values[slots]), live.vehicles[slots],
        live.visits[slots], live.first[slots], live.time[slots], now,
    )  # fmt: skip


def map_table(
    cell: IntArray, sector: IntArray, belief: FloatArray, basis: list[str], vehicles: CountArray,
    observations: CountArray, first: IntArray, last: IntArray, now: int,
) -> pa.Table:  # fmt: skip
    """Columns (k,) and beliefs (k, 32) as a table of the map."""
    latitude, longitude = grid.centre(cell)
    west, south, east, north = grid.bounds(cell)
    columns: dict[str, Any] = {
        "cell": cell, "sector": sector, "mu": mugrid.quantiles(belief, 0.5),
        "mu_lower": mugrid.quantiles(belief, LOWER), "mu_upper": mugrid.quantiles(belief, UPPER),
        "p_slippery": belief @ SLIPPERY_SHARE, "basis": basis, "vehicles": vehicles, "observations": observations,
        "first_time": first, "last_time": last, "age_s": np.maximum(now - last, 0) * 1e-9,
        "latitude": latitude, "longitude": longitude, "west": west, "south": south, "east": east, "north": north,
        "safe_deceleration": GRAVITY * mugrid.quantiles(belief, LOWER),
    }  # fmt: skip
    arrays = [pa.array(columns[f.name]).cast(f.type, safe=False) for f in tables.MAP_SCHEMA]
    return pa.Table.from_arrays(arrays, schema=tables.MAP_SCHEMA)


def arrow_stream(table: pa.Table) -> bytes:
    """A table as an Arrow stream."""
    sink = pa.BufferOutputStream()
    with pa.ipc.new_stream(sink, table.schema) as writer:
        writer.write_table(table)
    return bytes(sink.getvalue())
