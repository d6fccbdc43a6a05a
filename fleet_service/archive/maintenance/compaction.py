"""Compaction: rows of the inbox are sorted by cell and time and moved to one file per date and zone
(map square of zoom 7).

A round takes the oldest segments (files of new rows). It adds files before it deletes segments:

    1. all files of the round are written to `drafts/` and synced; the footer of each names its
       sources, the segments from which its rows come
    2. they are renamed into place, and their folders synced
    3. the segments are deleted

A crash between any two of these steps needs no repair. A row of a segment counts as compacted if a
compacted file of the row's partition (date and zone) names the segment as a source. So the module
`reading` reads each row once, and the next round takes the remaining rows.
"""

from __future__ import annotations

import json
from collections.abc import Iterable, Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import BinaryIO, Final, NamedTuple

import numpy as np
import pyarrow as pa

from fleet_service.archive.format import layout, reading, readme, segments
from fleet_service.archive.format.files import COMPACTED, lock_file, sync_tree, write_table
from fleet_service.archive.format.load import conform_columns, read_content, set_aside
from fleet_service.archive.format.version import KEY, VERSION
from schemas.runtime.durable import sync_directory
from schemas.wire import Kind

# Largest number of rows of a round: it needs half a gigabyte of memory, and its files have several
# row groups.
ROUND_ROWS: Final = 1_000_000


class CompactionResult(NamedTuple):
    """Result of a compaction (move of new rows into sorted files): numbers of rows moved, of
    segments deleted, and of files added.
    """

    rows: int
    segments: int
    files: int


def lock_compacted(root: Path) -> BinaryIO:
    """Lock the compacted (sorted) files of an archive for this process until the returned handle is
    closed.

    Raises:
        InputError: another process has the lock, because it adds or rewrites compacted files.
    """
    return lock_file(
        root / "compaction.lock",
        f"{root} is being compacted",
        "wait until the other compaction has ended",
    )


@contextmanager
def hold_compaction_lock(root: Path) -> Iterator[None]:
    """Lock the compacted (sorted) files of an archive while the block runs, and remove drafts of
    interrupted runs.

    Raises:
        InputError: the folder is not an archive, or another process has the lock.
    """
    layout.require_archive(root)
    with lock_compacted(root):
        drafts = root / "drafts"
        drafts.mkdir(exist_ok=True)
        for draft in drafts.iterdir():  # left by an interrupted run
            draft.unlink()
        yield


def compact(root: Path, round_rows: int = ROUND_ROWS) -> CompactionResult:
    """Move all rows of the inbox (new rows) into the compacted files, which are sorted by cell and
    time.

    Args:
        root: folder of the archive; a service may be running on it.
        round_rows: approximate number of rows in memory at once.

    Raises:
        InputError: another process is compacting the archive.
        OSError: a file cannot be read or written; nothing is lost.
    """
    total = CompactionResult(0, 0, 0)
    with hold_compaction_lock(root):
        readme.write_if_outdated(root)
        term = layout.read_epoch(root)
        for kind in Kind:
            waiting = segments.list_segments(root, kind)
            done = reading.compacted_partitions(
                layout.compacted_files(root, kind), {path.name for path in waiting}
            )
            # An interrupted run, or one with a full disk, may have placed files whose names are not
            # synced yet. A power loss could still remove these names. So sync them before their
            # segments are deleted.
            sync_tree(
                root,
                {
                    part.folder(root, layout.TABLES[kind])
                    for parts in done.values()
                    for part in parts
                },
            )
            uncompacted = _Uncompacted(root, kind, iter(waiting), done, term)
            while (moved := _compact_round(uncompacted, round_rows)).segments:
                total = CompactionResult(*map(sum, zip(total, moved, strict=True)))
    return total


class _Uncompacted(NamedTuple):
    """Segments whose rows are not yet in compacted (sorted) files, oldest first. `moved` contains,
    for each segment, the partitions (date and map square) to which an earlier, interrupted run
    already moved its rows. `term` is the lease term, a number in the names of new files.
    """

    root: Path
    kind: Kind
    segments: Iterator[Path]
    moved: dict[str, set[layout.Partition]]
    term: int


