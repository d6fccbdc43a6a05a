"""Campaign on archives of other format versions. One archive was written before files had a
version, and today's service reads it. The other has additional columns, as a newer version would
write them, and is read by today's service after a rollback.

No file may be taken for a damaged one, every row must be read, and the map must equal that of the
writer.
"""

from __future__ import annotations

import json
import shutil
from contextlib import closing
from pathlib import Path
from typing import Any

import numpy as np

from fleet_service.app.engine import Engine
from fleet_service.archive.format import reading
from fleet_service.archive.format.load import count_set_aside
from fleet_service.archive.maintenance.compaction import compact
from fleet_service.archive.maintenance.retention import drop_checkpoints
from schemas.config import ServiceConfig
from schemas.runtime.figures import Figure
from schemas.wire import Kind
from tests.faults.bars import make_figure
from tests.faults.frame import Site
from tests.fleet_service.archive.reference_archive import DATA, read_map, write_reference_archive
from tests.fleet_service.archive.test_version import rewrite_file, with_columns


def run(site: Site) -> list[Figure]:
    """Read archives of an older and a newer format, before and after a compaction (sorting of new
    rows), with and without a checkpoint (saved state). Return the figures.
    """
    old = site.folder / "old"
    new = site.folder / "new"
    shutil.copytree(DATA / "v1.0" / "archive", old)
    made_old = json.loads((DATA / "v1.0" / "map.json").read_text())
    made_new = write_reference_archive(new)
    changed = 0
    for pattern in (
        "inbox/*.parquet",
        "inbox/states/*.parquet",
        "observations/*/*/*.parquet",
        "states/*/*/*.parquet",
    ):
        for path in new.glob(pattern):
            rewrite_file(path, with_columns, "1.7")
            changed += 1
    aside = 0
    lost = 0
    looks = 0
    difference = 0.0
    for root, made in ((old, made_old), (new, made_new)):
        for turn in range(3):
            if turn == 1:
                compact(root)
            if turn == 2:
                drop_checkpoints(root)
            difference = max(difference, _find_difference(root, made))
            lost += sum(made["rows"][str(kind)] - _count_rows(root, kind) for kind in Kind)
            looks += 1
        aside += count_set_aside(root)
    site.say(f"{changed} files rewritten, {looks} starts")
    return [
        make_figure("faults.versions.set_aside", aside),
        make_figure("faults.versions.lost_rows", abs(lost)),
        make_figure("faults.versions.map_difference", difference),
        make_figure("faults.versions.files", changed),
    ]


def _find_difference(root: Path, made: dict[str, Any]) -> float:
    with closing(Engine(ServiceConfig(), root)) as engine:
        found = np.asarray(read_map(engine, made["at"])["beliefs"])
    beliefs = np.asarray(made["beliefs"])
    return float(np.abs(found - beliefs).max()) if found.shape == beliefs.shape else float("inf")


def _count_rows(root: Path, kind: Kind) -> int:
    return sum(table.num_rows for table in reading.read_tables(root, kind, ["seq"]))
