"""Every row of an archive once, whether it lies in the inbox or in a compacted file, while compaction goes on.

The inbox is read first and whole; a compaction that deletes segments meanwhile makes the reader begin again. Then the
compacted files are listed, once. Rows of a segment are left out where a listed file holds them; a file that comes later
is not read, for its rows were read from the inbox. So it is the order of these steps that makes it right.
"""

from __future__ import annotations

import json
from collections.abc import Iterable, Iterator, Sequence
from pathlib import Path
from typing import Final

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc
import pyarrow.parquet as pq

from fleet_service.archive import layout, segments
from fleet_service.archive.layout import Partition
from fleet_service.archive.load import Damaged, load, pass_over
from fleet_service.archive.version import DamagedError, entries_of, judge
from schemas.numeric import BoolArray
from schemas.wire import Kind

# Key in the footer: the segments that the rows come from, as JSON [[SHARD-EPOCH, first number, last number], …].
SOURCES: Final = b"gripmap.sources"
_TURNS: Final = 100  # a reader that is overtaken by so many compactions has another trouble


def read(
    root: Path,
    kind: Kind,
    columns: Sequence[str] | None = None,
    where: pc.Expression | None = None,
    days: tuple[int | None, int | None] = (None, None),
    damaged: Damaged = pass_over,
) -> Iterator[pa.Table]:
    """Tables that together hold every row once, of files that are not damaged.

    Args:
        root: of the archive.
        kind: observations or states.
        columns: all, if None.
        where: rows wanted; row groups that cannot hold any are skipped.
        days: first and last day of measurement wanted; may yield more.
        damaged: is called with a damaged file.

    Raises:
        InputError: a file is of a newer major version.
        OSError: the system cannot read.
    """
    schema = segments.SCHEMAS[kind]
    wanted = list(columns) if columns is not None else schema.names
    needed = list(dict.fromkeys([*wanted, layout.TIME[kind], "cell"]))
    fresh = _inbox(root, kind, needed, where, damaged)
    files = list(layout.compacted(root, kind, *days))
    done = compacted(files, {path.name for path, _ in fresh})
    for path, table in fresh:
        yield without(table, kind, done.get(path.name, set())).select(wanted)
    fresh.clear()
    for path in files:
        try:
            part = load(path, schema, wanted, where, damaged=damaged)
        except FileNotFoundError:  # its day was retired meanwhile
            continue
        if part is not None and part.num_rows:
            yield part


def _inbox(
    root: Path, kind: Kind, columns: list[str], where: pc.Expression | None, damaged: Damaged
) -> list[tuple[Path, pa.Table]]:
    for _ in range(_TURNS):
        try:
            paths = segments.paths(root, kind)
            schema = segments.SCHEMAS[kind]
            loaded = [(path, load(path, schema, columns, where, whole=True, damaged=damaged)) for path in paths]
        except FileNotFoundError:  # compacted meanwhile
            continue
        return [(path, table) for path, table in loaded if table is not None]
    raise OSError(f"the inbox of {root} changes faster than it can be read")


def compacted(files: Iterable[Path], names: set[str]) -> dict[str, set[Partition]]:
    """In which partitions the rows of segments are compacted already, by the names of the segments.

    A file's name is that of its newest segment, so that older files need not be opened.
    """
    done: dict[str, set[Partition]] = {}
    if not names:
        return done
    oldest = min(map(layout.age, names))
    for path in files:
        if layout.age(path.name) >= oldest:
            for name in names & sources_of(path):
                done.setdefault(name, set()).add(layout.partition_of(path))
    return done


def without(table: pa.Table, kind: Kind, done: set[Partition]) -> pa.Table:
    """The rows that lie in none of the partitions."""
    if not done or not table.num_rows:
        return table
    day, zone = layout.partitions_of(segments.nanoseconds(table[layout.TIME[kind]]), table["cell"].to_numpy())
    taken: BoolArray = np.zeros(table.num_rows, bool)
    for partition in done:
        taken |= (day == partition.day) & (zone == partition.zone)
    return table.filter(pa.array(~taken))


def sources_of(path: Path) -> set[str]:
    """Segments whose rows of its partition a compacted file holds; none if it is gone or damaged.

    Raises:
        InputError: it is of a newer major version.
    """
    try:
        footer = pq.read_metadata(path)
        judge(path, footer.schema.to_arrow_schema(), entries_of(footer.metadata))
        runs = json.loads((footer.metadata or {}).get(SOURCES, b"[]"))
    except (FileNotFoundError, pa.ArrowInvalid, DamagedError):
        return set()
    return {layout.segment_name(prefix, number) for prefix, first, last in runs for number in range(first, last + 1)}