def _compact_round(uncompacted: _Uncompacted, row_limit: int) -> CompactionResult:
    """Move the rows of the next segments into compacted (sorted) files: about `row_limit` rows, but
    at least one segment.
    """
    sources: list[Path] = []
    tables: list[pa.Table] = []
    newest = VERSION
    while (
        sum(table.num_rows for table in tables) < row_limit
        and (path := next(uncompacted.segments, None)) is not None
    ):
        found = read_content(path, set_aside)
        if found is not None:
            sources.append(path)
            newest = max(newest, found.version)
            tables.append(
                reading.drop_compacted(
                    found.table, uncompacted.kind, uncompacted.moved.get(path.name, set())
                )
            )
    if not sources:
        return CompactionResult(0, 0, 0)
    table = join_versions(tables, segments.SCHEMAS[uncompacted.kind])
    source_names = json.dumps(consecutive_runs(path.name for path in sources))
    footer = {KEY: str(newest), reading.SOURCES.decode(): source_names}
    files = _place_files(
        uncompacted.root,
        uncompacted.kind,
        layout.compacted_name(sources[-1].name, uncompacted.term),
        table,
        footer,
    )
    for path in sources:
        path.unlink()
    sync_directory(segments.segment_folder(uncompacted.root, uncompacted.kind))
    return CompactionResult(table.num_rows, len(sources), files)


def join_versions(tables: list[pa.Table], known: pa.Schema) -> pa.Table:
    """Join tables from segments of several format versions.

    The result has the known columns, null where a segment does not have the column. Columns that
    only a newer version knows are added at the end, so that a downgrade loses no data.
    """
    unknown_columns = [
        pa.schema([f for f in table.schema if f.name not in known.names]) for table in tables
    ]
    schema = pa.schema([*known, *pa.unify_schemas(unknown_columns, promote_options="permissive")])
    return pa.concat_tables([conform_columns(table, schema) for table in tables])


def _place_files(
    root: Path, kind: Kind, name: str, table: pa.Table, footer: Mapping[str, str]
) -> int:
    """Write the compacted (sorted) files of a round as drafts, then rename them into place; return
    their number.
    """
    drafts: list[tuple[Path, Path]] = []
    for partition, part in split_by_partition(table, kind):
        path = partition.folder(root, layout.TABLES[kind]) / name
        draft = root / "drafts" / f"{len(drafts)}.parquet"
        write_table(part, draft, COMPACTED, footer, named=False)
        drafts.append((draft, path))
    for draft, path in drafts:
        path.parent.mkdir(parents=True, exist_ok=True)
        draft.rename(path)
    sync_tree(root, {path.parent for _, path in drafts})
    return len(drafts)


def consecutive_runs(names: Iterable[str]) -> list[tuple[str, int, int]]:
    """Return runs of consecutive numbers of segments, each as (SHARD-EPOCH, first number, last
    number). `names` are the names of the files in order of age.
    """
    out: list[tuple[str, int, int]] = []
    for name in names:
        prefix = Path(name).stem.rpartition("-")[0]
        n = layout.age_key(name)[1]
        if out and out[-1][0] == prefix and out[-1][2] == n - 1:
            out[-1] = (prefix, out[-1][1], n)
        else:
            out.append((prefix, n, n))
    return out


def split_by_partition(table: pa.Table, kind: Kind) -> Iterator[tuple[layout.Partition, pa.Table]]:
    """Yield the rows of each partition (date, and zone, a map square of zoom 7) as one table,
    sorted by cell and time.
    """
    if not table.num_rows:
        return
    table = table.combine_chunks()
    time = segments.to_nanoseconds(table[layout.TIME[kind]])
    cell = table["cell"].to_numpy()
    day, zone = layout.partitions_of(time, cell)
    order = np.lexsort((time, cell, day))  # also sorts by zone: the leading digits of the cell
    table = table.take(order)
    day = day[order]
    zone = zone[order]
    starts = np.flatnonzero(np.diff(day, prepend=day[0] - 1) | np.diff(zone, prepend=zone[0]))
    for start, stop in zip(starts.tolist(), [*starts[1:].tolist(), len(order)], strict=True):
        yield layout.Partition(int(day[start]), int(zone[start])), table.slice(start, stop - start)
