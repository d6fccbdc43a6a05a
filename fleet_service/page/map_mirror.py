"""Local copy ("mirror") of the live map: tiles as records of cells. This module does not use the
network.
"""

from __future__ import annotations

import threading
from collections.abc import Iterable
from dataclasses import dataclass, field
from typing import Final, NamedTuple

import numpy as np
import pyarrow as pa

from fleet_service.page import records
from fleet_service.page.alert_mirror import AlertMirror
from fleet_service.page.recent import RecentMoments
from fleet_service.page.records import Records, TileBlock
from schemas import grid
from schemas.numeric import IntArray

_EMPTY: Final = np.zeros(0, records.RECORD)


@dataclass
class MirroredTile:
    """One tile of the local copy of the map.

    Attributes:
        cells: records of the cells.
        version: number of changes of the tile so far.
        last_received: time at which the tile was received [s since 1970].
        encoded_blocks: blocks (encoded cells of the tile) by zoom level, kept for the next request.
    """

    cells: Records = field(default_factory=lambda: _EMPTY)
    version: int = 0
    last_received: float = 0.0
    encoded_blocks: dict[int, bytes] = field(default_factory=dict)


class _Before(NamedTuple):
    cells: Records
    version: int


class MapMirror:
    """Local copy of the live map: all received tiles, and the active alerts (attribute `alerts`);
    thread-safe.
    """

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._tiles: dict[int, MirroredTile] = {}
        # tiles that changed since the last call of `changes`, in the state at that time
        self._before: dict[int, _Before] = {}
        self.recent = RecentMoments()
        self._last_received = 0.0
        self.alerts = AlertMirror()

    def take_tile(self, tile: int, table: pa.Table, now: float) -> None:
        """Replace the content of a tile of the local copy with a received table of its cells; `now`
        is the time [s since 1970].
        """
        cells = records.of_table(table)
        with self._lock:
            self._last_received = now
            mirrored = self._tiles.setdefault(tile, MirroredTile())
            mirrored.last_received = now
            if np.array_equal(mirrored.cells, cells):
                return
            self._before.setdefault(tile, _Before(mirrored.cells, mirrored.version))
            mirrored.cells = cells
            mirrored.version = mirrored.version + 1
            mirrored.encoded_blocks = {}

    @property
    def last_received(self) -> float:
        """Return the time at which any service last sent anything [s since 1970]; 0 if none has."""
        return max(self._last_received, self.alerts.last_received)

    def remember(self, now: float) -> None:
        """Store the present map among the recent moments, so that the time slider of the page can
        show it later.
        """
        with self._lock:
            self.recent.keep(
                now,
                {
                    tile: mirrored.cells
                    for tile, mirrored in self._tiles.items()
                    if len(mirrored.cells)
                },
            )

    def places(self) -> tuple[IntArray, IntArray]:
        """Return cell and heading sector of all records in the local copy, as two arrays (n,)."""
        with self._lock:
            parts = [
                (tile, one.cells["place"].astype(np.int64)) for tile, one in self._tiles.items()
            ]
        if not parts:
            return np.zeros(0, np.int64), np.zeros(0, np.int64)
        place = np.concatenate([tile * (1 << 14) * grid.SECTORS + place for tile, place in parts])
        return place // grid.SECTORS, place % grid.SECTORS

    def changes(self) -> list[TileBlock]:
        """Return one block (encoded records of cells) per changed tile with its changes since the
        last call.
        """
        with self._lock:
            before = self._before
            self._before = {}
            found = []
            for tile, (cells, version) in before.items():
                mirrored = self._tiles[tile]
                delta = records.changed_records(cells, mirrored.cells)
                block = TileBlock(
                    tile,
                    records.CELL_LEVEL,
                    mirrored.version,
                    version,
                    mirrored.last_received,
                    delta,
                )
                found.append(block)
            return found

    def tiles(self) -> list[int]:
        """Return the numbers of all tiles in the local copy that have cells."""
        with self._lock:
            return [tile for tile, mirrored in self._tiles.items() if len(mirrored.cells)]

    def oldest(self, before: float, most: int) -> list[int]:
        """Return at most `most` tiles that were not received since `before` [s since 1970], oldest
        first.
        """
        with self._lock:
            outdated = [
                (mirrored.last_received, tile)
                for tile, mirrored in self._tiles.items()
                if mirrored.last_received < before and len(mirrored.cells)
            ]
        return [tile for _, tile in sorted(outdated)[:most]]

    def touch(self, tile: int, now: float) -> None:
        """Record that a tile was queried at time `now` [s since 1970]. The content of the tile in
        the local copy stays, because it is unchanged or no service answered.
        """
        with self._lock:
            if tile in self._tiles:
                self._tiles[tile].last_received = now

    def encoded(self, tile: int, level: int) -> bytes:
        """Return the cells of a tile at a zoom level, encoded as one block (bytes for the browser);
        empty bytes if the tile is unknown.
        """
        with self._lock:
            mirrored = self._tiles.get(tile)
            if mirrored is None or not mirrored.version:
                return b""
            if level not in mirrored.encoded_blocks:
                mirrored.encoded_blocks[level] = block_at(
                    level, tile, mirrored.cells, mirrored.version, mirrored.last_received
                )
            return mirrored.encoded_blocks[level]

    def version(self, tile: int) -> int:
        """Return the number of changes of a tile; 0 if the tile is unknown."""
        with self._lock:
            return self._tiles[tile].version if tile in self._tiles else 0

    def rows(self, tiles: Iterable[int]) -> int:
        """Return the total number of records of the given tiles."""
        with self._lock:
            return sum(len(self._tiles[tile].cells) for tile in tiles if tile in self._tiles)


def block_at(level: int, tile: int, cells: Records, version: int, moment: float) -> bytes:
    """Return the cells of a tile at a zoom level, encoded as one block (bytes for the browser)."""
    seen = cells if level == records.CELL_LEVEL else records.aggregate_worst(cells, level)
    return TileBlock(tile, level, version, 0, moment, seen).encoded()


def box_of(tile: int, zoom: int = grid.TILE_ZOOM) -> list[float]:
    """Return the box of a map tile: west, south, east, north [deg]."""
    return [float(side) for side in grid.bounds(tile, zoom)]
