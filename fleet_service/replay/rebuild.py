"""From the archive back to what a service knows, or knew: which batches it holds, and what it believes."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import fields
from functools import reduce
from operator import and_
from pathlib import Path
from typing import Any, Final, NamedTuple

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc
import pyarrow.parquet as pq

from fleet_service.archive import layout, reading, segments
from fleet_service.archive.load import Damaged, pass_over
from fleet_service.archive.pseudonyms import number
from fleet_service.archive.witnesses import numbers_of
from fleet_service.fusion import Fusion, Observations, Updated, observations_of
from fleet_service.fusion.constants import EPOCH_NS
from fleet_service.fusion.fuse import Before
from fleet_service.fusion.standing import ERRORS, UNKNOWN
from fleet_service.ingest.dedup import SequenceTrackers
from fleet_service.ingest.weather import archived
from schemas import grid
from schemas.numeric import BoolArray, IntArray
from schemas.tables import US, US_STEP
from schemas.wire import Kind

IDENTITY: Final = ["vehicle", "boot", "region", "seq"]
_FIRST_TIME: Final = {Kind.OBSERVATION: "enter_time", Kind.STATE: "time"}  # by which a batch is too old
COLUMNS: Final = [
    *("leave_time", "cell", "sector", "latitude", "longitude", "position_std", "yaw", "mu", "mu_lower", "mu_upper"),
    *("mu_utilised", "log_likelihood", *IDENTITY, "row", "received_at", "late", "weight"),
    *("used_longitudinal", "used_lateral", "late_by", *ERRORS),
]  # of what the fusion takes
Box = tuple[float, float, float, float]  # west, south, east, north [deg]
# Days of observations that show in the map, and of batches that may come again (ServiceConfig.oldest_s is 30 days).
MAP_DAYS: Final = 31
PART_ROWS: Final = 1_000_000  # of a replay at once: 300 MB while they are sorted
SEGMENT_ROW_BYTES: Final = 60  # in the inbox, at the least
MARGIN_DEG: Final = 0.002  # around a box: over 100 m, more than a visit's position error moves what it tells


class Begin(NamedTuple):
    """Where an archive begins to matter: the first day of measurement, and the place in the log after which it does."""

    day: int | None = None
    after: layout.Cut | None = None


def restore_streams(
    root: Path, streams: SequenceTrackers, begin: Begin = Begin(), damaged: Damaged = pass_over  # noqa: B008 immutable
) -> None:  # fmt: skip
    """Note every archived batch as admitted, file by file.

    Args:
        root: of the archive.
        streams: those that are noted already; brought up to date.
        begin: where the archive begins to matter.
        damaged: is told of a damaged file.
    """
    for kind, first in _FIRST_TIME.items():
        columns = (*IDENTITY, "first_held", first)
        wanted = reading.Wanted(columns, days=(begin.day, None), after=begin.after)
        for table in reading.read_wanted(root, kind, wanted, damaged):
            boot, region, seq, first_held = (table[name].to_numpy() for name in (*IDENTITY[1:], "first_held"))
            time = segments.nanoseconds(table[first])
            streams.restore(kind, numbers(table["vehicle"]), boot, region, seq, first_held, time)


def numbers(pseudonyms: pa.ChunkedArray[Any] | pa.Array[Any]) -> IntArray:
    """Pseudonyms (n,) as numbers."""
    chunked = pseudonyms if isinstance(pseudonyms, pa.ChunkedArray) else pa.chunked_array([pseudonyms])
    coded = chunked.combine_chunks().dictionary_encode()
    if not len(coded):
        return np.zeros(0, np.int64)
    each = np.array([number(pseudonym) for pseudonym in coded.dictionary.to_pylist()], np.int64)
    return np.asarray(each[coded.indices.to_numpy()])


class Since(NamedTuple):
    """Which rows a replay takes: from a place in the log and a day on, received until `until` [ns], near `box` [deg].

    Cells do not depend on each other once weights are known, so that those well inside a box come out as in a whole
    replay. Of compacted files that reach over the place in the log, the batches that `known` has are left out.
    """

    begin: Begin = Begin()
    known: SequenceTrackers | None = None
    until: int | None = None
    box: Box | None = None

    def where(self) -> pc.Expression | None:
        """The rows as a filter, or None for all."""
        parts = []
        if self.until is not None:
            parts.append(pc.field("received_at") <= _time(self.until))
        if self.box is not None:
            west, south, east, north = self.box
            parts.append((pc.field("longitude") > west - MARGIN_DEG) & (pc.field("longitude") < east + MARGIN_DEG))
            parts.append((pc.field("latitude") > south - MARGIN_DEG) & (pc.field("latitude") < north + MARGIN_DEG))
        return reduce(and_, parts) if parts else None


def _time(ns: int) -> pa.Scalar[Any]:
    return pa.scalar(ns // US_STEP, pa.int64()).cast(US)


def past(root: Path, lateness_s: float, until: int, box: Box | None = None) -> Fusion:
    """The fusion of a service that had received everything until a moment [ns], near a box [deg].

    Raises:
        OSError: the archive cannot be read.
    """
    fusion = Fusion(lateness_s)
    fusion.update_weather(archived(root, received_until=until))
    for _ in replay(root, fusion, Since(Begin(until // layout.DAY_NS - MAP_DAYS), until=until, box=box)):
        pass  # the alerts of then are history
    return fusion


def first_day(root: Path) -> int | None:
    """The first day that matters to a service: MAP_DAYS before the last that the archive has rows of.

    Neither batches that are older come again (ServiceConfig.oldest_s), nor does anything of them show in the map.
    """
    found = [layout.day_of(folder) for kind in Kind for folder in layout.days(root, layout.TABLES[kind])]
    return max(found) - MAP_DAYS if found else None


def replay(
    root: Path,
    fusion: Fusion,
    since: Since = Since(),  # noqa: B008 immutable
    damaged: Damaged = pass_over,
) -> Iterator[Updated]:
    """Replay the archive into `fusion` in order of time, with the weights that were used; yields once per epoch.

    A day is read at a time, a large one in parts, so that memory does not grow with the archive.

    Args:
        root: of the archive.
        fusion: a new one, or one that holds everything before `since`.
        since: the rows wanted.
        damaged: is told of a damaged file.
    """
    last = None if since.until is None else since.until // layout.DAY_NS + 1
    wanted = reading.Wanted(COLUMNS, since.where(), (since.begin.day, last), since.begin.after)
    waiting: list[tuple[Observations, Before]] = []  # late rows that were fused after the end of their table
    for table in in_order(reading.Listing(root, Kind.OBSERVATION, wanted, damaged)):
        vehicle = numbers(table["vehicle"])
        rows = segments.rows_of(table.drop_columns(["vehicle"]))
        new = np.ones(len(vehicle), bool)
        if since.known is not None:
            names = np.stack([vehicle, rows["boot"], rows["region"], rows["seq"]], axis=1)
            distinct, index = np.unique(names, axis=0, return_inverse=True)
            new = ~since.known.accepted(Kind.OBSERVATION, distinct)[index.reshape(-1)]
        rows = {name: column[new] for name, column in rows.items()}
        o = observations_of(rows, numbers_of(root / "keys", vehicle[new]))
        before = _before(rows)
        end = int(segments.nanoseconds(table["leave_time"]).max(initial=0)) // EPOCH_NS
        o, before = _joined([*waiting, (o, before)])
        epoch = (o.time + before.late_by) // EPOCH_NS
        waiting = [_taken(o, before, epoch > end)]
        yield from _fused(fusion, *_taken(o, before, epoch <= end))
    if waiting:
        yield from _fused(fusion, *waiting[0])


def _before(rows: segments.Rows) -> Before:
    """What was used of rows; of an older version nothing is known of the vehicles' errors."""
    error = np.stack([rows[name] for name in ERRORS], axis=1)
    error = np.where(np.isnan(error), np.array(UNKNOWN, np.float32), error)
    return Before(rows["late"].astype(bool), rows["late_by"], rows["weight"], error)


