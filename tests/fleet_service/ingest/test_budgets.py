"""Tests of limits for one car with a valid certificate. Whatever the car sends, it must count as
one vehicle and must not fill the service's memory or disk.
"""

from __future__ import annotations

import os
import time
from collections.abc import Iterator
from contextlib import closing
from dataclasses import replace
from datetime import UTC, datetime, timedelta
from pathlib import Path

import numpy as np
import pyarrow as pa
import pytest

from fleet_service.app.engine import Engine
from fleet_service.archive.format import reading
from fleet_service.archive.identity.pseudonyms import Pseudonyms, pseudonym_number
from fleet_service.archive.identity.vehicle_ids import VehicleIds, read_numbers
from fleet_service.archive.maintenance.retention import drop_checkpoints, forget_period
from fleet_service.ingest import dedup
from fleet_service.ingest.budgets import STREAMS_AT_ONCE, NewCells, TokenBuckets
from fleet_service.ingest.inbox import Message
from schemas import grid, keys, wire
from schemas.config import ServiceConfig
from schemas.wire import Batch, Kind
from tests.fleet_service.checkpoint_writer import save_checkpoint
from tests.fleet_service.examples import SECOND, batch


def message(sent: Batch) -> Message:
    return Message(
        sent.kind,
        keys.observation_key(sent.region, sent.vehicle),
        wire.encode(sent),
        wire.ENCODING[sent.kind],
    )


@pytest.fixture
def engine(tmp_path: Path) -> Iterator[Engine]:
    with closing(Engine(ServiceConfig(), tmp_path)) as engine:
        yield engine


def months(now: int) -> tuple[int, int]:
    """Return two times [ns]: one second before the beginning of the month of `now`, and two seconds
    after this beginning.
    """
    first = datetime.fromtimestamp(now / SECOND, UTC).replace(
        day=1, hour=0, minute=0, second=0, microsecond=0
    )
    at = int(first.timestamp()) * SECOND
    return at - SECOND, at + 2 * SECOND


def test_one_car_is_one_witness_over_midnight_live_and_after_replay(tmp_path: Path) -> None:
    before, after = months(time.time_ns())
    with closing(Engine(ServiceConfig(), tmp_path)) as engine:
        for seq, at in enumerate((before, after), 1):
            engine.intake.ingest([message(batch("car-001", seq, at, [0.15]))], after)
        engine.settlement.flush()
        assert engine.alerts.count == 0
        assert engine.state.fusion.live.vehicles[0] == 1
    assert len(set(read_numbers(tmp_path / "keys"))) == 2, "two pseudonyms on disk"
    drop_checkpoints(tmp_path)
    with closing(Engine(ServiceConfig(), tmp_path)) as again:
        assert again.state.fusion.live.vehicles[0] == 1
        assert again.alerts.count == 0


def test_a_start_over_midnight_of_a_month_links_no_pseudonyms(tmp_path: Path) -> None:
    before, after = months(time.time_ns())
    sent = [batch("car-001", seq, at, [0.8]) for seq, at in enumerate((before, after), 1)]
    for again in (False, True):
        with closing(Engine(ServiceConfig(), tmp_path)) as engine:
            engine.intake.ingest([message(one) for one in sent], after)
            assert engine.counts.duplicates == (2 if again else 0), "a restart knows both"
            ((vehicle, ack),) = engine.settlement.flush()
            streams = wire.decode_ack(ack)[1]
            assert {stream.boot for stream in streams} == {sent[0].boot}, (
                "its sender hears its own name for it"
            )
            assert sorted(seq for stream in streams for run in stream.durable for seq in run) == [
                1,
                2,
            ]
    table = pa.concat_tables(reading.read_tables(tmp_path, Kind.OBSERVATION, ["vehicle", "boot"]))
    assert (vehicle, table.num_rows) == ("car-001", 2)
    assert len(set(table["vehicle"].to_pylist())) == len(set(table["boot"].to_pylist())) == 2
    assert sent[0].boot not in table["boot"].to_pylist()
    assert table["boot"].to_numpy().min() >= 0


@pytest.mark.parametrize("with_checkpoint", [False, True])
def test_sender_without_first_held_continues_in_a_new_month(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, with_checkpoint: bool
) -> None:
    monkeypatch.setattr(dedup, "MAX_GAPS", 3)
    before, after = months(time.time_ns())
    times = [before] * 5 + [after] * 10
    sent = [message(batch("car-001", seq, at, [0.8])) for seq, at in enumerate(times, 1)]
    with closing(Engine(ServiceConfig(), tmp_path)) as engine:
        engine.intake.ingest(sent, after)
        engine.settlement.flush()
        assert (engine.counts.observations, engine.counts.too_many_gaps) == (15, 0)
        if with_checkpoint:
            save_checkpoint(engine)
    with closing(Engine(ServiceConfig(), tmp_path)) as again:
        again.intake.ingest(sent, after)
        assert (again.counts.observations, again.counts.duplicates) == (0, 15)


