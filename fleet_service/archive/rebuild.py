"""From segments back to what a running service knows: which batches it holds, and what it believes."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Final

import numpy as np
import pyarrow as pa

from fleet_service.admit import Streams
from fleet_service.archive import segments
from fleet_service.archive.pseudonyms import number
from fleet_service.fusion import Folded, Fusion, Observations, evidence
from fleet_service.fusion.constants import EPOCH_NS
from schemas import grid
from schemas.numeric import IntArray
from schemas.wire import Kind

IDENTITY: Final = ["vehicle", "boot", "region", "seq"]
ROWS_PER_SEQ: Final = 64  # more than a batch has rows: seq and row become one number that keeps their order


def restore_streams(root: Path, streams: Streams) -> None:
    """Note every archived batch as admitted."""
    for kind in segments.SCHEMAS:
        for table in segments.read(root, kind, (*IDENTITY, "first_held")):
            batches = table.group_by(IDENTITY).aggregate([("first_held", "max")])
            for row in batches.to_pylist():
                stream = streams[number(row["vehicle"]), row["boot"], kind, row["region"]]
                stream.raise_to(row["first_held_max"])
                stream.admit(row["seq"])


def observations(rows: segments.Rows, vehicle: IntArray) -> Observations:
    """Columns of the archive as the fusion takes them; `vehicle` (n,) are the numbers of the pseudonyms."""
    _, second = grid.sectors_touched(np.nan_to_num(rows["yaw"]))
    first = rows["sector"].astype(np.int8)
    beside = np.where(np.isnan(rows["yaw"]) | (second == first), -1, second).astype(np.int8)
    return Observations(
        rows["leave_time"], rows["cell"], first, beside, vehicle, rows["boot"], rows["region"],
        rows["seq"] * ROWS_PER_SEQ + rows["row"], evidence(rows, rows["told"]),
    )  # fmt: skip


def replay(root: Path, fusion: Fusion, received_until: int | None = None) -> Iterator[Folded]:
    """Fold the archive into `fusion` in order of time, with the weights that were used; yields once per epoch.

    Args:
        root: of the archive.
        fusion: a new one.
        received_until: leave out what came later [ns]: the map as it was then.
    """
    tables = list(segments.read(root, Kind.OBSERVATION))
    if not tables:
        return
    table = pa.concat_tables(tables)
    if received_until is not None:
        table = table.filter(pa.array(table["received_at"].cast(pa.int64()).to_numpy() <= received_until))
    rows = segments.rows_of(table.sort_by("leave_time"))
    distinct, index = np.unique(rows["vehicle"].astype(str), return_inverse=True)
    o = observations(rows, np.array([number(p) for p in distinct.tolist()], np.int64)[index])
    borders = np.flatnonzero(np.diff(o.time // EPOCH_NS)) + 1
    for part in np.split(np.arange(len(o.time)), borders):
        if len(part):
            yield fusion.fold(o.take(part), rows["weight"][part], rows["late"][part].astype(bool))
