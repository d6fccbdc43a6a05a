"""Tests of jumps of the system clock: the service must not refuse honest vehicles because of a
jump, neither before nor after a restart of the service.
"""

from __future__ import annotations

import time
from contextlib import closing
from dataclasses import dataclass
from pathlib import Path

import pytest

from fleet_service.app.clock import SteadyClock, TimeNow
from fleet_service.app.engine import Engine
from fleet_service.app.service import ingest_messages
from fleet_service.ingest.inbox import Message
from schemas import wire
from schemas.config import ServiceConfig
from schemas.wire import Kind
from tests.fleet_service.examples import SECOND, batch, key

HOUR = 3600 * SECOND
DAY = 86_400 * SECOND
YEAR = 365 * 86_400 * SECOND


@dataclass
class System:
    """Simulated clocks of a machine, which the test advances: wall clock and elapsed time [ns]."""

    wall: int
    steady: int = 0

    def passes(self, ns: int, jump: int = 0) -> None:
        self.wall += ns + jump
        self.steady += ns

    def clock(self, seen: int = 0) -> SteadyClock:
        return SteadyClock(seen, lambda: self.wall, lambda: self.steady)


def test_unconfirmed_clock_jumps_are_not_followed() -> None:
    start = time.time_ns()
    system = System(start)
    clock = system.clock()
    system.passes(SECOND)
    clock.record_reports({"car-a": system.wall})
    assert clock.moment() == TimeNow(start + SECOND, 0, 0, start + SECOND)
    system.passes(SECOND, jump=-HOUR)
    assert (clock.now(), clock.lag()) == (start + 2 * SECOND, HOUR)
    system.passes(SECOND, jump=HOUR + YEAR)
    assert (clock.now(), clock.moment().doubt, clock.lag()) == (start + 3 * SECOND, YEAR, -YEAR)
    for _ in range(20):
        system.passes(SECOND)
        clock.record_reports(
            {"car-a": system.wall - YEAR, "car-b": system.wall - YEAR, "liar": system.wall}
        )
    assert clock.now() == start + 23 * SECOND
    system.passes(SECOND, jump=-YEAR)
    assert clock.moment() == TimeNow(start + 24 * SECOND, 0, 0, start + 24 * SECOND)


@pytest.mark.parametrize("wrong", [-30 * 365, 365])
def test_a_corrected_clock_is_followed_when_most_reports_agree(wrong: int) -> None:
    true = time.time_ns()
    system = System(true + wrong * DAY)
    clock = system.clock()
    assert clock.moment().doubt > 40 * YEAR, "nothing is known: nothing is refused"
    assert clock.moment().earliest == 0
    system.passes(SECOND, jump=-wrong * DAY)
    for second in range(1, 12):
        system.passes(SECOND)
        clock.record_reports(
            {
                "car-a": true + second * SECOND,
                "car-b": true + second * SECOND,
                "parked": true - HOUR,
            }
        )
    assert clock.moment() == TimeNow(system.wall, 0, 0, system.wall)


def test_a_small_step_ahead_is_followed_at_once() -> None:
    system = System(time.time_ns())
    clock = system.clock()
    system.passes(SECOND, jump=20 * SECOND)
    assert clock.now() == system.wall


def test_records_seen_before_a_restart_are_not_in_the_future() -> None:
    seen = time.time_ns()
    system = System(seen - HOUR)
    clock = system.clock(seen)
    system.passes(SECOND)
    at = clock.moment()
    assert (at.now, at.slack, at.earliest, clock.lag()) == (
        seen - HOUR + SECOND,
        HOUR,
        seen - HOUR + SECOND,
        HOUR - SECOND,
    )
    assert not at.sure


def test_restart_with_a_clock_a_year_ahead_is_not_sure_of_the_time() -> None:
    seen = time.time_ns()
    clock = System(seen + YEAR).clock(seen)
    assert clock.moment().earliest == seen
    assert not clock.moment().sure
    assert System(seen + HOUR).clock(seen).moment().sure, "off for an hour is nothing unusual"


def message(seq: int, at: int) -> Message:
    sent = batch("sim-001", seq, at, [0.8])
    return Message(
        Kind.OBSERVATION, key("sim-001"), wire.encode(sent), wire.ENCODING[Kind.OBSERVATION]
    )


@pytest.mark.parametrize("jump", [-YEAR, -HOUR, DAY, YEAR, 0])
def test_honest_reports_are_kept_through_jumps_and_restarts_of_the_service(
    tmp_path: Path, jump: int
) -> None:
    true = time.time_ns()
    system = System(true)
    for start in range(2):
        with closing(Engine(ServiceConfig(), tmp_path)) as engine:
            clock = system.clock(engine.seen)
            for step in range(2):
                ingest_messages(engine, clock, [message(1 + 2 * start + step, true)])
                engine.settlement.flush()
                true += SECOND
                system.passes(SECOND, jump=jump * (start == step == 0))
            assert engine.counts.observations == 2
            assert engine.counts.refused["time"] == 0


@pytest.mark.parametrize("doubt", [0, HOUR])
def test_visit_that_ends_after_a_doubtful_clock_is_kept(tmp_path: Path, doubt: int) -> None:
    now = time.time_ns()
    sent = batch(
        "sim-001", 1, now, [0.8], enter_time=[now - SECOND], leave_time=[now + 60 * SECOND]
    )
    visit = message(1, now)._replace(payload=wire.encode(sent))
    with closing(Engine(ServiceConfig(), tmp_path)) as engine:
        engine.intake.ingest([visit], TimeNow(now, doubt=doubt))
        assert engine.counts.refused["time"] == (doubt == 0)
        assert engine.counts.clock_doubted == (doubt > 0)
        engine.intake.ingest([visit], now + 60 * SECOND)
        assert engine.counts.observations == 1


def test_vehicle_with_a_clock_a_day_ahead_is_refused_without_effect(tmp_path: Path) -> None:
    now = time.time_ns()
    with closing(Engine(ServiceConfig(), tmp_path)) as engine:
        engine.intake.ingest([message(1, now + DAY)], now)
        engine.intake.ingest([message(2, now)], now)
        assert (
            engine.counts.refused["time"],
            engine.counts.observations,
            engine.counts.late,
        ) == (1, 1, 0)
        (_, ack), *_ = engine.settlement.flush()
        (stream,) = wire.decode_ack(ack)[1]
        assert stream.durable == ((2, 2),)
        assert [(seq, row) for seq, row, _ in stream.rejected] == [(1, 0)]


def test_acknowledgement_lists_late_batches_once_and_states_the_time(tmp_path: Path) -> None:
    now = time.time_ns()
    with closing(Engine(ServiceConfig(), tmp_path)) as engine:
        engine.intake.ingest([message(1, now)], now)
        engine.intake.ingest([message(2, now - HOUR // 6), message(3, now - SECOND)], now)
        (stream,) = wire.decode_ack(engine.settlement.flush()[0][1])[1]
        assert (stream.durable, stream.late, stream.time) == (((1, 3),), ((2, 2),), now)
        engine.intake.ingest([message(2, now - HOUR // 6)], now + SECOND)
        (stream,) = wire.decode_ack(engine.settlement.flush()[0][1])[1]
        assert (stream.durable, stream.late, stream.time) == (((2, 2),), (), now + SECOND)
