"""Removal of data: raw rows after a number of days (their hourly statistics stay), and all rows of
one vehicle.

Only these two operations remove or rewrite a compacted (sorted) file.
"""

from __future__ import annotations

import math
import shutil
from collections.abc import Iterator
from contextlib import contextmanager
from datetime import date, timedelta
from pathlib import Path
from typing import Final, NamedTuple

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc

from fleet_service.archive.format import layout, reading, snapshots
from fleet_service.archive.format.files import COMPACTED, MAP, lock_archive, put_in_place
from fleet_service.archive.format.layout import TABLES
from fleet_service.archive.format.load import BAD, load_rows, read_content
from fleet_service.archive.format.row_filter import ValueRange, Where
from fleet_service.archive.format.segments import SCHEMAS, to_nanoseconds
from fleet_service.archive.format.version import KEY
from fleet_service.archive.identity import erasures, vehicle_ids
from fleet_service.archive.identity.pseudonyms import Pseudonyms, pseudonym_number
from fleet_service.archive.maintenance import iceberg, rollup
from fleet_service.archive.maintenance.compaction import compact, hold_compaction_lock
from schemas.config import LEAST_RAW_DAYS
from schemas.errors import InputError
from schemas.runtime.durable import sync_directory
from schemas.wire import Kind

# With fewer vehicles in a cell, a single one could be recognised. Same as in the secure settings.
ANONYMOUS: Final = 5
_KEYS: Final = "keys"


class RetirementResult(NamedTuple):
    """Result of `retire_rows`: number of days whose raw rows were removed, and number of removed
    files.
    """

    days: int
    files: int


def retire_rows(root: Path, raw_days: int, today: date) -> RetirementResult:
    """Remove rows that were measured more than `raw_days` before `today`. Their hourly statistics
    are completed first.

    Raises:
        InputError: `raw_days` is too small, or another process is compacting the archive.
        OSError: a file cannot be read, written or removed.
    """
    files = 0
    with hold_compaction_lock(root):
        rollup.complete_parts(root, until_day=_last_to_go(raw_days, today))
        folders = due_folders(root, raw_days, today)
        iceberg.unregister_files(root, [path for folder in folders for path in folder.glob("*/*")])
        for folder in folders:
            for path in sorted(folder.glob("*/*"), reverse=True):
                path.unlink()
                files += 1
            for zone in folder.iterdir():
                zone.rmdir()
            folder.rmdir()
            sync_directory(folder.parent)
    return RetirementResult(len(folders), files)


def due_folders(root: Path, raw_days: int, today: date) -> list[Path]:
    """Return the folders of the days whose raw rows `retire_rows` would remove.

    Raises:
        InputError: `raw_days` is too small.
    """
    last = _last_to_go(raw_days, today)
    return [day for kind in Kind for day in layout.day_folders(root, TABLES[kind], until_day=last)]


def _last_to_go(raw_days: int, today: date) -> int:
    if raw_days < LEAST_RAW_DAYS:
        raise InputError(
            "raw-days",
            f"{raw_days} are too few to recognise repeated batches",
            f"give {LEAST_RAW_DAYS} or more",
        )
    return (today - timedelta(days=raw_days + 1) - date(1970, 1, 1)).days