def _joined(parts: list[tuple[Observations, Before]]) -> tuple[Observations, Before]:
    """Parts one after the other."""
    of = Observations(
        **{f.name: np.concatenate([getattr(o, f.name) for o, _ in parts]) for f in fields(Observations)}
    )  # fmt: skip
    told = [before for _, before in parts]
    return of, Before(
        late=np.concatenate([b.late for b in told]), late_by=np.concatenate([b.late_by for b in told]),
        weight=np.concatenate([b.weight for b in told]), error=np.concatenate([b.error for b in told]),
    )  # fmt: skip


def _taken(o: Observations, before: Before, rows: BoolArray | IntArray) -> tuple[Observations, Before]:
    """Some of the rows."""
    return o.take(rows), Before(before.late[rows], before.late_by[rows], before.weight[rows], before.error[rows])


def _fused(fusion: Fusion, o: Observations, before: Before) -> Iterator[Updated]:
    """Fuse rows epoch by epoch of when they were fused."""
    time = o.time + before.late_by
    order = np.argsort(time, kind="stable")
    for part in np.split(order, np.flatnonzero(np.diff(time[order] // EPOCH_NS)) + 1):
        if len(part):
            yield fusion.update(*_taken(o, before, part))


def in_order(listing: reading.Listing) -> Iterator[pa.Table]:
    """The rows of a listing by rising time of measurement, PART_ROWS at a time or so, cut between epochs."""
    time = layout.TIME[listing.kind]
    fresh = [table for table in listing.inbox() if table.num_rows]
    inbox = pa.concat_tables(fresh).sort_by(time) if fresh else None
    inbox_days = np.zeros(0, np.int64) if inbox is None else segments.nanoseconds(inbox[time]) // layout.DAY_NS
    files: dict[int, list[Path]] = {day: [] for day in np.unique(inbox_days).tolist()}
    for path in listing.files:
        files.setdefault(layout.partition_of(path).day, []).append(path)
    for day in sorted(files):
        begin, end = np.searchsorted(inbox_days, [day, day + 1]).tolist()
        mine = None if inbox is None else inbox.slice(begin, end - begin)
        rows = end - begin + sum(_rows_of(path) for path in files[day])
        parts = max(1, min(-(-rows // PART_ROWS), layout.DAY_NS // EPOCH_NS))
        borders = (
            np.linspace(0, layout.DAY_NS // EPOCH_NS, parts + 1).astype(np.int64) * EPOCH_NS
        ) + day * layout.DAY_NS
        for low, high in zip(borders[:-1].tolist(), borders[1:].tolist(), strict=True):
            within = (pc.field(time) >= _time(low)) & (pc.field(time) < _time(high)) if parts > 1 else None
            tables = [] if mine is None else [mine if within is None else mine.filter(within)]
            tables += [table for path in files[day] if (table := listing.load(path, within)) is not None]
            if sum(table.num_rows for table in tables):
                yield pa.concat_tables(tables).sort_by(time)


def rows_near(root: Path, until: int, box: Box | None, most: int) -> int:
    """Rows that `past` would have to read at the most, by footers alone; counts no further than beyond `most`.

    Raises:
        OSError: the archive cannot be read.
    """
    last = until // layout.DAY_NS + 1
    found = sum(path.stat().st_size for path in segments.paths(root, Kind.OBSERVATION)) // SEGMENT_ROW_BYTES
    for path in layout.compacted(root, Kind.OBSERVATION, last - MAP_DAYS - 1, last):
        if found > most:
            break
        zone = grid.bounds(np.array([layout.partition_of(path).zone]), grid.ZONE_ZOOM)
        if box is None or grid.touches(box, zone)[0]:
            found += _rows_of(path, box)
    return found


def _touches(group: Any, columns: dict[str, int], box: Box) -> bool:  # noqa: ANN401 metadata of a row group
    """Whether a row group may have rows in a box, by its statistics."""
    west, south, east, north = box
    for name, least, most in (("longitude", west, east), ("latitude", south, north)):
        found = group.column(columns[name]).statistics
        if (
            found is not None
            and found.has_min_max
            and (found.max < least - MARGIN_DEG or found.min > most + MARGIN_DEG)
        ):
            return False
    return True


def _rows_of(path: Path, box: Box | None = None) -> int:
    """Rows of a file by its footer, of row groups near a box; 0 if it has none that can be read, or is gone."""
    try:
        footer = pq.read_metadata(path)
    except (OSError, pa.ArrowInvalid):
        return 0
    if box is None:
        return int(footer.num_rows)
    columns = {footer.schema.column(at).path: at for at in range(footer.num_columns)}
    groups = (footer.row_group(at) for at in range(footer.num_row_groups))
    return int(sum(group.num_rows for group in groups if _touches(group, columns, box)))