def test_batches_with_unhashed_starts_are_recognised_again(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    now = time.time_ns()
    sent = [message(batch("car-001", seq, now, [0.8])) for seq in (1, 2, 3)]
    with monkeypatch.context() as before:
        before.setattr(Pseudonyms, "boot", lambda self, vehicle, boot, time: boot)
        with closing(Engine(ServiceConfig(), tmp_path)) as engine:
            engine.intake.ingest(sent[:2], now)
            engine.settlement.flush()
    with closing(Engine(ServiceConfig(), tmp_path)) as engine:
        engine.intake.ingest(sent, now)
        assert (engine.counts.duplicates, engine.counts.observations) == (2, 1)


def test_a_car_with_one_foot_in_last_month_raises_no_alert_alone(engine: Engine) -> None:
    """A vehicle has another pseudonym in each month, and the first record of a batch decides the
    month. Batches that begin in the last month would therefore count as those of a second vehicle.
    One car must not raise an alert alone by sending such batches.
    """
    now = time.time_ns()
    for seq in range(1, 40):
        old = now - 29 * 86_400 * SECOND
        leave = [old, now - SECOND] if seq % 2 else [now - 2 * SECOND, now - SECOND]
        one = batch(
            "car-001", seq, now, [0.15, 0.15], leave_time=leave, enter_time=np.array(leave) - SECOND
        )
        engine.intake.ingest([message(one)], now)
    assert engine.alerts.count == 0
    assert engine.counts.refused["time"] == 20, "a batch spans no month"
    assert engine.state.fusion.live.vehicles[: engine.state.fusion.size].max() == 1


def test_pseudonyms_of_past_months_are_not_remembered(tmp_path: Path) -> None:
    pseudonyms = Pseudonyms(tmp_path)
    now = time.time_ns()
    first = pseudonyms.of("car-001", now)
    for number in range(1, 6):
        assert pseudonyms.of("car-001", now + number * 31 * 86_400 * SECOND) != first
    assert len(pseudonyms._known) == 2
    assert pseudonyms.of("car-001", now) == first


def test_a_line_of_the_witnesses_that_is_damaged_is_left_out(tmp_path: Path) -> None:
    pseudonyms = Pseudonyms(tmp_path)
    witnesses = VehicleIds(tmp_path)
    now = time.time_ns()
    names = {f"car-{k:03}": pseudonym_number(pseudonyms.of(f"car-{k:03}", now)) for k in range(3)}
    known = {p: witnesses.id_of(name, pseudonyms.month(now), p) for name, p in names.items()}
    assert read_numbers(tmp_path) == known
    path = next(tmp_path.glob("*.witnesses"))
    data = bytearray(path.read_bytes())
    data[30] ^= 1
    path.write_bytes(data)
    assert len(read_numbers(tmp_path)) == 2
    assert (
        VehicleIds(tmp_path).id_of("car-000", pseudonyms.month(now), names["car-000"])
        == known[names["car-000"]]
    )
    assert path.stat().st_mode & 0o077 == 0


def test_service_counts_removes_and_rewrites_damaged_lines(tmp_path: Path) -> None:
    now = time.time_ns()
    with closing(Engine(ServiceConfig(), tmp_path)) as engine:
        for k in range(3):
            engine.intake.ingest([message(batch(f"car-{k:03}", 1, now, [0.8, 0.8]))], now)
        engine.settlement.flush()
        assert engine.counts.witnesses_damaged == 0
    path = next(tmp_path.glob("keys/*.witnesses"))
    whole = read_numbers(path.parent)
    data = bytearray(path.read_bytes())
    data[30] ^= 1
    path.write_bytes(data + b"half a li")  # an append that a full disk cut off
    with closing(Engine(ServiceConfig(), tmp_path)) as engine:
        assert engine.counts.witnesses_damaged == 2
        assert len(read_numbers(path.parent)) == 2
        engine.intake.ingest([message(batch("car-001", 2, now, [0.8, 0.8]))], now)
        assert read_numbers(path.parent) == whole
    with closing(Engine(ServiceConfig(), tmp_path)) as engine:
        assert engine.counts.witnesses_damaged == 0


def test_vehicle_numbers_are_durable_before_the_acknowledgement(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    now = time.time_ns()
    synced = []
    fsync = os.fsync

    def record_sync(handle: int) -> None:
        synced.append(Path(f"/proc/self/fd/{handle}").readlink().suffix)
        fsync(handle)

    monkeypatch.setattr("os.fsync", record_sync)
    with closing(Engine(ServiceConfig(), tmp_path)) as engine:
        engine.intake.ingest([message(batch("car-000", 1, now, [0.8, 0.8]))], now)
        assert ".witnesses" not in synced
        assert engine.settlement.flush()
        assert ".witnesses" in synced


def everywhere(seq: int, count: int, now: int) -> Batch:
    """Return a batch in which a car reports `count` new adjacent cells, one after the other, at a
    speed of 12 m/s.
    """
    at = np.arange(count) + seq * count
    latitude = 57.60 + 2e-4 * (at // 400)
    longitude = 11.75 + 2e-4 * (at % 400)
    leave = now - np.arange(count)[::-1] * SECOND
    cell = grid.cell_of(latitude, longitude)
    one = batch(
        "car-001",
        seq + 1,
        now,
        [0.5] * count,
        leave_time=leave,
        enter_time=leave,
        latitude=latitude,
        longitude=longitude,
        cell=cell,
    )
    return replace(one, region=int(grid.region_of(cell[0])))


def test_new_cells_per_car_are_limited_and_all_rows_archived(engine: Engine) -> None:
    now = time.time_ns()
    sent = 0
    at_once = 3_000
    engine.intake._places = NewCells(at_once)
    for seq in range(200):
        at = now - (200 - seq) * 200 * SECOND
        one = everywhere(seq, 50, at)
        if len(np.unique(grid.region_of(one.columns["cell"]))) == 1:
            engine.intake.ingest([message(one)], now)
            sent += 50
    assert sent > 2 * at_once
    assert engine.counts.observations == sent, "nothing is refused"
    assert engine.counts.implausible_moves == 0
    assert engine.counts.too_many_places > sent - 2 * at_once
    assert engine.state.fusion.size < 3 * at_once


def test_a_car_opens_so_many_streams_and_keeps_the_rest(engine: Engine) -> None:
    now = time.time_ns()
    for boot in range(1, 1000):
        one = replace(batch("car-001", 1, now, [0.8]), boot=boot)
        engine.intake.ingest([message(one)], now)
    assert engine.counts.observations == STREAMS_AT_ONCE
    assert engine.counts.too_many_streams == 999 - STREAMS_AT_ONCE


def test_a_publisher_reports_from_all_regions_of_a_country(tmp_path: Path) -> None:
    now = time.time_ns()
    with closing(Engine(ServiceConfig(publishers=["cits-se"]), tmp_path)) as engine:
        for k in range(200):
            latitude = 56.0 + 0.5 * (k // 20)
            longitude = 12.0 + 0.5 * (k % 20)
            cell = int(grid.cell_of(latitude, longitude))
            one = batch(
                "cits-se", 1, now, [0.3], latitude=[latitude], longitude=[longitude], cell=[cell]
            )
            engine.intake.ingest([message(replace(one, region=int(grid.region_of(cell))))], now)
        assert engine.counts.too_many_streams == 0
        assert engine.counts.observations == 200


def test_new_cells_are_counted_once_and_by_vehicle() -> None:
    budgets = NewCells(3)
    vehicle = np.array([2, 1, 1, 2, 1, 1, 1])
    cell = np.array([5, 1, 2, 5, 1, 3, 4])
    assert budgets.find_excess(vehicle, cell, 0.0).tolist() == [
        False,
        False,
        False,
        False,
        False,
        False,
        True,
    ]
    assert budgets.find_excess(np.array([1, 2, 2, 2]), np.array([9, 6, 7, 8]), 0.0).tolist() == [
        True,
        False,
        False,
        True,
    ]
    assert not len(budgets.find_excess(vehicle[:0], cell[:0], 0.0))


def test_a_budget_fills_again() -> None:
    bucket = TokenBuckets(10, 3600)
    assert [
        bucket.take(1, 6, 0.0),
        bucket.take(1, 6, 0.0),
        bucket.take(1, 6, 3.0),
        bucket.take(2, 6, 3.0),
    ] == [
        6,
        4,
        3,
        6,
    ]


def test_forgotten_month_leaves_no_vehicle_name(tmp_path: Path) -> None:
    now = time.time_ns()
    with closing(Engine(ServiceConfig(), tmp_path)) as engine:
        engine.intake.ingest([message(batch("car-001", 1, now, [0.8]))], now)
        engine.settlement.flush()
    month = f"{datetime.fromtimestamp(now / SECOND, UTC) - timedelta(seconds=1):%Y-%m}"
    forget_period(tmp_path, month)
    assert not read_numbers(tmp_path / "keys")
