"""Input of road weather from Zenoh and from a Parquet file. Weather reports are checked and
archived, and then used by the map.

    weather/NAME-TIME.parquet     reports as received, with the time from which the map used them

A file is written whenever reports arrive. `join_daily_files` joins the files of a day, so that a
restart, or the computation of a past map, reads only one file per day. After a power loss a report
may be stored twice; the copies are identical and change nothing.

A report takes effect from the time `acts_from`. No observation from this time on has been fused
when the report arrives, and the report is durable before it takes effect. Therefore a replay of the
archive finds the same weather and gives the same map.
"""

from __future__ import annotations

import time
from collections import deque
from collections.abc import Collection
from contextlib import suppress
from datetime import UTC, datetime
from pathlib import Path
from typing import Any, Final, NamedTuple

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq

from fleet_service.archive.format.files import SEGMENT, write_table
from fleet_service.archive.format.layout import DAY_NS, read_epoch, with_term
from fleet_service.archive.format.load import Damaged, load_rows, skip_damaged
from fleet_service.archive.format.row_filter import ValueRange
from fleet_service.archive.format.segments import to_nanoseconds
from fleet_service.counts import ServiceCounts
from fleet_service.fusion import Fusion
from fleet_service.fusion.weather import VALID_NS, Reports
from schemas import grid, keys, mugrid, tables, weather
from schemas.errors import InputError
from schemas.runtime.durable import make_folder
from schemas.thresholds import NS, US_STEP
from schemas.weather import Report

FOLDER: Final = "weather"
# Largest number of waiting reports, enough for the regions of a continent; the oldest are dropped.
WAITING: Final = 10_000
MOST_BYTES: Final = 4096  # largest size of a report; with a prior as text it has about 1,000 bytes
# [ns] How far a report's time may be ahead: a day for forecasts. Beyond, the sender's clock is
# wrong.
AHEAD_NS: Final = 86_400 * NS
FIRST_NS: Final = 946_684_800 * NS  # 2000-01-01; an earlier time of a report is not in ns
_DIGITS: Final = 20  # digits of the time [ns] in a file's name
# Number of attempts to read the files while others join them. After these, there is another
# problem.
_TURNS: Final = 100
COLUMNS: Final = ("region", "time", *weather.RANGES, "prior")


class WeatherMessage(NamedTuple):
    """One message that was received on a weather key."""

    key: str
    payload: bytes
    encoding: str


class WeatherInbox:
    """Receiver of weather reports for one fusion (beliefs about the friction of all cells).

    Args:
        root: folder of the archive.
        name: name of the service, part of the file names.
        fusion: fusion that uses the reports.
        counts: counts of the service; refusals are counted in `refused["weather"]`.
    """

    def __init__(self, root: Path, name: str, fusion: Fusion, counts: ServiceCounts) -> None:
        self._folder = root / FOLDER
        self.fusion = fusion
        self._counts = counts
        self._name = with_term(name, read_epoch(root))
        self._waiting: deque[WeatherMessage] = deque(maxlen=WAITING)
        self._last = 0

    def enqueue(self, message: WeatherMessage) -> None:
        """Queue a received weather message for the next `take`; thread-safe."""
        if len(message.payload) > MOST_BYTES:
            self._counts.refused["weather"] += 1
        else:
            self._waiting.append(message)

    def take(self, now: int) -> Reports | None:
        """Archive the received weather reports; return them for the map, or None if there are
        none.
        """
        found: list[tuple[int, Report]] = []
        while self._waiting:
            message = self._waiting.popleft()
            try:
                found.append(_decode_report(message, now))
            except InputError:
                self._counts.refused["weather"] += 1
        return self._archive_reports(found, now) if found else None

    def begin(self, path: Path, now: int) -> Reports | None:
        """Archive those reports of a weather file that may still affect the map at `now` [ns] and
        are not in the archive yet. Return them, or None if there are none.

        Raises:
            InputError: the file cannot be read, or a row breaks a rule.
            OSError: the archive cannot be read.
        """
        known = archived_reports(self._folder.parent, acts_since=self.fusion.next_epoch - VALID_NS)
        seen = set(zip(known.region.tolist(), known.time.tolist(), strict=True))
        found = []
        for region, report in read_file(path):
            acts = max(report.time, self.fusion.next_epoch)
            if report.time > acts - VALID_NS and not {(region, report.time), (region, acts)} & seen:
                found.append((region, report))
        return self._archive_reports(found, now) if found else None

    def _archive_reports(self, found: list[tuple[int, Report]], now: int) -> Reports | None:
        table = _reports_table(found, now, self.fusion.next_epoch)
        self._last = max(time.time_ns(), self._last + 1)
        try:
            make_folder(self._folder)
            write_table(table, self._folder / f"{self._name}-{self._last:020d}.parquet", SEGMENT)
        # A report that is not archived must not take effect. The next one comes within the hour.
        except OSError:
            self._counts.failures["weather"] += 1
            return None
        return _read_reports(table)


