"""Snapshots of the public map: one GeoParquet file per hour.

The file `map/date=2026-01-31/20260131T070000Z.parquet` contains the public cells at that hour with
their polygons, sorted by cell.
"""

from __future__ import annotations

from datetime import UTC, datetime
from pathlib import Path
from typing import Final

import numpy as np
import pyarrow as pa

from fleet_service.archive.format import geo, layout
from fleet_service.archive.format.files import MAP, put_in_place
from schemas import tables
from schemas.thresholds import NS, US_STEP

TABLE: Final = "map"
_NAME: Final = "%Y%m%dT%H%M%SZ"


def write_snapshot(root: Path, table: pa.Table, now: int) -> Path:
    """Store the map at the time `now` [ns]; `table` has the schema of the map. Return the path of
    the file.

    Raises:
        OSError: the file could not be written; no draft (unfinished file) is left.
    """
    path = path_of(root, now)
    time = pa.array(np.full(table.num_rows, now // US_STEP)).cast(tables.US)
    table = table.append_column("snapshot_time", time).sort_by(
        [("cell", "ascending"), ("sector", "ascending")]
    )
    archived = table.cast(tables.MAP_ARCHIVE, safe=False)
    put_in_place(root, geo.with_cells(archived), path, MAP)
    return path


def path_of(root: Path, now: int) -> Path:
    """Return the path of the map snapshot for the time `now` [ns]."""
    moment = datetime.fromtimestamp(now // NS, UTC)
    return root / TABLE / f"date={moment:%Y-%m-%d}" / f"{moment:{_NAME}}.parquet"


def time_of(path: Path) -> int:
    """Return the time [ns] of a map snapshot, from its file name."""
    return int(datetime.strptime(path.stem, _NAME).replace(tzinfo=UTC).timestamp()) * NS


def newest_snapshot(root: Path, until: int) -> Path | None:
    """Return the path of the last snapshot of the map taken at `until` [ns] or before; None if
    there is none.
    """
    for folder in reversed(layout.day_folders(root, TABLE, until_day=until // layout.DAY_NS)):
        for path in sorted(folder.glob("*.parquet"), reverse=True):
            if time_of(path) <= until:
                return path
    return None
