"""Tests of the queue of messages that the Zenoh subscribers received. It must stay bounded, and be
emptied in steps of limited size.
"""

from __future__ import annotations

import threading
from collections import Counter
from contextlib import closing
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pyarrow.parquet as pq
import pytest
import zenoh

from fleet_service.app.engine import Engine
from fleet_service.counts import ServiceCounts
from fleet_service.ingest.inbox import QUEUE_BYTES, STEP_BYTES, STEP_MESSAGES, Inbox, Message
from fleet_service.ingest.rate_limit import RateLimiter
from schemas import keys, wire
from schemas.config import ServiceConfig
from schemas.wire import Kind
from tests.fleet_service.examples import SECOND, batch, key

NOW = 1_750_000_000 * SECOND


def inbox(capacity: int) -> tuple[Inbox, ServiceCounts]:
    counts = ServiceCounts()
    return Inbox(capacity, counts, RateLimiter(1.0, 1.0, None, counts)), counts


def of_bytes(size: int) -> Message:
    return Message(Kind.STATE, "", bytes(size), "")


def test_queue_is_limited_in_bytes() -> None:
    queue, counts = inbox(20_000)
    large = of_bytes(wire.MAX_BYTES)
    fits = QUEUE_BYTES // len(large.payload)
    for _ in range(2 * fits):
        queue.put(large)
    assert fits <= len(queue) <= fits + 1
    assert counts.overload == 2 * fits - len(queue), (
        "each that found no room is counted; its sender keeps it"
    )
    waiting = len(queue)
    taken = queue.drain(0.0)
    assert (
        STEP_BYTES
        <= sum(len(message.payload) for message in taken)
        < STEP_BYTES + len(large.payload)
    )
    for _ in range(2 * fits):
        queue.put(large)
    assert len(queue) in (waiting, waiting - 1), "what was taken made room"


class Payload(bytes):
    """Payload of a received message, which fails the test if it is copied."""

    def to_bytes(self) -> bytes:
        assert len(self) <= wire.MAX_BYTES, "copied"
        return bytes(self)


def test_a_message_above_the_largest_size_is_counted_and_not_copied() -> None:
    queue, counts = inbox(10)
    take = queue.callback(Kind.STATE)
    for size in (wire.MAX_BYTES, wire.MAX_BYTES + 1):
        sample = SimpleNamespace(
            key_expr="", payload=Payload(size), encoding="", kind=zenoh.SampleKind.PUT
        )
        take(sample)  # type: ignore[arg-type]
    assert len(queue) == 1
    assert counts == ServiceCounts(refused=Counter(payload=1))


def test_queue_and_step_are_limited_in_messages() -> None:
    queue, counts = inbox(3 * STEP_MESSAGES)
    for _ in range(4 * STEP_MESSAGES):
        queue.put(of_bytes(1))
    assert (len(queue), counts.overload) == (3 * STEP_MESSAGES, STEP_MESSAGES)
    assert [len(queue.drain(0.0)) for _ in range(4)] == [STEP_MESSAGES] * 3 + [0]


def test_start_opens_each_waiting_segment_twice_whatever_their_number(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    segments = 60
    with closing(Engine(ServiceConfig(), tmp_path)) as engine:
        for seq in range(1, segments + 1):
            sent = batch("car-001", seq, NOW, [0.8])
            key = keys.observation_key(sent.region, sent.vehicle)
            engine.intake.ingest(
                [Message(sent.kind, key, wire.encode(sent), wire.ENCODING[sent.kind])], NOW
            )
            engine.settlement.flush()
    opened: Counter[str] = Counter()
    begin = pq.ParquetFile.__init__

    def count_open(self: pq.ParquetFile, path: Path, **options: Any) -> None:  # noqa: ANN401
        opened[Path(path).name] += 1
        begin(self, path, **options)

    monkeypatch.setattr(pq.ParquetFile, "__init__", count_open)
    with closing(Engine(ServiceConfig(), tmp_path)) as again:
        assert again.state.fusion.size == 1
    assert len(opened) >= segments
    assert max(opened.values()) <= 2, "once for its rows, once for who sent them"


def test_active_senders_stay_cached_and_past_days_are_dropped(tmp_path: Path) -> None:
    with closing(Engine(ServiceConfig(), tmp_path)) as engine:
        intake = engine.intake.batches

        def list_known(seq: int, now: int) -> list[tuple[str, int, int, int]]:
            sent = batch("car-1", seq, now, [0.8])
            engine.intake.ingest(
                [Message(Kind.OBSERVATION, key("car-1"), wire.encode(sent), "")], now
            )
            engine.settlement.flush()
            return list(intake._known[Kind.OBSERVATION])

        (first,) = list_known(1, NOW)
        (again,) = list_known(2, NOW + 1000 * SECOND)
        assert again is first
        (later,) = list_known(3, NOW + 3 * 86_400 * SECOND)
        assert later == (*first[:3], first[3] + 3)
        assert engine.counts.observations == 3


def test_a_waiting_worker_is_woken_without_a_message() -> None:
    queue, _ = inbox(10)
    taken: list[list[Message]] = []
    worker = threading.Thread(target=lambda: taken.append(queue.drain(3600.0)), daemon=True)
    worker.start()
    queue.wake()
    worker.join(60.0)
    assert taken == [[]]
    queue.wake()
    queue.put(of_bytes(1))
    assert queue.drain(0.0) == [of_bytes(1)]
