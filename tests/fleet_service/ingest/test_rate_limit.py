"""Tests of rate limits. A vehicle may send a burst, and after it only messages at its permitted
rate. A sender with too much traffic must take nothing from others, and invented vehicle names must
not fill memory.
"""

from __future__ import annotations

import time
from collections import Counter
from pathlib import Path

import pytest
import zenoh

from fleet_service.counts import ServiceCounts
from fleet_service.ingest import rate_limit
from fleet_service.ingest.acks import Acks
from fleet_service.ingest.dedup import SequenceTracker
from fleet_service.ingest.rate_limit import JSON_COST, LEAST_BYTES, RateLimiter
from schemas import wire
from schemas.config import ServiceConfig, ZenohSettings
from schemas.errors import InputError
from schemas.wire import Kind
from schemas.wire.batches import Head
from tests.fleet_service.conftest import running
from tests.fleet_service.examples import SECOND, batch, key
from tests.secured import make_enrolment
from tests.waiting import matched, until

RATE = 10_000.0
BURST = 50_000.0


class Clock:
    """Simulated clock whose time the test sets."""

    now = 0.0

    def __call__(self) -> float:
        return self.now


def buckets(clock: Clock, known: set[str] | None = None) -> tuple[RateLimiter, ServiceCounts]:
    counts = ServiceCounts()
    return RateLimiter(RATE, BURST, known, counts, clock), counts


def test_a_vehicle_may_send_a_burst_and_then_its_rate() -> None:
    clock = Clock()
    found, counts = buckets(clock)
    assert sum(found.allows("obs/a", 5_000) for _ in range(100)) == BURST / 5_000
    clock.now = 2.0
    assert sum(found.allows("obs/a", 5_000) for _ in range(100)) == 2 * RATE / 5_000
    assert counts == ServiceCounts(limited=200 - 10 - 4)


def test_a_publisher_may_send_for_many_vehicles() -> None:
    clock = Clock()
    found = RateLimiter(RATE, BURST, None, ServiceCounts(), clock, {"many": 20.0})
    assert sum(found.allows("obs/many", 5_000) for _ in range(1000)) == 20 * BURST / 5_000
    assert sum(found.allows("obs/one", 5_000) for _ in range(1000)) == BURST / 5_000
    clock.now = 2.0
    assert sum(found.allows("obs/many", 5_000) for _ in range(1000)) == 20 * 2 * RATE / 5_000


def test_small_messages_have_a_minimum_cost() -> None:
    found, _ = buckets(Clock())
    assert sum(found.allows("obs/a", 1) for _ in range(1000)) == BURST // LEAST_BYTES


@pytest.mark.parametrize("encoding", ["application/json", "application/json;schema=gripmap"])
def test_json_costs_more_of_the_rate_limit_per_byte(encoding: str) -> None:
    found, counts = buckets(Clock())
    size = int(BURST) // (2 * JSON_COST)
    assert [found.allows("a/car", size, encoding) for _ in range(3)] == [True, True, False]
    assert counts.limited == 1
    assert all(found.allows("a/other", size) for _ in range(2 * JSON_COST))


def test_sender_over_its_limit_does_not_affect_others() -> None:
    found, _ = buckets(Clock())
    for _ in range(1000):
        found.allows("obs/1202/310/232/loud", 60_000)
    assert found.allows("obs/1202/310/232/quiet", 300)


def test_vehicle_that_is_not_enrolled_is_refused() -> None:
    found, counts = buckets(Clock(), {"car-1"})
    assert found.allows("obs/1202/310/232/car-1", 300)
    assert not any(found.allows(f"obs/1202/310/232/{name}", 300) for name in ("car-2", "**", ""))
    assert counts == ServiceCounts(refused=Counter({"unknown": 3}))
    assert len(found) == 1


def test_invented_names_share_one_bucket_and_fill_no_memory(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(rate_limit, "MOST_NAMES", 100)
    clock = Clock()
    found, _ = buckets(clock)
    through = sum(found.allows(f"obs/made-up-{number}", int(BURST)) for number in range(10_000))
    assert through == 101
    assert len(found) == 101
    clock.now = BURST / RATE
    assert found.allows("obs/after-a-while", 300), "buckets that are full again are forgotten"
    assert len(found) == 1


def test_an_acknowledgement_is_never_larger_than_its_receiver_reads() -> None:
    acks = Acks()
    sent = [batch("sim-001", seq, 0, [0.8]) for seq in range(1, 3001, 2)]
    for one in sent:
        head = Head(
            one.kind, one.vehicle, one.boot, one.region, one.seq, one.first_held, one.estimator
        )
        acks.record_rejected("sim-001", head, 0, "x" * 120)
    stream = SequenceTracker((1, sent[0].boot, sent[0].kind, sent[0].region))
    stream.vehicle = "sim-001"
    stream.boot = sent[0].boot
    acks.record_durable((stream, seq) for seq in range(5001, 9001, 2))
    messages = acks.messages()
    stream_acks = [part for _, payload in messages for part in wire.decode_ack(payload)[1]]
    assert max(len(payload) for _, payload in messages) <= wire.MAX_BYTES
    assert [seq for part in stream_acks for seq, _, _ in part.rejected] == list(range(1, 3001, 2))
    assert [first for part in stream_acks for first, _ in part.durable] == list(
        range(5001, 9001, 2)
    )


def test_service_ignores_unlisted_vehicles_and_excess_data(
    router: ZenohSettings, session: zenoh.Session, tmp_path: Path
) -> None:
    file = tmp_path / "fleet.json"
    file.write_text(make_enrolment(vehicles=["car-1"]).model_dump_json())
    with running(
        router, tmp_path / "archive", fleet=file, vehicle_kb_s=1.0, vehicle_burst_kb=64.0
    ) as run:
        counts = run.service.engine.counts
        received: list[bytes] = []
        session.declare_subscriber(
            "gripmap/v1/ack/*", lambda sample: received.append(sample.payload.to_bytes())
        )
        publisher = session.declare_publisher(key("car-1"))
        matched(publisher)
        for name in ("car-2", "car-1"):
            for seq in range(1, 101):
                sent = batch(name, seq, time.time_ns() - SECOND, [0.8])
                session.put(key(name), wire.encode(sent), encoding=wire.ENCODING[Kind.OBSERVATION])
        until(lambda: counts.limited + counts.observations == 100)
        assert counts.refused["unknown"] == 100
        assert 60 <= counts.observations < 100
        until(lambda: received)
        rejected = [
            refusal
            for payload in received
            for stream in wire.decode_ack(payload)[1]
            for refusal in stream.rejected
        ]
        assert not rejected, "too much is not a fault of the batch"


def test_a_region_that_is_none_is_refused_in_the_configuration() -> None:
    with pytest.raises(ValueError, match="regions"):
        ServiceConfig(regions=["**"])


def test_the_list_of_a_service_is_read_when_it_is_made(
    router: ZenohSettings, tmp_path: Path
) -> None:
    with (
        pytest.raises(InputError, match="^fleet: cannot read"),
        running(router, tmp_path, fleet=tmp_path / "none.json"),
    ):
        pass
