"""Tests of the times at which a service writes segments (files of new rows). A row must wait at
most the configured period. On a slow disk the service must pause between writes.
"""

from __future__ import annotations

import math
import threading
from contextlib import closing
from pathlib import Path

import pytest

from fleet_service.app import settlement
from fleet_service.app.engine import Engine
from fleet_service.ingest.inbox import Message
from schemas import keys, wire
from schemas.config import ServiceConfig
from tests.fleet_service.examples import SECOND, batch

NOW = 1_750_000_000 * SECOND


def ingest_one(engine: Engine, seq: int) -> None:
    sent = batch("car-001", seq, NOW, [0.8])
    key = keys.observation_key(sent.region, sent.vehicle)
    message = Message(sent.kind, key, wire.encode(sent), wire.ENCODING[sent.kind])
    engine.intake.ingest([message], NOW)


def test_rows_that_wait_are_written_before_the_period_ends(tmp_path: Path) -> None:
    with closing(Engine(ServiceConfig(), tmp_path)) as engine:
        assert engine.settlement.until_early_s(0.0) == math.inf, "nothing waits"
        ingest_one(engine, 1)
        assert engine.settlement.until_early_s(0.0) == 0.0, "there was no segment yet"
        assert engine.settlement.flush(), "the batch is acknowledged"
        assert engine.settlement.until_early_s(0.0) == math.inf
        engine.settlement.flush()  # a flush without rows writes no segment
        ingest_one(engine, 2)
        began = engine.settlement._log.begun_s
        engine.settlement._log.write_s = 0.0
        assert engine.settlement.until_early_s(began) == pytest.approx(settlement.LEAST_S)
        assert engine.settlement.until_early_s(began + 2 * settlement.LEAST_S) == 0.0


def test_a_slow_disk_is_not_written_to_all_the_time(tmp_path: Path) -> None:
    with closing(Engine(ServiceConfig(), tmp_path)) as engine:
        ingest_one(engine, 1)
        engine.settlement._log.begun_s = 0.0
        engine.settlement._log.write_s = 1.0
        assert engine.settlement.until_early_s(0.0) == 1.0 / settlement.WRITE_SHARE


def test_a_failed_write_is_repeated_at_the_period_only(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def raise_disk_full(*_: object) -> None:
        raise OSError("disk full")

    with closing(Engine(ServiceConfig(), tmp_path)) as engine:
        ingest_one(engine, 1)
        with monkeypatch.context() as patch:
            patch.setattr(engine.settlement._log._writer, "write", raise_disk_full)
            assert engine.settlement.flush() == []
        ingest_one(engine, 2)
        assert engine.settlement.until_early_s(math.inf) == math.inf
        assert engine.settlement.flush(), "both batches are acknowledged"


def test_the_end_of_a_write_is_announced(tmp_path: Path) -> None:
    with closing(Engine(ServiceConfig(), tmp_path)) as engine:
        written = threading.Event()
        engine.settlement.call_when_written(written.set)
        ingest_one(engine, 1)
        engine.settlement.begin_flush()
        assert written.wait(60.0)
        assert engine.settlement.end_flush()
