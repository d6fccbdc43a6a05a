"""Replay of an archive: it restores the beliefs about the friction of all cells, for now or for a
past moment.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import AbstractContextManager, nullcontext
from dataclasses import fields
from itertools import pairwise
from pathlib import Path
from typing import Final, NamedTuple

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq

from fleet_service.archive.format import layout, reading, segments
from fleet_service.archive.format.load import Damaged, skip_damaged
from fleet_service.archive.format.row_filter import ValueRange, filter_table, matching_row_groups
from fleet_service.archive.identity import vehicle_ids
from fleet_service.fusion import Fusion, Observations, Updated, observations_of
from fleet_service.fusion.constants import EPOCH_NS
from fleet_service.fusion.fuse import RecordedResult
from fleet_service.ingest.dedup import SequenceTrackers
from fleet_service.ingest.grouping import group_rows
from fleet_service.ingest.weather import archived_reports
from fleet_service.replay.streams import IDENTITY, Begin, pseudonym_numbers
from schemas import grid
from schemas.errors import InputError
from schemas.numeric import BoolArray, IntArray
from schemas.runtime.process import trim_memory
from schemas.signals import FLAGS
from schemas.thresholds import US_STEP
from schemas.wire import Kind

# columns that the fusion needs
COLUMNS: Final = [
    *(
        "leave_time",
        "cell",
        "sector",
        "latitude",
        "position_std",
        "yaw",
        "mu",
        "mu_lower",
        "mu_upper",
    ),
    *("mu_utilised", "log_likelihood", *IDENTITY, "row", "late", "weight"),
    *("used_longitudinal", "used_lateral", "late_by", *FLAGS),
]
# columns that are read in addition if only some rows are selected
FILTERED: Final = ("longitude", "received_at")
Box = tuple[float, float, float, float]  # west, south, east, north [deg]
# Largest number of rows of a day in memory at once: 200 MB, and as much for the next part, which is
# read meanwhile.
PART_ROWS: Final = 4_000_000
# Number of rows that are fused at once. Intermediate results take four times their memory.
CHUNK_ROWS: Final = 100_000
_PACKED: Final = pa.ipc.IpcWriteOptions(compression="lz4")
SEGMENT_ROW_BYTES: Final = 60  # smallest size of a row in the inbox
# [deg] Margin around a box: over 100 m, which is more than the position error of a visit.
MARGIN_DEG: Final = 0.002


class Since(NamedTuple):
    """Selection of rows for a replay.

    Once the trust in each vehicle is known, a cell does not depend on distant cells. Therefore
    cells inside a box get the same belief (probability of each friction value) as in a complete
    replay, if the rows within MARGIN_DEG around the box are read too.

    Attributes:
        begin: day and segment at which the replay starts.
        included: record of the batches (messages with records) that are already included at the
            start. Their rows are left out; a compacted (sorted) file may contain them too.
        until: only rows received until this time are selected [ns].
        box: only rows near this box are selected [deg].
        max_rows: maximum number of rows; if there are more, an error is raised.
    """

    begin: Begin = Begin()
    included: SequenceTrackers | None = None
    until: int | None = None
    box: Box | None = None
    max_rows: int | None = None

    def near(self) -> Box | None:
        """Return `box` enlarged by 2·MARGIN_DEG on each side [deg]; None if `box` is None. A replay
        must read the files of all zones (map squares of zoom 7) that touch the enlarged box.

        The first margin is that of the selected rows (see `Since`). The second is needed because a
        row is selected by its position but stored by its cell, which may lie in another zone.
        """
        if self.box is None:
            return None
        west, south, east, north = self.box
        return (
            west - 2 * MARGIN_DEG,
            south - 2 * MARGIN_DEG,
            east + 2 * MARGIN_DEG,
            north + 2 * MARGIN_DEG,
        )

    def where(self) -> list[ValueRange] | None:
        """Return the filters on columns that select the archived rows of a replay; None for all
        rows.
        """
        found = (
            [] if self.until is None else [ValueRange("received_at", most=self.until // US_STEP)]
        )
        if self.box is not None:
            west, south, east, north = self.box
            found.append(ValueRange("longitude", west - MARGIN_DEG, east + MARGIN_DEG))
            found.append(ValueRange("latitude", south - MARGIN_DEG, north + MARGIN_DEG))
        return found or None


EpochListener = Callable[[Observations], AbstractContextManager[None]]


def ignore_observations(_: Observations) -> AbstractContextManager[None]:
    """Return a context that does nothing: the default for the argument `listener` of `replay`."""
    return nullcontext()


def too_much() -> InputError:
    """Return the InputError for a query about a past map that would have to read too many rows."""
    return InputError("at", "the query would read too much of the archive", "use a smaller bbox")


def fusion_with_weather(root: Path, lateness_s: float, until: int, since: int = 0) -> Fusion:
    """Return a fusion (beliefs about the friction of all cells) that contains the weather received
    until the time `until` [ns] that took effect at the time `since` [ns] or later, and no
    observations.

    Raises:
        OSError: the archive cannot be read.
    """
    fusion = Fusion(lateness_s)
    fusion.update_weather(archived_reports(root, received_until=until, acts_since=since))
    return fusion


def past_fusion(
    root: Path,
    lateness_s: float,
    until: int,
    box: Box | None = None,
    most: int | None = None,
    make_listener: Callable[[Fusion], EpochListener] | None = None,
) -> Fusion:
    """Return the fusion (beliefs about the friction of the cells) at a past moment, near a box
    (west, south, east, north [deg]). It contains everything that the service had received until the
    time `until` [ns].

    To build other data together with the fusion, a caller gives a `make_listener`. It is called
    once, with the new fusion, and returns the function that `replay` uses as `listener`.

    Raises:
        InputError: there are more rows than `most`.
        OSError: the archive cannot be read.
    """
    day = until // layout.DAY_NS - layout.MAP_DAYS
    fusion = fusion_with_weather(root, lateness_s, until, (day - 1) * layout.DAY_NS)
    selection = Since(Begin(day), until=until, box=box, max_rows=most)
    listener = ignore_observations if make_listener is None else make_listener(fusion)
    for _ in replay(root, fusion, selection, listener=listener):
        pass  # a past map has no alerts
    return fusion


def first_day(root: Path) -> int | None:
    """Return the first day that matters to a service (days since 1970): layout.MAP_DAYS before the
    last day with rows; None for an empty archive.

    Vehicles do not send older batches again (ServiceConfig.oldest_s), and older batches no longer
    affect the map.
    """
    found = [
        layout.day_of(folder)
        for kind in Kind
        for folder in layout.day_folders(root, layout.TABLES[kind])
    ]
    return max(found) - layout.MAP_DAYS if found else None


def replay(
    root: Path,
    fusion: Fusion,
    since: Since = Since(),  # noqa: B008 immutable
    damaged: Damaged = skip_damaged,
    listener: EpochListener = ignore_observations,
) -> Iterator[Updated]:
    """Replay archived observations into `fusion` in order of time. Yield once per epoch (minute) of
    the fusion. Each row is fused with the trust in its vehicle (vote weight) that the service
    recorded with the row.

    One day is read at a time, a large day in parts, so that memory does not grow with the archive.

    Args:
        root: folder of the archive.
        fusion: beliefs about the friction of all cells: empty, or restored from a checkpoint (saved
            state) that contains all rows before `since.begin`.
        since: selection of the rows to replay.
        damaged: called with each damaged file.
        listener: called with the observations of an epoch; they are fused inside the context that
            it returns. With this, the caller can update other data together with the fusion.
    """
    last = None if since.until is None else since.until // layout.DAY_NS + 1
    where = since.where()
    columns = COLUMNS if where is None else [*COLUMNS, *FILTERED]
    days = (since.begin.day, last)
    selection = reading.RowSelection(
        columns, where, days, since.begin.after, since.begin.until, since.near()
    )
    # late rows that were fused after the end of their table, with the recorded result
    waiting: list[tuple[Observations, RecordedResult]] = []
    known = vehicle_ids.read_numbers(root / "keys")
    for table in in_order(
        reading.Listing(root, Kind.OBSERVATION, selection, damaged), since.max_rows
    ):
        rows = segments.rows_of(table)
        if since.included is not None:
            new = ~_are_known(rows, since.included)
            rows = {name: column[new] for name, column in rows.items()}
        observations = observations_of(rows, vehicle_ids.numbers_of(known, rows["vehicle"]))
        before = _recorded_result(rows)
        end = int(segments.to_nanoseconds(table["leave_time"]).max(initial=0)) // EPOCH_NS
        observations, before = _join_parts([*waiting, (observations, before)])
        epoch = (observations.time + before.late_by) // EPOCH_NS
        waiting = [_select_rows(observations, before, epoch > end)]
        yield from _fuse_epochs(fusion, *_select_rows(observations, before, epoch <= end), listener)
    if waiting:
        yield from _fuse_epochs(fusion, *waiting[0], listener)


def _are_known(rows: segments.Rows, known: SequenceTrackers) -> BoolArray:
    """Return a mask of archived rows (n,): True if the row's batch is in `known`."""
    vehicle, boot, region, seq = (rows[name] for name in IDENTITY)
    stream, _ = group_rows(vehicle.copy(), boot, region)
    batch, first = group_rows(stream.astype(np.int64), seq, seq)
    names = np.stack([rows[name][first] for name in IDENTITY], axis=1)
    return known.find_accepted(Kind.OBSERVATION, names)[batch]


