"""Reading of an archive so that every row is read exactly once, even during a compaction. A row
comes either from the inbox (segments, which are files of new rows) or from a compacted (sorted)
file.

The inbox is read first and completely. If a compaction deletes segments meanwhile, the reader
starts again. Then the compacted files are listed once. Rows of a segment are skipped if a listed
file contains them. A file that appears later is not read, because its rows were already read from
the inbox. The result is correct only with this order of steps.
"""

from __future__ import annotations

import json
from collections.abc import Callable, Iterable, Iterator, Sequence
from pathlib import Path
from typing import Final, NamedTuple

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq

from fleet_service.archive.format import layout, segments
from fleet_service.archive.format.layout import Partition
from fleet_service.archive.format.load import Damaged, load_groups, load_rows, skip_damaged
from fleet_service.archive.format.row_filter import Where
from fleet_service.archive.format.version import DamagedError, check_version, entries_of
from schemas import grid
from schemas.numeric import BoolArray
from schemas.wire import Kind

# Key in the footer of a compacted file. Its value lists the segments that the rows come from, as
# JSON: [[SHARD-EPOCH, first number, last number], …].
SOURCES: Final = b"gripmap.sources"
# Number of attempts to read the inbox while compaction moves files. After these, there is another
# problem.
_TURNS: Final = 100


class RowSelection(NamedTuple):
    """Selection of rows.

    Attributes:
        columns: columns to read; None for all.
        where: filter on rows.
        days: first and last day of measurement, both included.
        after: read only files that were written after this position in the sequence of segments
            (files of new rows). A compacted file is read as a whole, so it may contain older rows
            too.
        until: read no segment of the inbox that was written after this position.
        box: read only compacted files of zones (map squares of zoom 7) that touch this box (west,
            south, east, north [deg]).
    """

    columns: Sequence[str] | None = None
    where: Where | None = None
    days: tuple[int | None, int | None] = (None, None)
    after: layout.Cut | None = None
    until: layout.Cut | None = None
    box: tuple[float, float, float, float] | None = None

    def newer(self, path: Path) -> bool:
        """Return True if a file was written after the position `after` in the sequence of segments.
        The file is a segment, or a compacted (sorted) file, which is named after its newest
        segment.
        """
        return self.after is None or layout.age_key(path.name)[:2] > self.after


def read_tables(
    root: Path,
    kind: Kind,
    columns: Sequence[str] | None = None,
    where: Where | None = None,
    days: tuple[int | None, int | None] = (None, None),
    damaged: Damaged = skip_damaged,
) -> Iterator[pa.Table]:
    """Yield tables that together contain every row once; damaged files are skipped.

    Args:
        root: folder of the archive.
        kind: observations or states.
        columns: columns to read; None for all.
        where: filter; row groups without a match are skipped.
        days: first and last day of measurement; rows of other days may be included too.
        damaged: called with each damaged file.

    Raises:
        InputError: a file has a newer major version.
        OSError: a file cannot be read.
    """
    yield from read_selected(root, kind, RowSelection(columns, where, days), damaged)


def read_selected(
    root: Path, kind: Kind, selection: RowSelection, damaged: Damaged = skip_damaged
) -> Iterator[pa.Table]:
    """Yield tables that together contain every selected row once; `selection` selects rows, columns
    and files. Damaged files are skipped.
    """
    listing = Listing(root, kind, selection, damaged)
    yield from listing.inbox()
    for path in listing.files:
        part = listing.load(path)
        if part is not None and part.num_rows:
            yield part