def _decode_report(message: WeatherMessage, now: int) -> tuple[int, Report]:
    region = keys.parse(message.key).quadint
    report = weather.decode_report(message.payload, message.encoding)
    if region is None or not now - VALID_NS <= report.time <= now + AHEAD_NS:
        raise InputError("time", "too old, or more than a day ahead", "set the clock")
    return region, report


def _reports_table(found: list[tuple[int, Report]], now: int, next_epoch: int) -> pa.Table:
    found = sorted(found, key=lambda pair: pair[1].time)
    reports = [report for _, report in found]
    columns: dict[str, Any] = {name: [getattr(r, name) for r in reports] for name in weather.RANGES}
    columns["region"] = [region for region, _ in found]
    columns["time"] = [r.time for r in reports]
    columns["prior"] = [None if r.prior is None else r.prior.tolist() for r in reports]
    columns["received_at"] = [now] * len(found)
    columns["acts_from"] = [max(r.time, next_epoch) for r in reports]
    fields = tables.arrow_schema(*tables.WEATHER)
    table = pa.Table.from_arrays([pa.array(columns[f.name], f.type) for f in fields], schema=fields)
    return table.cast(tables.WEATHER_ARCHIVE, safe=False)


def _read_reports(table: pa.Table) -> Reports:
    prior = [
        np.full(mugrid.BINS, np.nan) if row is None else np.array(row)
        for row in table["prior"].to_pylist()
    ]
    air, road, water = (table[name].to_numpy().astype(np.float64) for name in weather.RANGES)
    acts = to_nanoseconds(table["acts_from"])
    return Reports(
        table["region"].to_numpy(), acts, air, road, water, np.array(prior).reshape(-1, mugrid.BINS)
    )