def forget_period(root: Path, month: str) -> None:
    """Destroy the key of a month (2026-01), so that its pseudonyms can no longer be attributed to
    vehicles.

    Raises:
        InputError: there is no such key, or a service is running on the archive.
        OSError: a file cannot be read or written.
    """
    with lock_archive(root):
        key_of(root, month)
        begin, until = erasures.span_of(month)
        destroy_key(
            root, month, _newest_first_time(root, (begin // layout.DAY_NS, None), until=until)
        )


def destroy_key(root: Path, month: str, newest: int) -> None:
    """Destroy the key of a month (2026-01), so that its pseudonyms can no longer be attributed to
    vehicles. The caller must have locked the archive and must not have data of the month in memory.

    Measurements of the month up to `newest` [ns], the time of the newest measurement in the
    archive, are not accepted again.

    Raises:
        InputError: there is no such key.
        OSError: the disk is full or broken; the key may still exist.
    """
    key = key_of(root, month)
    erasures.record_erasure(key.parent, month, newest)
    vehicle_ids.forget_vehicles(key.parent, month)
    key.unlink()
    sync_directory(key.parent)


def _newest_first_time(
    root: Path, days: tuple[int, int | None], where: Where = (), until: float = math.inf
) -> int:
    """Return the latest time [ns] at which a stored record of the days `days` begins (for example,
    a visit to a cell); -1 if there is no record. The search stops early when it finds a time of
    `until` or later.
    """
    newest = -1
    for kind, name in layout.FIRST_TIME.items():
        for table in reading.read_tables(
            root, kind, [name, *(one.column for one in where)], where, days
        ):
            newest = max(newest, int(to_nanoseconds(table[name]).max(initial=-1)))
            if newest >= until:
                return newest
    return newest


class ErasureResult(NamedTuple):
    """Result of `forget_vehicle`: number of removed rows, and the files that were rewritten or
    removed. `reason_kept` is the reason why the archive's copy still contains the rows, or None.
    """

    rows: int
    files: tuple[Path, ...]
    reason_kept: str | None = None


def forget_vehicle(root: Path, vehicle: str, month: str) -> ErasureResult:
    """Remove the rows of one vehicle in one month, and all derived data that could reveal them.

    Derived data are: rows with few vehicles in the month's snapshots (copies of the map), damaged
    files that were renamed, and checkpoints (saved states). Hourly statistics are computed again.
    Measurements of the vehicle in that month, up to the newest removed row, are not accepted again.

    Raises:
        InputError: the month's key does not exist, or a service is running on the archive (it has
            further data in memory).
        OSError: a file cannot be read or written.
    """
    with lock_archive(root):
        with erase_files(root, vehicle, month) as done:
            pass
        forget_witness(root, vehicle, month)
    return done


@contextmanager
def erase_files(root: Path, vehicle: str, month: str) -> Iterator[ErasureResult]:
    """Remove the rows of one vehicle in one month, and all derived data that could reveal them,
    from the files, while a service may write new rows. Only rows that exist at the beginning are
    removed. This is a context manager, which yields the result; no compaction can run until its
    block ends.

    Raises:
        InputError: the month's key does not exist.
        OSError: a file cannot be read or written.
    """
    key_of(root, month)
    compact(root)
    begin, end = _days_of_month(month)
    pseudonym = _pseudonym_of(root, vehicle, month)
    is_theirs = [ValueRange("vehicle", pseudonym, pseudonym)]
    newest = _newest_first_time(root, (begin, end), is_theirs)
    if newest >= 0:
        erasures.record_erasure(root / _KEYS, month, newest, pseudonym)
    rows = 0
    files = [*root.rglob(f"*{BAD}")]
    cells = set[int]()
    with hold_compaction_lock(root):
        drop_checkpoints(root)  # because they contain the vehicle's reports
        for damaged in files:  # because they may contain the vehicle's reports
            damaged.unlink()
        for kind in Kind:
            theirs = [
                path
                for path in layout.compacted_files(root, kind, begin, end)
                if _may_hold_vehicle(kind, path, pseudonym)
            ]
            iceberg.unregister_files(root, theirs)
            for path in theirs:
                removed = _remove_vehicle(root, kind, path, pseudonym)
                if not removed:
                    continue
                rows += len(removed)
                cells.update(removed)
                files.append(path)
                if kind is Kind.OBSERVATION:
                    files.append(rollup.part_of(path))
        for folder in layout.day_folders(root, snapshots.TABLE, begin, end):
            files += [
                path
                for path in sorted(folder.glob("*.parquet"))
                if _thin_snapshot(root, path, cells)
            ]
        yield ErasureResult(rows, tuple(files))


def forget_witness(root: Path, vehicle: str, month: str) -> None:
    """Remove the line that links a vehicle's pseudonym of a month to its permanent number in the
    map.

    Raises:
        OSError: the file cannot be written.
    """
    vehicle_ids.forget_vehicles(
        root / _KEYS, month, pseudonym_number(_pseudonym_of(root, vehicle, month))
    )


def _pseudonym_of(root: Path, vehicle: str, month: str) -> str:
    return Pseudonyms(root / _KEYS).of(vehicle, erasures.span_of(month).begin)


def _thin_snapshot(root: Path, path: Path, cells: set[int]) -> bool:
    """Remove from a map snapshot the rows of the given cells that have fewer than ANONYMOUS
    vehicles. In the other rows of these cells, round times to hours. Return True if the snapshot
    was changed.
    """
    found = read_content(path, _refuse_damaged)
    if found is None:
        return False
    touched = np.isin(found.table["cell"].to_numpy(), sorted(cells))
    lines = touched & (found.table["vehicles"].to_numpy() < ANONYMOUS)
    if not touched.any():
        return False
    stay = found.table
    for name in ("first_time", "last_time"):
        rounded = pc.floor_temporal(stay[name], unit="hour")
        column = pc.if_else(pa.array(touched), rounded, stay[name])
        stay = stay.set_column(stay.column_names.index(name), stay.field(name), column)
    stay = stay.filter(pa.array(~lines))
    put_in_place(root, stay, path, MAP, {KEY: str(found.version), **found.entries})
    return True


def rows_of_vehicle(root: Path, vehicle: str, month: str) -> int:
    """Return the number of rows of a vehicle in a month that `forget_vehicle` would remove, without
    removing them.

    Raises:
        InputError: the month's key does not exist.
        OSError: a file cannot be read.
    """
    key_of(root, month)
    pseudonym = _pseudonym_of(root, vehicle, month)
    where = [ValueRange("vehicle", pseudonym, pseudonym)]
    return sum(
        table.num_rows
        for kind in Kind
        for table in reading.read_tables(root, kind, ["vehicle"], where, _days_of_month(month))
    )


def drop_checkpoints(root: Path) -> None:
    """Delete all checkpoints (saved states of the service), because rows that they include are
    about to be removed. A restarted service then computes its state from the stored rows.

    Raises:
        OSError: a checkpoint cannot be removed.
    """
    if (root / layout.CHECKPOINTS).exists():
        shutil.rmtree(root / layout.CHECKPOINTS)
        sync_directory(root)


def _may_hold_vehicle(kind: Kind, path: Path, pseudonym: str) -> bool:
    """Return True if a file contains rows of the vehicle with this pseudonym; raise an error if the
    file is damaged.
    """
    found = load_rows(path, SCHEMAS[kind], ["vehicle"], damaged=_refuse_damaged)
    return found is not None and pseudonym in pc.unique(found["vehicle"]).to_pylist()


def _remove_vehicle(root: Path, kind: Kind, path: Path, pseudonym: str) -> list[int]:
    """Remove the rows of a vehicle from a file; return the cells of the removed rows."""
    found = read_content(path, _refuse_damaged)
    if found is None or pseudonym not in pc.unique(found.table["vehicle"]).to_pylist():
        return []
    theirs = pc.equal(found.table["vehicle"], pa.scalar(pseudonym))
    put_in_place(
        root,
        found.table.filter(pc.invert(theirs)),
        path,
        COMPACTED,
        {KEY: str(found.version), **found.entries},
    )
    if kind is Kind.OBSERVATION:
        rollup.make_part(root, path)
    return [int(cell) for cell in found.table["cell"].filter(theirs).to_numpy()]


def _refuse_damaged(path: Path, problem: str) -> None:
    """Raise an error for a damaged file, because it may contain rows that must be erased."""
    raise InputError(
        "archive",
        f"{path} is damaged ({problem})",
        "remove it or restore it from a backup, then run forget again",
    )


def key_of(root: Path, month: str) -> Path:
    """Return the path of the file with a month's pseudonym key.

    Raises:
        InputError: the file does not exist.
    """
    erasures.first_day(month)
    path = root / _KEYS / f"{month}.key"
    if not path.exists():
        raise InputError(
            "period",
            f"the archive has no key of {month}",
            "its rows can no longer be assigned to vehicles",
        )
    return path


def _days_of_month(month: str) -> tuple[int, int]:
    """Return two days between which all rows of a month lie: its first day, and the day after its
    last day. The latter is included, because a batch (message with records) has the pseudonym of
    its first record and may end a day later.
    """
    begin, until = erasures.span_of(month)
    return begin // layout.DAY_NS, until // layout.DAY_NS
