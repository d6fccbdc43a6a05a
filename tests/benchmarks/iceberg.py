"""Comparison of the rows of an archive with those of its Iceberg tables; `make batch-bench` counts
the differences.
"""

from __future__ import annotations

from collections import Counter
from datetime import timedelta
from pathlib import Path
from typing import Any, Final, TypeAlias

import pyarrow as pa
import pyarrow.parquet as pq

from fleet_service.archive.format import layout
from fleet_service.archive.maintenance import iceberg, retention
from fleet_service.archive.maintenance.compaction import compact
from schemas.wire import Kind
from tests.fleet_service.archive.rows import fill

Table: TypeAlias = Any  # pyiceberg's table type, which is an optional import
SEEDS: Final = (0, 10, 20, 30)


def table_of(uri: str, kind: Kind) -> Table:
    """Open the Iceberg table of observations or states as another program would."""
    from pyiceberg.catalog import load_catalog

    return load_catalog("gripmap", type="sql", uri=uri).load_table(
        (iceberg.NAMESPACE, layout.TABLES[kind])
    )


def rows_different(root: Path, uri: str) -> int:
    """Return the number of rows that differ between the archive's compacted (sorted) files and the
    Iceberg tables. If a row occurs more often on one side, each additional copy counts. Rows are
    equal if all columns are.
    """
    different = 0
    for kind in Kind:
        files = [
            pq.read_table(path, partitioning=None) for path in layout.compacted_files(root, kind)
        ]
        exported = pa.concat_tables(files)
        seen = table_of(uri, kind).scan().to_arrow().select(exported.column_names)
        ours = _count_rows(exported)
        theirs = _count_rows(seen)
        different += (ours - theirs).total() + (theirs - ours).total()
    return different


def _count_rows(table: pa.Table) -> Counter[str]:
    return Counter(
        repr(row) for row in zip(*(column.to_pylist() for column in table.columns), strict=True)
    )


def count_different_rows(folder: Path) -> float:
    """Return the number of rows that differ between the archive and its Iceberg tables. The rows
    are compared after each of four compactions (sorting of new rows) with registration in Iceberg,
    and again after retention has removed a day.
    """
    root = folder / "archive"
    uri = f"sqlite:///{folder}/tables.db"
    place = iceberg.Place(uri, iceberg.NAMESPACE, root.as_uri())
    different = 0
    for done, seed in enumerate(SEEDS, 1):
        fill(root, 5, 500, seed=seed)
        compact(root)
        rows = iceberg.register_files(root, place).rows
        if rows != done * 5000:
            raise RuntimeError(f"{rows} rows registered")
        different += rows_different(root, uri)
    today = layout.date_of(20_000) + timedelta(days=32)
    if retention.retire_rows(root, 31, today).files == 0:
        raise RuntimeError("nothing was retired")
    return different + rows_different(root, uri)