def archived_reports(
    root: Path,
    received_until: int | None = None,
    known: Collection[str] = (),
    damaged: Damaged = skip_damaged,
    acts_since: int = 0,
) -> Reports:
    """Return every report that a map used, in order of receipt, up to the time `received_until`
    [ns]. Reports that took effect before the time `acts_since` [ns], and files whose names are in
    `known`, are skipped.

    `damaged` is called with each damaged file. The reports of such a file are missing, so the map
    is computed as if the weather of these regions were unknown.

    Raises:
        InputError: a file has a newer major version.
        OSError: the archive cannot be read.
    """
    recent = [ValueRange("acts_from", acts_since // US_STEP)]
    parts = _load_parts(root, known, recent, damaged)
    table = pa.concat_tables([tables.WEATHER_ARCHIVE.empty_table(), *parts])
    if received_until is not None:
        table = table.filter(pa.array(to_nanoseconds(table["received_at"]) <= received_until))
    return _read_reports(table)


def _load_parts(
    root: Path, known: Collection[str], where: list[ValueRange], damaged: Damaged
) -> list[pa.Table]:
    """Return the rows of the archive's weather files, without the damaged files and those in
    `known`. Read them all again if another process meanwhile joined some into a daily file.
    """
    for _ in range(_TURNS):
        with suppress(FileNotFoundError):
            parts = [
                load_rows(path, tables.WEATHER_ARCHIVE, where=where, whole=True, damaged=damaged)
                for path in weather_files(root)
                if path.name not in known
            ]
            return [part for part in parts if part is not None]
    raise OSError(f"the weather of {root} changes faster than it can be read")


def weather_files(root: Path) -> list[Path]:
    """Return the paths of the archive's weather files in the order in which their reports were
    received.
    """
    return sorted((root / FOLDER).glob("*.parquet"), key=lambda path: path.stem[-_DIGITS:])


def join_daily_files(root: Path) -> int:
    """Join the weather reports of each day into one file; return the reduction in the number of
    files.

    Raises:
        InputError: a file has a newer major version.
        OSError: a file cannot be read or written; nothing is lost.
    """
    days: dict[int, list[Path]] = {}
    term = read_epoch(root)
    for path in weather_files(root):
        days.setdefault(_written_day(path), []).append(path)
    saved = 0
    for paths in (paths for paths in days.values() if len(paths) > 1):
        found = [
            (p, load_rows(p, tables.WEATHER_ARCHIVE, whole=True, damaged=skip_damaged))
            for p in paths
        ]
        whole = [(path, table) for path, table in found if table is not None]
        if len(whole) > 1:
            newest = whole[-1][0]
            name, _, moment = newest.name.rpartition("-")
            place = newest.with_name(f"{with_term(name, term)}-{moment}")
            write_table(pa.concat_tables([table for _, table in whole]), place, SEGMENT)
            for path, _ in whole:
                if path != place:
                    path.unlink()
            saved += len(whole) - 1
    return saved


def retire_files(root: Path, until_day: int) -> int:
    """Remove weather files whose reports took effect only up to the day `until_day` (days since
    1970); return the number of removed files.
    """
    removed = 0
    for path in weather_files(root):
        table = load_rows(path, tables.WEATHER_ARCHIVE, ["acts_from"])
        if (
            table is not None
            and int(to_nanoseconds(table["acts_from"]).max(initial=0)) // DAY_NS <= until_day
        ):
            path.unlink()
            removed += 1
    return removed


def _written_day(path: Path) -> int:
    """Return the day on which a weather file was written (days since 1970), from its name."""
    return int(path.stem[-_DIGITS:]) // DAY_NS


def read_file(path: Path) -> list[tuple[int, Report]]:
    """Return region and weather report of every row of a Parquet file.

    The file has the columns `region` (quadint, a number, of zoom 10; or quadkey of 10 digits),
    `time` (timestamp, or ns), and any of the weather columns. Null or NaN means unknown.

    Raises:
        InputError: the file cannot be read, or a value is not valid; the error names the row, the
            column and the fix.
    """
    try:
        rows = pq.read_table(path).to_pylist()
    except (OSError, pa.ArrowInvalid) as error:
        raise InputError(
            "weather", f"cannot read {path}", "give a Parquet file of road weather"
        ) from error
    return [_parse_row(number, row) for number, row in enumerate(rows)]


def _parse_row(number: int, row: dict[str, Any]) -> tuple[int, Report]:
    fix = f"give region, time and any of {', '.join(COLUMNS[2:])}"
    if unknown := row.keys() - set(COLUMNS):
        raise InputError("weather", f"{sorted(unknown)[0]} is not a column of road weather", fix)
    try:
        region = row["region"]
        at = row["time"]
        region = grid.from_quadkey(region) if isinstance(region, str) else int(region)
        when = at if isinstance(at, int) else _to_utc_ns(at)
        values = {
            name: np.nan if row.get(name) is None else float(row[name]) for name in weather.RANGES
        }
        prior = None if row.get("prior") is None else np.array(row["prior"], np.float64)
    except (KeyError, TypeError, ValueError, AttributeError) as error:
        raise InputError(
            "weather", f"row {number}: region, time or a number is missing", fix
        ) from error
    problem = weather.find_report_error(values, prior)
    if problem is not None or not 0 <= region < 1 << (2 * grid.REGION_ZOOM):
        refusal = problem or InputError(
            "region", "is not a z10 region", "use its quadint or quadkey"
        )
        raise InputError(f"weather row {number}, {refusal.field}", refusal.problem, refusal.fix)
    if when < FIRST_NS:
        fix = "give a timestamp, or ns since 1970"
        raise InputError(f"weather row {number}, time", "lies before 2000", fix)
    return region, Report(when, prior=prior, **values)


def _to_utc_ns(time: datetime) -> int:
    """Return a time in ns since 1970; without a zone it is UTC."""
    utc = time if time.tzinfo is None else time.astimezone(UTC)
    return int(np.datetime64(utc.replace(tzinfo=None), "ns").astype(np.int64))
