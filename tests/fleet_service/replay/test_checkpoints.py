"""Tests of checkpoints (saved states of a service). A restart from a checkpoint must give the same
state as a restart from all archived rows. It must read only the rows written after the checkpoint.
"""

from __future__ import annotations

import shutil
import threading
import time
from collections.abc import Callable, Iterable
from contextlib import closing
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pytest
from numpy.typing import NDArray

from fleet_service.app.engine import Engine
from fleet_service.app.service import Service
from fleet_service.archive.format import reading
from fleet_service.archive.maintenance.compaction import compact
from fleet_service.archive.maintenance.retention import drop_checkpoints
from fleet_service.fusion.store.records import CELL
from fleet_service.ingest.inbox import Message
from fleet_service.replay import checkpoints, rebuild
from schemas import grid, wire
from schemas.config import ServiceConfig, ZenohSettings
from schemas.errors import InputError
from schemas.numeric import FloatArray
from schemas.wire import Batch, Kind
from tests.event_lines import logger_into
from tests.fleet_service.checkpoint_writer import save_checkpoint
from tests.fleet_service.examples import LATITUDE, LONGITUDE, SECOND, batch, key

DAY_S = 86_400.0


def icy(vehicle: int, seq: int, mu: float) -> Message:
    one = batch(f"sim-{vehicle:03}", seq, time.time_ns() - SECOND, [mu])
    return Message(
        Kind.OBSERVATION, key(one.vehicle), wire.encode(one), wire.ENCODING[Kind.OBSERVATION]
    )


def message(one: Batch) -> Message:
    return Message(one.kind, key(one.vehicle), wire.encode(one), wire.ENCODING[one.kind])


def keep(engine: Engine, root: Path) -> Path:
    """Write a checkpoint (saved state) as the service does, and return its folder. A background
    thread requests the checkpoint; the worker thread makes it between two segments (files of new
    rows).
    """
    save_checkpoint(engine)
    return checkpoints.list_checkpoints(root)[0]


def beliefs(engine: Engine, at: int) -> FloatArray:
    slots = np.arange(engine.state.fusion.size)
    return engine.state.fusion.beliefs(
        slots[np.lexsort((engine.state.fusion.sector[slots], engine.state.fusion.cell[slots]))], at
    )


@pytest.fixture
def replayed(monkeypatch: pytest.MonkeyPatch) -> list[int]:
    """Return a list. Each restart during the test appends the number of archived rows that it reads
    to restore the map.
    """
    rows: list[int] = []
    in_order: Callable[..., Iterable[pa.Table]] = rebuild.in_order

    def count_rows(listing: reading.Listing, most: int | None) -> list[pa.Table]:
        found = list(in_order(listing, most))
        rows.append(sum(table.num_rows for table in found))
        return found

    monkeypatch.setattr(rebuild, "in_order", count_rows)
    return rows


