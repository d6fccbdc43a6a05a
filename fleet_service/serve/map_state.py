"""The map: which cells belong to each tile, and which tiles have changed. Pure (no I/O)."""

from __future__ import annotations

from collections import defaultdict
from typing import Final

import numpy as np
from numpy.typing import NDArray

from fleet_service.fusion import Fusion
from fleet_service.fusion.store.store import distinct_values
from schemas import grid
from schemas.numeric import IntArray

# Largest number of parts of a tile's index. Then they are joined, because one part costs as much
# memory as thirty slots.
PARTS: Final = 32


class MapState:
    """Index from the tiles of the map to the cells of a fusion (beliefs about the friction of all
    cells).

    Args:
        fusion: owner of the cells.

    Attributes:
        change: number of changes so far.
        emptied: numbers of the tiles that had cells for readers and lost all of them, so that they
            are published without cells.
    """

    def __init__(self, fusion: Fusion) -> None:
        self.fusion = fusion
        # slots of each tile in parts, which are joined when the slots are requested
        self._slots: dict[int, list[NDArray[np.int32]]] = defaultdict(list)
        self._indexed = 0
        self._dirty: set[int] = set()
        self._changed: dict[int, int] = {}
        self.change = 0
        self.emptied: set[int] = set()

    def mark_changed(self, slots: IntArray) -> None:
        """Record that slots (one per cell and heading sector) were updated, so that their tiles
        count as changed.
        """
        self._index()
        self.change += 1
        tiles = distinct_values(tile_of(self.fusion, slots)).tolist()
        self._dirty.update(tiles)
        self._changed.update(dict.fromkeys(tiles, self.change))

    def mark_all_changed(self) -> None:
        """Record that all tiles changed."""
        self._index()
        self.change += 1
        self._dirty.update(self._slots)
        self._changed.update(dict.fromkeys(self._slots, self.change))

    def mark_emptied(self, tiles: set[int]) -> None:
        """Record that these tiles have no cells for readers any more, and count as changed."""
        self.emptied |= tiles
        self._dirty |= tiles

    def changed_at(self, tile: int) -> int:
        """Return the version of a tile: the value of the map's counter of changes when the tile
        changed last; 0 if the tile never changed.
        """
        return self._changed.get(tile, 0)

    def take_dirty(self) -> list[int]:
        """Return the numbers of the map tiles that changed since the last call."""
        dirty = sorted(self._dirty)
        self._dirty = set()
        return dirty

    def tiles(self) -> list[int]:
        """Return the numbers of all map tiles that contain at least one cell."""
        self._index()
        return sorted(self._slots)

    def slots(self, tile: int) -> IntArray:
        """Return the slots, (n,), of a tile, in the order of their first visit (passage of
        a cell).
        """
        self._index()
        if tile not in self._slots:
            return np.zeros(0, np.int64)
        parts = self._slots[tile]
        parts[:] = [np.concatenate(parts)]
        return parts[0].astype(np.int64)

    def count(self, tile: int) -> int:
        """Return the number of slots of a tile. The caller needs no lock."""
        # Another thread may join the parts meanwhile; the copy of the list stays as it is.
        return sum(map(len, tuple(self._slots.get(tile, ()))))

    def rebuild(self) -> None:
        """Discard the index from tiles to cells, so that it is built again. Call this after the
        slots were renumbered.
        """
        self._slots.clear()
        self._indexed = 0

    def _index(self) -> None:
        if self._indexed == self.fusion.size:
            return
        new = np.arange(self._indexed, self.fusion.size)
        tiles = tile_of(self.fusion, new)
        order = np.argsort(tiles, kind="stable")
        names, begin = np.unique(tiles[order], return_index=True)
        for tile, part in zip(
            names.tolist(), np.split(new[order].astype(np.int32), begin[1:]), strict=True
        ):
            parts = self._slots[tile]
            parts.append(part)
            if len(parts) > PARTS:
                parts[:] = [np.concatenate(parts)]
        self._indexed = self.fusion.size


def tile_of(fusion: Fusion, slots: IntArray) -> IntArray:
    """Return the tile number (n,) of each slot, given by row numbers (n,)."""
    return grid.tile_of(fusion.live.key[slots] // grid.SECTORS)
