"""Tests of the archive: a row is synced to disk before it is acknowledged, disk errors lose no row,
a second service is locked out, and vehicles have pseudonyms.
"""

from __future__ import annotations

import os
import shutil
import time
from collections.abc import Iterator
from contextlib import closing
from pathlib import Path

import duckdb
import numpy as np
import pandas as pd
import pyarrow.parquet as pq
import pytest

from fleet_service.app.engine import Engine
from fleet_service.archive.format import reading, segments
from fleet_service.archive.format.files import lock_archive
from fleet_service.archive.identity.pseudonyms import Pseudonyms, pseudonym_number, pseudonym_texts
from fleet_service.ingest.inbox import Message
from schemas import tables, wire
from schemas.config import ServiceConfig
from schemas.errors import InputError
from schemas.wire import Kind
from tests.fleet_service.examples import SECOND, batch, key

MONTH = 31 * 86_400 * SECOND


def make_message(vehicle: str, seq: int, with_likelihood: bool = True) -> Message:
    one = batch(vehicle, seq, time.time_ns() - SECOND, [0.8, 0.7], with_likelihood=with_likelihood)
    return Message(
        Kind.OBSERVATION, key(vehicle), wire.encode(one), wire.ENCODING[Kind.OBSERVATION]
    )


def read_settled(acks: list[tuple[str, bytes]]) -> dict[str, list[tuple[int, int]]]:
    return {
        vehicle: [r for s in wire.decode_ack(ack)[1] for r in s.durable] for vehicle, ack in acks
    }


@pytest.fixture
def engine(tmp_path: Path) -> Iterator[Engine]:
    """Yield an engine (service without network) on an empty archive."""
    with closing(Engine(ServiceConfig(), tmp_path)) as engine:
        yield engine


def test_an_acknowledgement_follows_fsync_rename_and_fsync_of_the_folder(
    engine: Engine, monkeypatch: pytest.MonkeyPatch
) -> None:
    order: list[str] = []
    fsync = os.fsync
    rename = Path.rename

    def seen_fsync(handle: int) -> None:
        order.append("folder" if Path(f"/proc/self/fd/{handle}").is_dir() else "file")
        fsync(handle)

    def seen_rename(path: Path, target: Path) -> Path:
        order.append("rename")
        return rename(path, target)

    monkeypatch.setattr(os, "fsync", seen_fsync)
    monkeypatch.setattr(Path, "rename", seen_rename)
    for seq in (1, 2):
        engine.intake.ingest([make_message("sim-001", seq)], time.time_ns())
        order.clear()
        acks = engine.settlement.flush()
        order.append("ack")
        # Operations that store the number of a new vehicle; a known vehicle needs none.
        who = ["file", "folder"] if seq == 1 else []
        assert order == [*who, "file", "rename", "folder", "ack"]
        assert read_settled(acks) == {"sim-001": [(seq, seq)]}


def test_rows_are_acknowledged_only_after_a_failing_disk_recovers(
    engine: Engine, tmp_path: Path
) -> None:
    shutil.move(tmp_path / "inbox", tmp_path / "gone")
    engine.intake.ingest([make_message("sim-001", 1)], time.time_ns())
    assert engine.settlement.flush() == []
    engine.intake.ingest([make_message("sim-001", 2), make_message("sim-001", 1)], time.time_ns())
    assert engine.settlement.flush() == []
    assert engine.counts.failures["segment"] == 2
    shutil.move(tmp_path / "gone", tmp_path / "inbox")
    assert read_settled(engine.settlement.flush()) == {"sim-001": [(1, 2)]}
    assert (
        sum(
            pq.read_table(path).num_rows
            for path in segments.list_segments(tmp_path, Kind.OBSERVATION)
        )
        == 4
    )


def test_a_second_service_on_an_archive_refuses_to_start(engine: Engine, tmp_path: Path) -> None:
    with pytest.raises(InputError, match="^archive: .* belongs to a running service; "):
        lock_archive(tmp_path)
    engine.close()
    lock_archive(tmp_path).close()


def test_a_damaged_segment_is_set_aside_and_the_others_are_read(
    engine: Engine, tmp_path: Path
) -> None:
    for seq in (1, 2, 3):
        engine.intake.ingest([make_message("sim-001", seq)], time.time_ns())
        engine.settlement.flush()
    engine.close()
    damaged = segments.list_segments(tmp_path, Kind.OBSERVATION)[1]
    damaged.write_bytes(damaged.read_bytes()[:-20])
    with closing(Engine(ServiceConfig(), tmp_path)) as again:
        assert again.state.fusion.live.visits[0] == 4
        assert damaged.with_name(damaged.name + ".bad").exists()
        again.intake.ingest([make_message("sim-001", seq) for seq in (1, 2, 3)], time.time_ns())
        assert again.counts.observations == 2
        assert again.counts.duplicates == 2


@pytest.mark.parametrize("place", np.linspace(0.002, 0.998, 40).round(3))
def test_a_changed_byte_is_noticed_wherever_it_is(
    engine: Engine, tmp_path: Path, caplog: pytest.LogCaptureFixture, place: float
) -> None:
    engine.intake.ingest([make_message("sim-001", 1)], time.time_ns())
    engine.settlement.flush()
    engine.close()
    (segment,) = segments.list_segments(tmp_path, Kind.OBSERVATION)
    content = bytearray(segment.read_bytes())
    content[int(place * len(content))] ^= 0x55
    before = next(reading.read_tables(tmp_path, Kind.OBSERVATION)).to_pylist()
    segment.write_bytes(content)
    with closing(Engine(ServiceConfig(), tmp_path)) as again:
        held = [
            row
            for table in reading.read_tables(tmp_path, Kind.OBSERVATION)
            for row in table.to_pylist()
        ]
        assert repr(held) == repr(before) or not held
        assert again.counts.files_set_aside == (not held)
        assert ("is damaged and was set aside" in caplog.text) == (not held)
        again.intake.ingest([make_message("sim-001", 1)], time.time_ns())
        assert again.counts.duplicates == bool(held)