def _recorded_result(rows: segments.Rows) -> RecordedResult:
    """Return what the service recorded for archived rows (n,) when it first processed them: True
    for a late row, the row's delay [ns], and the trust in its vehicle.
    """
    return RecordedResult(rows["late"].astype(bool), rows["late_by"], rows["weight"])


def _join_parts(
    parts: list[tuple[Observations, RecordedResult]],
) -> tuple[Observations, RecordedResult]:
    """Return several parts of archived observations, each with its recorded results (lateness and
    vote weight), joined into one in the given order.
    """
    of = Observations(
        **{
            f.name: np.concatenate([getattr(observations, f.name) for observations, _ in parts])
            for f in fields(Observations)
        }
    )
    befores = [before for _, before in parts]
    return of, RecordedResult(
        late=np.concatenate([b.late for b in befores]),
        late_by=np.concatenate([b.late_by for b in befores]),
        weight=np.concatenate([b.weight for b in befores]),
    )


def _select_rows(
    observations: Observations, before: RecordedResult, rows: BoolArray | IntArray | slice
) -> tuple[Observations, RecordedResult]:
    """Return a selection of archived observations (n,) and of their recorded results (lateness and
    vote weight). `rows` is a mask, an array of indices, or a slice.
    """
    return observations.take(rows), RecordedResult(
        before.late[rows], before.late_by[rows], before.weight[rows]
    )


