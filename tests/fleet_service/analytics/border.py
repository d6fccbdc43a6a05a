"""Synthetic archive for tests of a rebuild by zone (map square of zoom 7): its roads cross the
border of two zones, and a third zone lies far away.
"""

from __future__ import annotations

from pathlib import Path
from typing import Final

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc
import pyarrow.parquet as pq

from fleet_service.analytics import synthetic
from fleet_service.analytics.synthetic import DAY_S, START_NS, SyntheticFleet
from fleet_service.archive.format import segments
from fleet_service.archive.maintenance import rollup
from fleet_service.archive.maintenance.compaction import compact
from schemas import grid
from schemas.thresholds import NS
from schemas.wire import Kind

BORDER: Final = 11.25  # [deg] longitude between two zones; a zone is 2.8125° wide
FAR: Final = 5.0  # [deg] distance of a place further west
UNTIL: Final = START_NS + DAY_S * NS
NUMBERS: Final = ("mu", "mu_lower", "mu_upper", "p_slippery", "vehicles", "observations", "age_s")


def fill(root: Path, world: SyntheticFleet) -> None:
    """Write an archive with one day of observations, sort its rows by cell (compaction), and
    compute its hourly statistics (roll-ups).
    """
    step = 360.0 / (1 << grid.CELL_ZOOM)
    shift = BORDER - synthetic.LONGITUDE - world.length // 2 * step
    writer = segments.Writer(root, "shard-0")
    for number, rows in enumerate(synthetic.make_chunks(world)):
        far = np.where(rows["boot"] % 4 == 0, FAR, 0.0)
        rows["longitude"] = rows["longitude"] + shift - far
        rows["cell"] = grid.cell_of(rows["latitude"], rows["longitude"])
        rows["region"] = grid.region_of(rows["cell"])
        writer.write(Kind.OBSERVATION, segments.round_to_steps(rows))
        if number % 2:
            compact(root)
    rollup.complete_parts(root)


def rebuilt_map(out: Path) -> pa.Table:
    """Return the map that was rebuilt zone by zone (in squares of zoom 7), as one table with its
    rows in the order of a complete map.
    """
    parts = [
        pq.read_table(path, partitioning=None)
        for path in sorted((out / "map").glob("*/*/*.parquet"))
    ]
    whole = pa.concat_tables([part.replace_schema_metadata(None) for part in parts])
    return whole.sort_by([("cell", "ascending"), ("sector", "ascending")])


def difference(ours: pa.Table, theirs: pa.Table) -> float:
    """Return the largest difference between the numbers of the same cell in two maps. Return
    infinity if the maps have different cells, kinds of evidence or times, or null values in
    different places.
    """
    if not all(
        ours[name].equals(theirs[name])
        for name in ("cell", "sector", "basis", "first_time", "last_time")
    ):
        return np.inf
    worst = 0.0
    for name in NUMBERS:
        if not pc.is_null(ours[name]).equals(pc.is_null(theirs[name])):
            return np.inf
        a, b = (np.nan_to_num(table[name].to_numpy().astype(float)) for table in (ours, theirs))
        worst = max(worst, float(np.abs(a - b).max(initial=0.0)))
    return worst


def contents(folder: Path) -> dict[str, bytes]:
    """Return the content of every file below a folder as a dictionary, by the file's path relative
    to the folder.
    """
    return {
        str(path.relative_to(folder)): path.read_bytes()
        for path in folder.rglob("*")
        if path.is_file()
    }
