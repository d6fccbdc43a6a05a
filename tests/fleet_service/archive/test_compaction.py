"""Tests of compaction (sorting of new rows into files by cell): it loses and doubles no row,
wherever it is interrupted and whichever program reads the archive.
"""

from __future__ import annotations

import errno
import os
import shutil
import threading
import time
from collections.abc import Callable
from contextlib import closing
from pathlib import Path
from time import time_ns
from typing import Literal

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest

from fleet_service.app.engine import Engine
from fleet_service.archive.format import files, layout, reading, segments
from fleet_service.archive.format import load as loading
from fleet_service.archive.format.segments import Writer
from fleet_service.archive.maintenance import compaction
from fleet_service.archive.maintenance.compaction import compact, hold_compaction_lock
from fleet_service.cli import main
from schemas import grid, tables
from schemas.config import ServiceConfig
from schemas.errors import InputError
from schemas.wire import Kind
from tests.fleet_service.archive.rows import fill, identities, rows_of
from tests.fleet_service.archive.test_archive import make_message, read_settled

SEGMENTS = 4
ROWS = 50


class DiedError(BaseException):
    """Exception that simulates the death of the process; no handler of the service catches it."""


def public(root: Path, kind: Kind) -> list[tuple[int, int]]:
    """Return one pair (boot, seq) for every row that a foreign program finds. Such a program reads
    only the compacted (sorted) files. `boot` is the start of the agent, `seq` the batch number.
    """
    paths = list((root / layout.TABLES[kind]).rglob("*.parquet"))
    found = [pq.read_table(path, columns=["boot", "seq"], partitioning=None) for path in paths]
    return sorted((row["boot"], row["seq"]) for table in found for row in table.to_pylist())


def test_compacted_rows_are_the_rows_of_the_inbox(tmp_path: Path) -> None:
    fill(tmp_path, SEGMENTS, ROWS)
    by: list[tuple[str, Literal["ascending", "descending"]]] = [
        ("boot", "ascending"),
        ("seq", "ascending"),
    ]
    before = {
        kind: pa.concat_tables(reading.read_tables(tmp_path, kind)).sort_by(by) for kind in Kind
    }
    done = compact(tmp_path)
    assert done == (2 * SEGMENTS * ROWS, 2 * SEGMENTS, 2 * 2 * 2)
    for kind in Kind:
        assert not segments.list_segments(tmp_path, kind)
        assert (
            pa.concat_tables(reading.read_tables(tmp_path, kind)).sort_by(by).equals(before[kind])
        )
    assert compact(tmp_path) == (0, 0, 0)


def test_files_lie_by_date_and_zone_and_are_sorted_by_cell_and_time(tmp_path: Path) -> None:
    fill(tmp_path, SEGMENTS, ROWS)
    compact(tmp_path)
    found = sorted((tmp_path / "observations").rglob("*.parquet"))
    folders = {path.parent.relative_to(tmp_path).as_posix() for path in found}
    zones = [
        f"q{grid.quadkey(int(grid.zone_of(cell)), 7)}"
        for cell in grid.cell_of(*np.array([[57.7, 48.1], [11.97, 11.6]]))
    ]
    assert folders == {
        f"observations/date={layout.date_of(20_000 + k)}/zone={zone}"
        for k in (0, 1)
        for zone in zones
    }
    for path in found:
        file = pq.ParquetFile(path)
        assert file.schema_arrow.equals(tables.OBSERVATION_ARCHIVE)
        assert (file.schema_arrow.field("speed").metadata or {})[b"unit"] == b"m/s"
        table = file.read()
        order = list(zip(table["cell"].to_pylist(), table["leave_time"].to_pylist(), strict=True))
        assert order == sorted(order)
        time = segments.to_nanoseconds(table["leave_time"])
        day, zone = (
            np.unique(values).tolist()
            for values in layout.partitions_of(time, table["cell"].to_numpy())
        )
        assert ([layout.partition_of(path).day], [layout.partition_of(path).zone]) == (day, zone)
        column = file.metadata.row_group(0).column(table.schema.names.index("cell"))
        assert (column.compression, column.has_column_index, column.is_stats_set) == (
            "ZSTD",
            True,
            True,
        )


def operations(monkeypatch: pytest.MonkeyPatch, die_at: int) -> list[str]:
    """Record all later disk operations of the service in a list, and return the list. Operation
    number `die_at` raises an exception instead, which simulates the death of the process.
    """
    seen: list[str] = []

    def count_calls(name: str, real: Callable[..., object]) -> Callable[..., object]:
        def call(*args: object, **kwargs: object) -> object:
            seen.append(name)
            if len(seen) == die_at:
                raise DiedError
            return real(*args, **kwargs)

        return call

    for name in ("rename", "unlink", "mkdir"):
        monkeypatch.setattr(Path, name, count_calls(name, getattr(Path, name)))
    # Only the process dies in this test, so the disk need not sync.
    monkeypatch.setattr(os, "fsync", count_calls("fsync", lambda _: None))
    monkeypatch.setattr(files, "write_table", count_calls("write", files.write_table))
    monkeypatch.setattr(compaction, "write_table", count_calls("write", files.write_table))
    return seen


