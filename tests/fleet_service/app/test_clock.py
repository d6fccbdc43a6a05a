"""Jumps of the system's clock: honest vehicles are not refused for them, before and after a restart."""

from __future__ import annotations

import time
from contextlib import closing
from dataclasses import dataclass
from pathlib import Path

import pytest

from fleet_service.app.clock import SteadyClock
from fleet_service.app.engine import Engine
from fleet_service.ingest.inbox import Message
from schemas import wire
from schemas.config import ServiceConfig
from schemas.wire import Kind
from tests.fleet_service.examples import SECOND, batch, key

HOUR, DAY = 3600 * SECOND, 86_400 * SECOND


@dataclass
class System:
    """The clocks of a machine."""

    wall: int
    steady: int = 0

    def passes(self, ns: int, jump: int = 0) -> None:
        self.wall += ns + jump
        self.steady += ns

    def clock(self, seen: int = 0) -> SteadyClock:
        return SteadyClock(seen, lambda: self.wall, lambda: self.steady)


def test_a_jump_back_is_not_followed_and_one_forward_only_until_it_is_taken_back() -> None:
    start = time.time_ns()
    system = System(start)
    clock = system.clock()
    system.passes(SECOND)
    assert (clock.now(), clock.slack(), clock.lag()) == (start + SECOND, 0, 0)
    system.passes(SECOND, jump=-HOUR)
    assert (clock.now(), clock.lag()) == (start + 2 * SECOND, HOUR)
    system.passes(SECOND, jump=HOUR + DAY)
    assert clock.now() == start + 3 * SECOND + DAY
    system.passes(SECOND, jump=-DAY)
    assert (clock.now(), clock.slack(), clock.lag()) == (start + 4 * SECOND, 0, 0)


def test_after_a_restart_what_was_seen_before_is_not_the_future() -> None:
    seen = time.time_ns()
    system = System(seen - HOUR)
    clock = system.clock(seen)
    system.passes(SECOND)
    assert (clock.now(), clock.slack(), clock.lag()) == (seen - HOUR + SECOND, HOUR, HOUR)
    system.passes(SECOND, jump=HOUR)
    assert (clock.now(), clock.slack()) == (seen + 2 * SECOND, 0)


def message(seq: int, at: int) -> Message:
    sent = batch("sim-001", seq, at, [0.8])
    return Message(Kind.OBSERVATION, key("sim-001"), wire.encode(sent), wire.ENCODING[Kind.OBSERVATION])


@pytest.mark.parametrize("jump", [-HOUR, DAY, 0])
def test_honest_reports_are_kept_through_jumps_and_restarts_of_the_service(tmp_path: Path, jump: int) -> None:
    true = time.time_ns()
    system = System(true)
    for start in range(2):
        with closing(Engine(ServiceConfig(), tmp_path)) as engine:
            clock = system.clock(engine.seen)
            for step in range(2):
                engine.ingest([message(1 + 2 * start + step, true)], clock.now(), clock.slack())
                engine.flush()
                true += SECOND
                system.passes(SECOND, jump=jump * (start == step == 0))
            assert engine.counts[Kind.OBSERVATION] == 2
            assert engine.counts["refused.time"] == 0


def test_a_vehicle_whose_clock_is_a_day_ahead_is_refused_and_does_not_make_the_others_late(tmp_path: Path) -> None:
    now = time.time_ns()
    with closing(Engine(ServiceConfig(), tmp_path)) as engine:
        engine.ingest([message(1, now + DAY)], now)
        engine.ingest([message(2, now)], now)
        assert (engine.counts["refused.time"], engine.counts[Kind.OBSERVATION], engine.counts["late"]) == (1, 1, 0)
        (_, ack), *_ = engine.flush()
        (stream,) = wire.decode_ack(ack)[1]
        assert stream.durable == ((2, 2),)
        assert [(seq, row) for seq, row, _ in stream.rejected] == [(1, 0)]