class Listing:
    """State of an archive at one moment: the new rows of the inbox, and a list of compacted
    (sorted) files, which are read later.

    Args:
        root: folder of the archive.
        kind: observations or states.
        selection: selection of rows.
        damaged: called with each damaged file.
    """

    def __init__(
        self, root: Path, kind: Kind, selection: RowSelection, damaged: Damaged = skip_damaged
    ) -> None:
        self.kind = kind
        self._selection = selection
        self._damaged = damaged
        self._schema = segments.SCHEMAS[kind]
        self._names = (
            list(selection.columns) if selection.columns is not None else self._schema.names
        )
        needed = list(dict.fromkeys([*self._names, layout.TIME[kind], "cell"]))
        self._fresh = _read_inbox(root, kind, selection._replace(columns=needed), damaged)
        files = list(layout.compacted_files(root, kind, *selection.days))
        self._done = compacted_partitions(files, {path.name for path, _ in self._fresh})
        self.files = [path for path in files_near(files, selection.box) if selection.newer(path)]

    def inbox(self) -> Iterator[pa.Table]:
        """Yield tables of the new rows (inbox) that no compacted (sorted) file contains; call this
        only once.
        """
        fresh = self._fresh
        self._fresh = []
        for path, table in fresh:
            yield drop_compacted(table, self.kind, self._done.get(path.name, set())).select(
                self._names
            )

    def load_groups(self, path: Path, where: Where, take: Callable[[pa.Table], None]) -> bool:
        """Read one file of the archive, and pass the rows that match the selection and the filter
        `where` to `take`, one Parquet row group (part of the file) at a time. Return False if the
        file is damaged or missing; the caller must then discard the rows passed to `take`.
        """
        both = [*(self._selection.where or ()), *where]
        try:
            return load_groups(path, self._schema, self._names, both, take, self._damaged)
        except FileNotFoundError:
            return False

    def load(self, path: Path, where: Where | None = None) -> pa.Table | None:
        """Return the rows of one file of the archive that match the selection and the filter
        `where`. Return None if the file is damaged, or was removed together with the other files of
        its day.
        """
        both = [*(self._selection.where or ()), *(where or ())]
        try:
            return load_rows(path, self._schema, self._names, both or None, damaged=self._damaged)
        except FileNotFoundError:
            return None


def files_near(files: Sequence[Path], box: tuple[float, float, float, float] | None) -> list[Path]:
    """Return those of the compacted (sorted) files in zones that touch a box [deg]; all files if
    the box is None.
    """
    if box is None or not files:
        return list(files)
    zone = np.array([layout.partition_of(path).zone for path in files])
    touching = grid.touches(box, grid.bounds(zone, grid.ZONE_ZOOM))
    return [path for path, taken in zip(files, touching.tolist(), strict=True) if taken]


def _read_inbox(
    root: Path, kind: Kind, selection: RowSelection, damaged: Damaged
) -> list[tuple[Path, pa.Table]]:
    for _ in range(_TURNS):
        try:
            paths = [path for path in segments.list_segments(root, kind) if selection.newer(path)]
            if selection.until is not None:
                paths = [path for path in paths if layout.age_key(path.name)[:2] <= selection.until]
            schema = segments.SCHEMAS[kind]
            loaded = [
                (
                    path,
                    load_rows(
                        path,
                        schema,
                        selection.columns,
                        selection.where,
                        whole=True,
                        damaged=damaged,
                    ),
                )
                for path in paths
            ]
        except FileNotFoundError:  # compaction has moved a file, so list the files again
            continue
        return [(path, table) for path, table in loaded if table is not None]
    raise OSError(f"the inbox of {root} changes faster than it can be read")


def compacted_partitions(files: Iterable[Path], names: set[str]) -> dict[str, set[Partition]]:
    """Return, for each segment, the partitions whose rows from this segment are already in
    compacted (sorted) files.

    A compacted file is named after its newest segment. Therefore files older than all given
    segments need not be opened.
    """
    done: dict[str, set[Partition]] = {}
    if not names:
        return done
    oldest = min(map(layout.age_key, names))
    for path in files:
        if layout.age_key(path.name) >= oldest:
            for name in names & sources_of(path):
                done.setdefault(name, set()).add(layout.partition_of(path))
    return done


def drop_compacted(table: pa.Table, kind: Kind, done: set[Partition]) -> pa.Table:
    """Return those rows of the table that lie outside the partitions `done` (pairs of day and map
    square). The table contains new rows of a segment; its rows inside `done` are already in
    compacted (sorted) files.
    """
    if not done or not table.num_rows:
        return table
    day, zone = layout.partitions_of(
        segments.to_nanoseconds(table[layout.TIME[kind]]), table["cell"].to_numpy()
    )
    taken: BoolArray = np.zeros(table.num_rows, bool)
    for partition in done:
        taken |= (day == partition.day) & (zone == partition.zone)
    return table.filter(pa.array(~taken))


def sources_of(path: Path) -> set[str]:
    """Return the names of the segments from which a compacted (sorted) file contains rows; empty if
    the file is missing or damaged.

    Raises:
        InputError: the file has a newer major version.
    """
    try:
        footer = pq.read_metadata(path)
        check_version(path, footer.schema.to_arrow_schema(), entries_of(footer.metadata))
        runs = json.loads((footer.metadata or {}).get(SOURCES, b"[]"))
    except (FileNotFoundError, pa.ArrowInvalid, DamagedError):
        return set()
    return {
        layout.segment_name(prefix, number)
        for prefix, first, last in runs
        for number in range(first, last + 1)
    }