def _fuse_epochs(
    fusion: Fusion, observations: Observations, before: RecordedResult, listener: EpochListener
) -> Iterator[Updated]:
    """Add archived observations to the beliefs about friction epoch by epoch (minute by minute), in
    order of the time at which they were first processed.
    """
    time = observations.time + before.late_by
    order = np.argsort(time, kind="stable")
    observations, before = _select_rows(observations, before, order)
    borders = np.flatnonzero(np.diff(time[order] // EPOCH_NS)) + 1
    for start, stop in pairwise([0, *borders.tolist(), len(order)]):
        if start < stop:
            taken, used = _select_rows(observations, before, slice(start, stop))
            with listener(taken):
                updated = fusion.update(taken, used)
            yield updated


def in_order(listing: reading.Listing, most: int | None = None) -> Iterator[pa.Table]:
    """Yield the rows of the archive files in `listing` in chunks of about CHUNK_ROWS, in order of
    time. A chunk ends between two epochs (minutes). Vehicles are given as numbers.

    A day with more than PART_ROWS rows is processed in parts, and its files are read again for each
    part. Without the limit `most`, a thread reads the next part while the caller uses the present
    one. With the limit, parts are read one after the other.

    Raises:
        InputError: there are more than `most` rows.
    """
    parts = _split_parts(listing, most)
    if most is None:
        parts = _prefetch_parts(parts)
    for held in parts:
        yield from held.chunks()
        pa.default_memory_pool().release_unused()  # so that the next part can use this memory
        trim_memory()


def _prefetch_parts(parts: Iterator[_Held]) -> Iterator[_Held]:
    """Yield the given parts of the archive's rows unchanged. A thread prepares each part while the
    previous one is used, because reading takes a third of the start time.
    """
    with ThreadPoolExecutor(1, "reads ahead") as thread:
        coming = thread.submit(next, parts, None)
        while (part := coming.result()) is not None:
            coming = thread.submit(next, parts, None)
            yield part


def _split_parts(listing: reading.Listing, most: int | None) -> Iterator[_Held]:
    """Yield the rows of the archive files in `listing` in parts of about PART_ROWS. If there are
    more than `most` rows, an InputError is raised.
    """
    name = layout.TIME[listing.kind]
    fresh = [table for table in listing.inbox() if table.num_rows]
    inbox = pa.concat_tables(fresh).sort_by(name) if fresh else None
    seen = 0
    inbox_days = (
        np.zeros(0, np.int64)
        if inbox is None
        else segments.to_nanoseconds(inbox[name]) // layout.DAY_NS
    )
    files: dict[int, list[Path]] = {day: [] for day in np.unique(inbox_days).tolist()}
    for path in listing.files:
        files.setdefault(layout.partition_of(path).day, []).append(path)
    for day in sorted(files):
        begin, end = np.searchsorted(inbox_days, [day, day + 1]).tolist()
        mine = None if inbox is None else inbox.slice(begin, end - begin)
        rows = end - begin + sum(_rows_of(path) for path in files[day])
        for low, high in pairwise(
            _time_borders(day * layout.DAY_NS, (day + 1) * layout.DAY_NS, rows, PART_ROWS)
        ):
            within = (
                [ValueRange(name, low // US_STEP, high // US_STEP - 1)]
                if high - low < layout.DAY_NS
                else []
            )
            borders = _time_borders(low, high, rows * (high - low) // layout.DAY_NS, CHUNK_ROWS)
            held = _Held(name, borders)
            if mine is not None:
                held.take(filter_table(mine, within))
                held.keep()
            _hold_files(held, listing, files[day], within, None if most is None else most - seen)
            seen += held.rows
            yield held


def _hold_files(
    held: _Held,
    listing: reading.Listing,
    files: Iterable[Path],
    within: list[ValueRange],
    most: int | None,
) -> None:
    """Add the rows of the archive's files in the range `within` to `held`. Raise an InputError if
    it then contains more than `most` rows.
    """
    for path in files:
        if listing.load_groups(path, within, held.take):
            held.keep()
        else:
            held.forget()
        if most is not None and held.rows > most:
            raise too_much()


class _Held:
    """Rows of a replay that wait until their chunk (rows between two times) is complete. They are
    compressed to a third of their memory.

    Args:
        name: name of the column that contains the time.
        borders: times at which one chunk ends and the next begins [ns].
    """

    def __init__(self, name: str, borders: list[int]) -> None:
        self._name = name
        self._borders = borders
        self._kept: list[list[pa.Buffer]] = [[] for _ in borders[1:]]
        # parts that are not confirmed yet: chunk number, number of rows, compressed rows
        self._taken: list[tuple[int, int, pa.Buffer]] = []
        self.rows = 0

    def take(self, table: pa.Table) -> None:
        """Add rows of a file provisionally, until the whole file has been read: then `keep`
        confirms them, or `forget` drops them.
        """
        time = segments.to_nanoseconds(table[self._name])
        order = np.argsort(time, kind="stable")
        table = _with_numbers(table).take(order)
        places = np.searchsorted(time[order], self._borders).tolist()
        for k, (start, stop) in enumerate(pairwise(places)):
            if stop > start:
                sink = pa.BufferOutputStream()
                with pa.ipc.new_stream(sink, table.schema, options=_PACKED) as stream:
                    stream.write_table(table.slice(start, stop - start))
                self._taken.append((k, stop - start, sink.getvalue()))

    def keep(self) -> None:
        """Confirm the provisionally added rows, because their file was read completely."""
        for k, rows, packed in self._taken:
            self._kept[k].append(packed)
            self.rows += rows
        self._taken.clear()

    def forget(self) -> None:
        """Drop the rows that were added provisionally, because their file is damaged."""
        self._taken.clear()

    def chunks(self) -> Iterator[pa.Table]:
        """Yield the rows between every two successive `borders`, in order. Call this only once."""
        for k, packed in enumerate(self._kept):
            self._kept[k] = []
            if packed:
                yield pa.concat_tables([pa.ipc.open_stream(one).read_all() for one in packed])


def _time_borders(low: int, high: int, rows: int, most: int) -> list[int]:
    """Return the borders [ns] of parts of whole minutes that divide the interval from `low` to
    `high`. Each part has about `most` rows if the interval's `rows` rows are evenly spread in time.
    """
    epochs = (high - low) // EPOCH_NS
    parts = max(1, min(-(-rows // most), epochs))
    return [low + int(part) * EPOCH_NS for part in np.linspace(0, epochs, parts + 1)]


def _with_numbers(table: pa.Table) -> pa.Table:
    """Return a table of archived rows with numbers in place of the vehicles' pseudonyms (texts),
    which takes less than half the memory.
    """
    at = table.column_names.index("vehicle")
    return table.set_column(at, "vehicle", pa.array(pseudonym_numbers(table["vehicle"])))


def rows_near(root: Path, until: int, box: Box | None, most: int) -> int:
    """Return an upper bound of the number of rows that `past_fusion` would read, from file sizes
    and footers alone. Beyond `most` rows, counting stops and the result is only some number above
    `most`.

    Raises:
        OSError: the archive cannot be read.
    """
    last = until // layout.DAY_NS + 1
    found = (
        sum(path.stat().st_size for path in segments.list_segments(root, Kind.OBSERVATION))
        // SEGMENT_ROW_BYTES
    )
    for path in layout.compacted_files(root, Kind.OBSERVATION, last - layout.MAP_DAYS - 1, last):
        if found > most:
            break
        zone = grid.bounds(np.array([layout.partition_of(path).zone]), grid.ZONE_ZOOM)
        if box is None or grid.touches(box, zone)[0]:
            found += _rows_of(path, box)
    return found


def _rows_of(path: Path, box: Box | None = None) -> int:
    """Return the number of rows of a file, from its footer, counting only row groups near a box; 0
    if the file does not exist or cannot be read.
    """
    try:
        footer = pq.read_metadata(path)
    except (OSError, pa.ArrowInvalid):
        return 0
    near = Since(box=box).where() or ()
    return sum(int(footer.row_group(group).num_rows) for group in matching_row_groups(footer, near))