def test_unsynced_names_are_synced_before_any_acknowledgement(
    engine: Engine, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def broken(folder: Path) -> None:
        raise OSError(5, "a disk that does not answer")

    with monkeypatch.context() as patch:
        patch.setattr(segments, "sync_directory", broken)
        engine.intake.ingest([make_message("sim-001", 1)], time.time_ns())
        assert engine.settlement.flush() == []
        assert engine.counts.failures["segment"] == 1
    engine.intake.ingest([make_message("sim-001", 2)], time.time_ns())
    assert read_settled(engine.settlement.flush()) == {"sim-001": [(1, 2)]}
    assert sum(table.num_rows for table in reading.read_tables(tmp_path, Kind.OBSERVATION)) == 4


def test_half_written_segment_is_removed_at_the_next_start(engine: Engine, tmp_path: Path) -> None:
    engine.close()
    draft = tmp_path / "inbox" / "shard-0-0000000001-00000001.parquet.tmp"
    draft.write_bytes(b"PAR1 half")
    Engine(ServiceConfig(), tmp_path).close()
    assert not draft.exists()


def test_no_segment_name_is_used_twice(tmp_path: Path) -> None:
    for seq in range(1, 4):
        engine = Engine(ServiceConfig(), tmp_path)
        engine.intake.ingest([make_message("sim-001", seq)], time.time_ns())
        engine.settlement.flush()
        engine.close()
    assert len(segments.list_segments(tmp_path, Kind.OBSERVATION)) == 3


def test_rows_read_back_are_the_rows_written(engine: Engine, tmp_path: Path) -> None:
    engine.intake.ingest(
        [make_message("sim-001", 1), make_message("sim-002", 1, with_likelihood=False)],
        time.time_ns(),
    )
    engine.settlement.flush()
    (table,) = reading.read_tables(tmp_path, Kind.OBSERVATION)
    rows = segments.rows_of(table)
    assert rows["with_likelihood"].tolist() == [True, True, False, False]
    assert not rows["log_likelihood"][2:].any()
    again = segments.rows_of(segments.table_of(Kind.OBSERVATION, rows))
    assert again.keys() == rows.keys()
    for name, column in rows.items():
        np.testing.assert_array_equal(again[name], column)


def test_other_tools_read_the_segments(engine: Engine, tmp_path: Path) -> None:
    engine.intake.ingest(
        [make_message("sim-001", 1), make_message("sim-002", 1, with_likelihood=False)],
        time.time_ns(),
    )
    engine.settlement.flush()
    pattern = str(tmp_path / "inbox" / "*.parquet")
    with duckdb.connect() as db:
        query = (
            "select count(*), count(distinct vehicle), count(log_likelihood), min(mu) from "
            "read_parquet(?)"
        )
        assert db.execute(query, [pattern]).fetchone() == (4, 2, 2, pytest.approx(0.7, abs=1e-3))
    (path,) = segments.list_segments(tmp_path, Kind.OBSERVATION)
    assert list(pd.read_parquet(path).columns) == tables.OBSERVATION_ARCHIVE.names


def test_a_pseudonym_is_its_number_and_its_number_is_the_pseudonym(tmp_path: Path) -> None:
    names = [Pseudonyms(tmp_path).of(f"sim-{k:03}", 0) for k in range(50)]
    numbers = np.array([pseudonym_number(name) for name in names])
    assert (numbers < 0).any(), "numbers of either sign are shown"
    assert pseudonym_texts(numbers).astype(str).tolist() == names


def test_pseudonym_holds_for_its_month_across_restarts_not_beyond(tmp_path: Path) -> None:
    now = time.time_ns()
    first = Pseudonyms(tmp_path)
    again = Pseudonyms(tmp_path)
    name = first.of("sim-001", now)
    assert again.of("sim-001", now) == name
    assert first.of("sim-002", now) != name
    assert first.of("sim-001", now - 2 * MONTH) != name
    assert -(2**63) <= pseudonym_number(name) < 2**63


def test_keys_are_for_the_service_alone_and_a_destroyed_one_forgets(tmp_path: Path) -> None:
    now = time.time_ns()
    name = Pseudonyms(tmp_path).of("sim-001", now)
    (path,) = tmp_path.glob("*.key")
    assert path.stat().st_mode & 0o777 == 0o600
    path.unlink()
    assert Pseudonyms(tmp_path).of("sim-001", now) != name


def test_late_observation_is_archived_and_fused_for_its_own_time(
    engine: Engine, tmp_path: Path
) -> None:
    now = time.time_ns()
    old = batch("sim-002", 1, now - 1000 * SECOND, [0.3])
    engine.intake.ingest([make_message("sim-001", 1)], now)
    engine.intake.ingest([Message(Kind.OBSERVATION, key("sim-002"), wire.encode(old), "")], now)
    assert read_settled(engine.settlement.flush()) == {"sim-001": [(1, 1)], "sim-002": [(1, 1)]}
    assert engine.counts.late == 1
    (table,) = reading.read_tables(tmp_path, Kind.OBSERVATION)
    assert sorted(zip(table["late"].to_pylist(), table["weight"].to_pylist(), strict=True)) == [
        (False, 0.75),
        (False, 0.75),
        (True, 0.75),
    ]
    engine.close()
    with closing(Engine(ServiceConfig(), tmp_path)) as again:
        np.testing.assert_array_equal(
            again.state.fusion.live.visits[: again.state.fusion.size], [3]
        )