@pytest.mark.campaign
def test_compaction_survives_death_before_any_change_of_the_disk(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    fill(tmp_path / "0", 2, 16)
    whole = {kind: identities(tmp_path / "0", kind) for kind in Kind}
    later = {kind: [(7, k) for k in range(1, 17)] for kind in Kind}
    monkeypatch.setattr(os, "fsync", lambda _: None)
    instant = 0
    died = True
    while died:
        instant += 1
        root = shutil.copytree(tmp_path / "0", tmp_path / str(instant))
        with pytest.MonkeyPatch.context() as patch:
            operations(patch, instant)
            try:
                compact(root, round_rows=16)
                died = False
            except DiedError:
                pass
        for kind in Kind:
            assert identities(root, kind) == whole[kind], instant
            assert len(set(public(root, kind))) == len(public(root, kind)), instant
        fill(root, 1, 16, seed=7)  # the service continues
        compact(root)
        for kind in Kind:
            assert public(root, kind) == whole[kind] + later[kind], instant
    assert instant > 40


def test_interrupted_compaction_counts_no_row_twice(tmp_path: Path) -> None:
    fill(tmp_path, 2, ROWS)
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(Path, "unlink", lambda *_: (_ for _ in ()).throw(DiedError))
        with pytest.raises(DiedError):
            compact(tmp_path)
    assert len(segments.list_segments(tmp_path, Kind.OBSERVATION)) == 2
    # These are rows of states. The observations are only removed from the inbox.
    assert compact(tmp_path).rows == 2 * ROWS
    assert len(public(tmp_path, Kind.OBSERVATION)) == 2 * ROWS


@pytest.mark.campaign
def test_readers_see_every_row_once_while_it_runs(tmp_path: Path) -> None:
    fill(tmp_path, 30, 5)
    whole = identities(tmp_path, Kind.OBSERVATION)
    over = threading.Event()
    wrong = []
    reads = 0

    def watch() -> None:
        nonlocal reads
        while not over.is_set():
            if identities(tmp_path, Kind.OBSERVATION) != whole:
                wrong.append(reads)
            seen = public(tmp_path, Kind.OBSERVATION)
            if len(seen) != len(set(seen)):
                wrong.append(reads)
            reads += 1

    watcher = threading.Thread(target=watch)
    watcher.start()
    compact(tmp_path, round_rows=5)
    over.set()
    watcher.join()
    assert not wrong
    assert reads
    assert public(tmp_path, Kind.OBSERVATION) == whole


def test_a_reader_that_is_overtaken_begins_again(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    fill(tmp_path, 3, ROWS)
    whole = identities(tmp_path, Kind.OBSERVATION)
    load = loading.load_rows
    loaded = []

    def overtaken(path: Path, *args: object, **named: object) -> pa.Table | None:
        loaded.append(path)
        if len(loaded) == 2:
            monkeypatch.setattr(reading, "load_rows", load)
            compact(tmp_path)
        return load(path, *args, **named)  # type: ignore[arg-type]

    monkeypatch.setattr(reading, "load_rows", overtaken)
    assert identities(tmp_path, Kind.OBSERVATION) == whole


def test_only_one_compacts_at_a_time(tmp_path: Path) -> None:
    (tmp_path / "inbox").mkdir()
    with (
        hold_compaction_lock(tmp_path),
        pytest.raises(InputError, match="^archive: .* is being compacted; "),
    ):
        compact(tmp_path)
    with pytest.raises(InputError, match="^archive: .* is not a folder; "):
        compact(tmp_path / "nowhere")


def test_full_disk_is_an_error_that_names_the_archive(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    fill(tmp_path, 1, ROWS)

    def fail(*_: object) -> int:
        raise OSError(errno.ENOSPC, "No space left on device")

    monkeypatch.setattr(compaction, "_place_files", fail)
    assert main(["compact", "--archive", str(tmp_path)]) == 2
    error = capsys.readouterr().err
    assert f"cannot use {tmp_path} (No space left on device); nothing is lost" in error


def test_a_damaged_segment_is_set_aside_and_the_rest_compacted(tmp_path: Path) -> None:
    fill(tmp_path, 3, ROWS)
    damaged = segments.list_segments(tmp_path, Kind.OBSERVATION)[1]
    damaged.write_bytes(damaged.read_bytes()[:-30])
    compact(tmp_path)
    assert [path.name for path in (tmp_path / "inbox").glob("*.bad")] == [damaged.name + ".bad"]
    assert {boot for boot, _ in public(tmp_path, Kind.OBSERVATION)} == {0, 2}


def test_segment_names_are_not_reused_even_if_the_clock_went_back(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    fill(tmp_path, 1, ROWS)
    compact(tmp_path)
    monkeypatch.setattr(time, "time", lambda: 1.0)
    Writer(tmp_path, "shard-0").write(Kind.OBSERVATION, rows_of(Kind.OBSERVATION, ROWS, 1))
    assert len(identities(tmp_path, Kind.OBSERVATION)) == 2 * ROWS
    compact(tmp_path)
    assert len(public(tmp_path, Kind.OBSERVATION)) == 2 * ROWS


def test_service_on_a_compacted_archive_has_the_same_map_and_batches(tmp_path: Path) -> None:
    messages = [make_message(f"sim-{k % 5:03}", 1 + k // 5) for k in range(20)]
    with closing(Engine(ServiceConfig(), tmp_path)) as engine:
        for k in range(0, 20, 4):
            engine.intake.ingest(messages[k : k + 4], time_ns())
            engine.settlement.flush()
            if k == 8:
                compact(tmp_path)  # compaction while the service runs
        at = int(engine.state.fusion.live.time.max())
        before = engine.state.fusion.beliefs(np.arange(engine.state.fusion.size), at)
    for _ in range(2):
        with closing(Engine(ServiceConfig(), tmp_path)) as again:
            np.testing.assert_allclose(
                again.state.fusion.beliefs(np.arange(again.state.fusion.size), at),
                before,
                atol=1e-6,
            )
            again.intake.ingest(messages, time_ns())
            assert again.counts.duplicates == 20
            assert read_settled(again.settlement.flush()).keys() == {
                f"sim-{k:03}" for k in range(5)
            }
        compact(tmp_path)
