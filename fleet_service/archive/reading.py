"""Every row of an archive once, whether it lies in the inbox or in a compacted file, while compaction goes on.

The inbox is read first and whole; a compaction that deletes segments meanwhile makes the reader begin again. Then the
compacted files are listed, once. Rows of a segment are left out where a listed file holds them; a file that comes later
is not read, for its rows were read from the inbox. So it is the order of these steps that makes it right.
"""

from __future__ import annotations

import json
import logging
from collections.abc import Callable, Iterable, Iterator, Sequence
from pathlib import Path
from typing import Any, Final

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc
import pyarrow.parquet as pq

from fleet_service.archive import layout, segments
from fleet_service.archive.layout import Partition
from schemas.numeric import BoolArray
from schemas.wire import Kind

log = logging.getLogger(__name__)
# Key in the footer: the segments that the rows come from, as JSON [[SHARD-EPOCH, first number, last number], …].
SOURCES: Final = b"gripmap.sources"
BAD: Final = ".bad"
_TYPES: Final = {f.name: f.type for schema in segments.SCHEMAS.values() for f in schema}
_TURNS: Final = 100  # a reader that is overtaken by so many compactions has another trouble


def read(
    root: Path,
    kind: Kind,
    columns: Sequence[str] | None = None,
    where: pc.Expression | None = None,
    days: tuple[int | None, int | None] = (None, None),
    newer_than: str | None = None,
) -> Iterator[pa.Table]:
    """Tables that together hold every row once; damaged files are set aside with the ending `.bad`.

    Args:
        root: of the archive.
        kind: observations or states.
        columns: all, if None.
        where: rows wanted; row groups that cannot hold any are skipped.
        days: first and last day of measurement wanted; may yield more.
        newer_than: only files with rows of segments newer than this name (and whatever else they hold).

    Raises:
        OSError: the system cannot read.
    """
    wanted = list(columns) if columns is not None else segments.SCHEMAS[kind].names
    needed = list(dict.fromkeys([*wanted, layout.TIME[kind], "cell"]))

    def new(path: Path) -> bool:
        return newer_than is None or layout.age(path.name) > layout.age(newer_than)

    fresh = _inbox(root, kind, new, needed, where)
    files = [path for path in layout.compacted(root, kind, *days) if new(path)]
    done = compacted(files, {path.name for path, _ in fresh})
    for path, table in fresh:
        yield without(table, kind, done.get(path.name, set())).select(wanted)
    fresh.clear()
    for path in files:
        try:
            part = load(path, wanted, where)
        except FileNotFoundError:  # its day was retired meanwhile
            continue
        if part is not None and part.num_rows:
            yield part


def _inbox(
    root: Path, kind: Kind, new: Callable[[Path], bool], columns: list[str], where: pc.Expression | None
) -> list[tuple[Path, pa.Table]]:
    for _ in range(_TURNS):
        try:
            paths = [path for path in segments.paths(root, kind) if new(path)]
            loaded = [(path, load(path, columns, where, whole=True)) for path in paths]
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
    """Segments whose rows of its partition a compacted file holds; none if it is gone or damaged."""
    try:
        metadata = pq.read_metadata(path).metadata or {}
    except (FileNotFoundError, pa.ArrowInvalid):
        return set()
    runs = json.loads(metadata.get(SOURCES, b"[]"))
    return {layout.segment_name(prefix, number) for prefix, first, last in runs for number in range(first, last + 1)}


def load(
    path: Path, columns: list[str] | None = None, where: pc.Expression | None = None, *, whole: bool = False
) -> pa.Table | None:
    """Rows of one file; None if any byte of them is not what was written: it is set aside then, and said so.

    Only the columns wanted are looked at, unless it is read `whole`.

    Raises:
        FileNotFoundError: it is gone.
        OSError: the system cannot read.
    """
    read = None if whole else columns
    try:
        if where is not None and pq.read_metadata(path).num_row_groups > 1:
            options: dict[str, Any] = {"filters": where, "partitioning": None}
            table = _sound(pq.read_table(path, columns=read, page_checksum_verification=True, **options), columns)
        else:
            with pq.ParquetFile(path, page_checksum_verification=True) as file:  # for small files half of read_table
                table = _sound(file.read(read), columns)
            table = table if where is None else table.filter(where)
        return table.select(columns) if whole and columns is not None else table
    except MemoryError:
        raise
    except (pa.ArrowException, OSError, UnicodeDecodeError) as error:
        if isinstance(error, OSError) and error.errno is not None:
            raise  # the system's trouble, not the file's
        log.warning("%s is damaged and set aside: %s", path, str(error).splitlines()[0][:200])
        path.rename(path.with_name(path.name + BAD))
        return None


def set_aside(root: Path) -> int:
    """How many damaged files lie in an archive; walks through all of it."""
    return sum(1 for _ in root.rglob(f"*{BAD}"))


def _sound(table: pa.Table, columns: list[str] | None) -> pa.Table:
    """The table, if it has the columns wanted in their types, and strings that are some; checksums covered the rest."""
    found = {f.name: f.type for f in table.schema}
    if any(_TYPES.get(name) != kind for name, kind in found.items()) or not set(columns or ()) <= found.keys():
        raise pa.ArrowInvalid("columns are not those of the archive")
    table.validate(full=True)
    return table
