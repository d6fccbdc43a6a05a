"""The map's past: the moments of which a map is stored, the map at a moment, and the history of a
cell.

The last minutes come from memory, earlier moments from a service's snapshots. Snapshots contain
only cells that readers may see, so these data are as public as the map itself.
"""

from __future__ import annotations

import threading
from collections import OrderedDict
from pathlib import Path
from typing import Any, Final

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc
import pyarrow.parquet as pq

from fleet_service.archive.format import layout, snapshots
from fleet_service.page import map_mirror, records
from fleet_service.page.colours import KNOWN_SLIPPERY
from fleet_service.page.recent import RecentMoments
from fleet_service.page.records import Records
from schemas import grid
from schemas.errors import InputError
from schemas.numeric import IntArray
from schemas.thresholds import NS

KEPT: Final = 8  # number of snapshots in memory
# Largest number of moments that the slider shows: four months of hourly snapshots.
MOST: Final = 3000
HISTORY: Final = 200  # number of newest snapshots from which a history is read
_COLUMNS: Final = (
    "cell",
    "sector",
    "mu",
    "mu_lower",
    "mu_upper",
    "p_slippery",
    "basis",
    "vehicles",
    "last_time",
)
_OF_HISTORY: Final = ("mu", "mu_lower", "mu_upper", "p_slippery", "basis", "vehicles")


class Moments:
    """Maps of past moments: recent ones in memory, and the snapshots of an archive.

    Args:
        root: folder of the archive; None without an archive.
        recent: moments of the live map that this page has received.
    """

    def __init__(self, root: Path | None, recent: RecentMoments | None = None) -> None:
        self._root = root
        self._recent = recent or RecentMoments()
        self._kept: OrderedDict[int, dict[int, Records]] = OrderedDict()
        self._lock = threading.Lock()

    @property
    def has_archive(self) -> bool:
        """Return True if the page can read an archive, which provides maps of earlier moments."""
        return self._root is not None

    def times(self) -> list[int]:
        """Return the times of all moments of which a map is stored [s since 1970], oldest first."""
        return sorted({*self._files(), *self._recent.times()})[-MOST:]

    def tiles(self, moment: int) -> list[int]:
        """Return the numbers of the tiles that had cells at a past moment."""
        return list(self._at(moment))

    def encoded(self, moment: int, tile: int, level: int) -> bytes:
        """Return the cells of a tile at a past moment, encoded as one block (bytes for the
        browser); empty bytes if the tile had no cells.
        """
        cells = self._at(moment).get(tile)
        return b"" if cells is None else map_mirror.block_at(level, tile, cells, 1, float(moment))

    def history(self, cell: int, sector: int) -> list[dict[str, Any]]:
        """Return the belief (mu with its interval and P(slippery)) about a cell and heading sector
        at each stored moment at which readers could see the cell, oldest first.
        """
        found = []
        files = self._files()
        for moment in self.times()[-HISTORY:]:
            if moment not in files:
                found += self._recent_history(moment, cell, sector)
                continue
            row_filter = (pc.field("cell") == cell) & (pc.field("sector") == sector)
            try:
                table = pq.read_table(
                    files[moment], columns=list(_OF_HISTORY), filters=row_filter, partitioning=None
                )
            except (OSError, pa.ArrowException):  # removed by retention, or damaged
                continue
            for row in table.to_pylist()[:1]:
                known = row["basis"] == "measured" or row["p_slippery"] > KNOWN_SLIPPERY
                found.append({"moment": moment, **row, "mu": row["mu"] if known else None})
        return found

    def _recent_history(self, moment: int, cell: int, sector: int) -> list[dict[str, Any]]:
        """Return the belief (mu with its interval and P(slippery)) about a cell and heading sector
        at a recent moment, as a list with one item; empty if the cell was unknown.
        """
        tile = int(grid.tile_of(cell))
        place = (cell & 0x3FFF) * grid.SECTORS + sector
        rows = (self._recent.at(moment) or {}).get(tile)
        if rows is None:
            return []
        return [records.as_values(row) | {"moment": moment} for row in rows[rows["place"] == place]]

    def _files(self) -> dict[int, Path]:
        if self._root is None:
            return {}
        folders = layout.day_folders(self._root, snapshots.TABLE)
        return {
            snapshots.time_of(path) // NS: path
            for folder in folders
            for path in folder.glob("*.parquet")
        }

    def _at(self, moment: int) -> dict[int, Records]:
        recent = self._recent.at(moment)
        if recent is not None:
            return recent
        with self._lock:
            if moment not in self._kept:
                self._kept[moment] = self._read(moment)
                while len(self._kept) > KEPT:
                    self._kept.popitem(last=False)
            self._kept.move_to_end(moment)
            return self._kept[moment]

    def _read(self, moment: int) -> dict[int, Records]:
        try:
            path = self._files()[moment]
            table = pq.read_table(path, columns=list(_COLUMNS), partitioning=None)
        except (KeyError, OSError, pa.ArrowException) as error:
            raise InputError(
                "at", f"there is no snapshot of {moment}", "choose one of /moments"
            ) from error
        last = table["last_time"].cast(pa.timestamp("ns", "UTC"), safe=False)
        table = table.set_column(table.schema.get_field_index("last_time"), "last_time", last)
        tile: IntArray = np.asarray(grid.tile_of(table["cell"].to_numpy()))
        order = np.argsort(tile, kind="stable")
        names, first = np.unique(tile[order], return_index=True)
        table = table.take(order)
        ends = np.append(first, len(tile))[1:]
        return {
            int(name): records.of_table(table.slice(int(a), int(b - a)))
            for name, a, b in zip(names, first, ends, strict=True)
        }