def test_a_restart_from_a_checkpoint_is_a_restart_from_the_log(
    tmp_path: Path, replayed: list[int]
) -> None:
    sent = [icy(k % 6, 1 + k // 6, 0.2 if k % 5 else 0.8) for k in range(60)]
    with closing(Engine(ServiceConfig(), tmp_path)) as engine:
        for k in range(0, 40, 4):
            engine.intake.ingest(sent[k : k + 4], time.time_ns())
            engine.settlement.flush()
        compact(tmp_path)
        path = keep(engine, tmp_path)
        engine.intake.ingest(sent[40:], time.time_ns())
        engine.settlement.flush()
        at = time.time_ns()
        alerts = engine.alerts.count
        running = beliefs(engine, at)
    replayed.clear()
    with closing(Engine(ServiceConfig(), tmp_path)) as again:
        from_checkpoint = beliefs(again, at)
        assert replayed == [20]
        assert again.alerts.count == alerts > 0
        assert again.counts.checkpoints_refused == 0
        again.intake.ingest(sent, time.time_ns())
        assert again.counts.duplicates == 60
    assert path.name
    drop_checkpoints(tmp_path)
    with closing(Engine(ServiceConfig(), tmp_path)) as whole:
        np.testing.assert_allclose(from_checkpoint, beliefs(whole, at), atol=1e-6)
    np.testing.assert_allclose(from_checkpoint, running, atol=1e-6)
    assert replayed == [20, 60]


def read_state(engine: Engine) -> dict[str, NDArray[Any]]:
    """Return the state of an engine as arrays by name. They are the beliefs and columns from which
    a map is made (sorted by cell and heading sector), the latest epoch (minute), and the time of
    the newest row.
    """
    fusion = engine.state.fusion
    rows = engine.state.fusion.store.state.live
    order = np.lexsort((fusion.sector, fusion.cell))
    columns = {
        name: rows.cells[name][order]
        for name in CELL.names or ()
        if name not in ("window", "reporters")
    }
    times = {"epoch": np.array([fusion.epoch]), "newest": np.array([engine.state.streams.newest])}
    return {"belief": rows.belief[order], **columns, **times}


@pytest.mark.parametrize("oldest_s", [30 * DAY_S, DAY_S])
def test_a_batch_too_old_to_be_repeated_is_not_fused_by_a_restart(
    tmp_path: Path, oldest_s: float
) -> None:
    """A batch may be so old that no vehicle sends it again. After a restart, such a batch must not
    affect the map a second time. In the test, compaction (sorting of rows) has joined old and new
    rows in one file.
    """
    config = ServiceConfig(oldest_s=oldest_s)
    now = time.time_ns()
    old = now - int(30.5 * DAY_S * SECOND)
    with closing(Engine(config, tmp_path)) as engine:
        for vehicle, at in (("sim-001", old), ("sim-002", now)):
            one = batch(vehicle, 1, at, [0.8])
            sent = Message(
                Kind.OBSERVATION, key(vehicle), wire.encode(one), wire.ENCODING[Kind.OBSERVATION]
            )
            engine.intake.ingest([sent], at + SECOND)
            engine.settlement.flush()
        keep(engine, tmp_path)
        engine.intake.ingest([icy(3, 1, 0.8)], now + SECOND)
        engine.settlement.flush()
        compact(tmp_path)
        assert engine.state.fusion.live.visits[: engine.state.fusion.size].tolist() == [3]
    with closing(Engine(config, tmp_path)) as again:
        assert again.state.fusion.live.visits[: again.state.fusion.size].tolist() == [3]


def test_state_is_equal_live_from_a_checkpoint_and_from_the_log(tmp_path: Path) -> None:
    """The states restored with and without a checkpoint (saved state) must both equal the state of
    the running service. Without a checkpoint, all archived rows are replayed. Some reports before
    the checkpoint are late and out of order.
    """
    rng = np.random.default_rng(3)
    now = time.time_ns()
    sent = []
    for k in range(120):
        leave = np.sort(now + k * SECOND - rng.integers(0, 700, 5) * SECOND // 100)
        mu = rng.uniform(0.2, 0.9, 5)
        latitude = LATITUDE + 2e-4 * rng.integers(0, 6, 5)
        one = batch(
            f"sim-{k % 6:03}",
            1 + k // 6,
            now,
            mu.tolist(),
            leave_time=leave,
            enter_time=leave - SECOND // 2,
            latitude=latitude,
            cell=grid.cell_of(latitude, np.full(5, LONGITUDE)),
        )
        sent.append((k + rng.choice([0, 0, 0, 5, 40, 200]), one))
    sent.sort(key=lambda pair: pair[0])
    with closing(Engine(ServiceConfig(), tmp_path)) as engine:
        for k in range(0, 120, 8):
            engine.intake.ingest(
                [message(one) for _, one in sent[k : k + 8]], now + (k + 9) * SECOND
            )
            engine.settlement.flush()
            if k == 56:
                compact(tmp_path)
                keep(engine, tmp_path)
        keep(engine, tmp_path)  # no message follows this checkpoint
        live = read_state(engine)
        assert engine.state.fusion.waiting
    # Start from the last checkpoint, from the one before, and from the log alone.
    for kept in (2, 1, 0):
        assert len(checkpoints.list_checkpoints(tmp_path)) == kept
        with closing(Engine(ServiceConfig(), tmp_path)) as again:
            found = read_state(again)
            assert (again.seen, again.counts.checkpoints_refused) == (
                again.state.streams.newest,
                0,
            )
        assert [name for name in live if not np.array_equal(found[name], live[name])] == []
        if kept:
            shutil.rmtree(checkpoints.list_checkpoints(tmp_path)[0])


def test_rows_in_a_checkpoint_are_on_disk(tmp_path: Path) -> None:
    with closing(Engine(ServiceConfig(), tmp_path)) as engine:
        engine.intake.ingest([icy(k, 1, 0.5) for k in range(4)], time.time_ns())
        keep(engine, tmp_path)
        # The service dies before it writes these messages to a segment.
        engine.intake.ingest([icy(k, 2, 0.5) for k in range(4)], time.time_ns())
    with closing(Engine(ServiceConfig(), tmp_path)) as again:
        assert again.state.fusion.live.visits[0] == 4
        again.intake.ingest([icy(k, seq, 0.5) for k in range(4) for seq in (1, 2)], time.time_ns())
        assert (again.counts.duplicates, again.state.fusion.live.visits[0]) == (4, 8)


@pytest.mark.parametrize("harm", ["truncate", "remove", "flip"])
def test_damaged_checkpoint_is_replaced_by_the_earlier_one_and_the_log(
    tmp_path: Path, harm: str
) -> None:
    with closing(Engine(ServiceConfig(), tmp_path)) as engine:
        for seq in (1, 2, 3):
            engine.intake.ingest([icy(k, seq, 0.3) for k in range(4)], time.time_ns())
            keep(engine, tmp_path)
        at = time.time_ns()
        running = beliefs(engine, at)
    assert len(checkpoints.list_checkpoints(tmp_path)) == checkpoints.KEPT
    for refused, path in enumerate(checkpoints.list_checkpoints(tmp_path), 1):
        file = path / "cells.arrow"
        if harm == "truncate":
            file.write_bytes(file.read_bytes()[:100])
        elif harm == "flip":  # a changed number that compiled code would use as an index
            data = bytearray(file.read_bytes())
            data[len(data) // 2] ^= 0x40
            file.write_bytes(data)
        else:
            file.unlink()
        with closing(Engine(ServiceConfig(), tmp_path)) as again:
            assert again.counts.checkpoints_refused == refused
            np.testing.assert_allclose(beliefs(again, at), running, atol=1e-6)


def test_a_checkpoint_half_written_is_none(tmp_path: Path) -> None:
    (tmp_path / "checkpoints" / ".draft").mkdir(parents=True)
    assert checkpoints.list_checkpoints(tmp_path) == []
    with closing(Engine(ServiceConfig(), tmp_path)) as engine:
        assert not engine.save_checkpoint(_set())  # the service stops meanwhile
        assert keep(engine, tmp_path).exists()


def _set() -> threading.Event:
    event = threading.Event()
    event.set()
    return event


def test_rows_after_the_checkpoint_are_replayed_whatever_the_clock(tmp_path: Path) -> None:
    """A restart must replay all rows written after the checkpoint (the service's saved state). This
    must hold although the clock was an hour ahead when the checkpoint was written, and was
    corrected later.
    """
    ahead = time.time_ns() + 3600 * SECOND
    with closing(Engine(ServiceConfig(), tmp_path)) as engine:
        engine.intake.ingest([icy(9, 1, 0.15)], ahead)
        keep(engine, tmp_path)
    with closing(Engine(ServiceConfig(), tmp_path)) as engine:
        for seq in range(1, 9):
            engine.intake.ingest([icy(k, seq, 0.15) for k in range(6)], time.time_ns())
            engine.settlement.flush()
        keep_alerts = engine.alerts.count
        at = time.time_ns()
        running = beliefs(engine, at)
        visits = engine.state.fusion.live.visits[: engine.state.fusion.size].sum()
        compact(tmp_path)
    assert keep_alerts > 0
    with closing(Engine(ServiceConfig(), tmp_path)) as again:
        assert again.counts.checkpoints_refused == 0
        assert again.alerts.count == keep_alerts
        assert again.state.fusion.live.visits[: again.state.fusion.size].sum() == visits
        np.testing.assert_allclose(beliefs(again, at), running, atol=1e-6)


def test_compacted_file_across_the_checkpoint_is_not_replayed_twice(tmp_path: Path) -> None:
    with closing(Engine(ServiceConfig(), tmp_path)) as engine:
        engine.intake.ingest([icy(k, 1, 0.5) for k in range(4)], time.time_ns())
        keep(engine, tmp_path)
        engine.intake.ingest([icy(k, 2, 0.5) for k in range(4)], time.time_ns())
        engine.settlement.flush()
    compact(tmp_path)  # joins both segments in one file
    with closing(Engine(ServiceConfig(), tmp_path)) as again:
        assert again.state.fusion.live.visits[0] == 8
        again.intake.ingest([icy(k, seq, 0.5) for k in range(4) for seq in (1, 2)], time.time_ns())
        assert again.counts.duplicates == 8


def test_checkpoint_that_crashes_the_service_is_abandoned(tmp_path: Path) -> None:
    with closing(Engine(ServiceConfig(), tmp_path)) as engine:
        engine.intake.ingest([icy(k, 1, 0.5) for k in range(4)], time.time_ns())
        path = keep(engine, tmp_path)
    for _ in range(checkpoints.TRIES):
        checkpoints.load_checkpoint(path)
        checkpoints.mark_begun(path)
    with pytest.raises(InputError, match="made the service fail"):
        checkpoints.load_checkpoint(path)
    checkpoints.mark_survived(tmp_path)
    checkpoints.load_checkpoint(path)


def test_checkpoint_is_abandoned_if_errors_end_the_service(
    router: ZenohSettings, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    with closing(Engine(ServiceConfig(), tmp_path)) as engine:
        engine.intake.ingest([icy(k, 1, 0.5) for k in range(4)], time.time_ns())
        path = keep(engine, tmp_path)

    def fail(*_: object) -> None:
        raise IndexError("row 7")

    monkeypatch.setattr(Service, "_step", fail)
    for _ in range(checkpoints.TRIES):
        service = Service(ServiceConfig(zenoh=router), tmp_path, logger_into([]))
        with pytest.raises(IndexError):
            service.run(threading.Event())
    with pytest.raises(InputError, match="made the service fail"):
        checkpoints.load_checkpoint(path)
