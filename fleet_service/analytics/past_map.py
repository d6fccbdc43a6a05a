"""Map computed from an archive, for a past moment or for now, with the polygons of its cells."""

from __future__ import annotations

import time
from pathlib import Path

import numpy as np
import pyarrow as pa

from fleet_service.archive.export.extract import Box, Extract
from fleet_service.archive.format import geo
from fleet_service.fusion import Fusion
from fleet_service.replay.rebuild import past_fusion
from fleet_service.serve.encode import cell_table
from schemas import grid, tables
from schemas.errors import InputError
from schemas.thresholds import US_STEP

LATENESS_S = 120.0  # [s] default of ServiceConfig.lateness_s


def require_past(at: int, field: str) -> None:
    """Raise an InputError if the time `at` [ns] of a map lies in the future. The error calls the
    option `field`.
    """
    if at > time.time_ns():
        raise InputError(field, "lies in the future", "leave it out for the present map")


def visited_cells(fusion: Fusion, at: int, box: Box | None) -> pa.Table:
    """Return a table of the visited cells that touch a box [deg], with their beliefs (probability
    of each friction value) at the time `at` [ns].
    """
    slots = np.flatnonzero(fusion.live.vehicles[: fusion.size] > 0)
    if box is not None:
        slots = slots[grid.touches(box, grid.bounds(fusion.cell[slots]))]
    return cell_table(fusion, slots, at)


def map_at(root: Path, part: Extract) -> pa.Table:
    """Return the map at the time `part.until` and in the box `part.bbox`, as a GeoParquet table.
    The map is computed again from all reports in the archive that were received until this time.
    """
    return snapshot_table(
        visited_cells(past_fusion(root, LATENESS_S, part.until, part.bbox), part.until, part.bbox),
        part.until,
    )


def snapshot_table(table: pa.Table, at: int) -> pa.Table:
    """Return the table of cells with their beliefs in the GeoParquet form of a map snapshot; `at`
    [ns] is the time of the beliefs.
    """
    time = pa.array(np.full(table.num_rows, at // US_STEP)).cast(tables.US)
    table = table.append_column("snapshot_time", time).sort_by(
        [("cell", "ascending"), ("sector", "ascending")]
    )
    return geo.with_cells(table.cast(tables.MAP_ARCHIVE, safe=False))
