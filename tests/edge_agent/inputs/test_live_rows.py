"""Tests of live rows (samples made from live signals). All sources must share one clock, readings
must be interpolated, and late positions must be assigned to their time. Lost sources must be opened
again.
"""

from __future__ import annotations

import logging
import threading
import time
from collections.abc import Callable

import numpy as np
import pytest

from edge_agent.inputs.live import feed
from edge_agent.inputs.live.feed import BELIEVED_S, WHILE_S, Feed, HostClock, Received, Stamps
from edge_agent.inputs.live.rows import DELAY_S, LiveRows
from edge_agent.inputs.profile import Channel, Profile
from edge_agent.inputs.recording import Series
from edge_agent.lab.simulation.presets import PRESETS
from schemas.signals import S
from schemas.thresholds import EARTH_RADIUS_M, NS
from tests.waiting import until

CAR = PRESETS["sedan"].vehicle


class Steered(HostClock):
    """Simulated clock that stands still until the test sets it."""

    def __init__(self) -> None:
        super().__init__(start_ns=1_700_000_000 * NS)
        object.__setattr__(self, "at", [0.0])

    def now(self) -> float:
        return float(self.__dict__["at"][0])

    def move(self, seconds: float) -> None:
        self.__dict__["at"][0] += seconds


class Scripted(Feed):
    """Simulated source of signals, which delivers the readings that the test gives it."""

    def listen(self) -> None:
        self.stopping.wait()

    def series(self, received: list[Received]) -> dict[str, Series]:
        names = {name for _, values in received for name in values}
        found = {
            name: [(t, values[name]) for t, values in received if name in values] for name in names
        }
        return {name: Series(*np.array(pairs).T) for name, pairs in found.items()}

    def tell(self, t: float, **values: float) -> None:
        self.store_message(self.clock.start_ns + round(t * NS), values)


@pytest.fixture
def clock() -> Steered:
    return Steered()


def rows_of(clock: Steered, *feeds: Feed, wait: Callable[[float], None] | None = None) -> LiveRows:
    profile = Profile(
        name="p", channels={name: Channel(signal=name) for name in ("ax", "omega_fl", "delta_fl")}
    )
    return LiveRows(feeds, profile, CAR, clock, wait=wait or clock.move)


def test_foreign_time_stamps_are_moved_by_the_least_delay() -> None:
    own = Stamps()
    other = Stamps()
    delays = [0.3, 0.05, 0.2, 0.11]
    assert [own.host_time(10.0 + k, 10.0 + k + delay) for k, delay in enumerate(delays)] == [
        10.0,
        11.0,
        12.0,
        13.0,
    ]
    places = [other.host_time(k - 5000.0, k + delay) for k, delay in enumerate(delays)]
    assert places[1:] == pytest.approx([1.05, 2.05, 3.05])
    early = Stamps()
    assert early.host_time(10.5, 10.1) == pytest.approx(10.1), "from the future: another clock"
    assert own.added_s == 0.0
    assert max(delays) < BELIEVED_S


def test_a_clock_that_is_set_under_way_is_followed() -> None:
    stamps = Stamps()
    for k in range(20):
        stamps.host_time(k * 1.0, k + 0.02)
    for k in range(20, 20 + round(2.5 * WHILE_S)):
        placed = stamps.host_time(k - 3600.0, k + 0.02)
    assert placed == pytest.approx(k + 0.02)


def test_rows_interpolate_readings_and_are_empty_for_a_silent_source(
    clock: Steered,
) -> None:
    feed = Scripted("bus", clock)
    last = 4.0
    ticks = iter(np.arange(0.0, last + 0.01, 0.02).tolist())  # 50 Hz
    due = [next(ticks)]

    def wait(seconds: float) -> None:
        until_then = clock.now() + seconds
        while due and due[0] <= until_then:
            clock.move(due[0] - clock.now())
            feed.tell(due[0], ax=5.0 * due[0], omega_fl=7.0, delta_fl=0.4)
            due[:] = [tick for tick in [next(ticks, None)] if tick is not None]
        clock.move(until_then - clock.now())

    rows = rows_of(clock, feed, wait=wait)
    blocks = rows.blocks()
    got = [next(blocks) for _ in range(60)]
    t, signals = (
        np.concatenate([getattr(block, name)[:, 0] for block in got]) for name in ("t", "signals")
    )
    has_reading = t <= last + 1e-9
    assert np.allclose(signals[has_reading, S.AX], 5.0 * t[has_reading], atol=1e-6)
    assert np.isnan(signals[~has_reading, S.AX]).all()
    assert (~has_reading).sum() > 100
    assert (signals[:, S.DELTA + 2] == 0.0).all(), "rear wheels do not steer"
    front = signals[has_reading, S.DELTA : S.DELTA + 2]
    assert np.all(front[:, 0] > front[:, 1] + 0.08), "the inner wheel turns more"
    assert np.allclose(front.mean(axis=1), 0.4, atol=0.01)
    assert np.allclose(np.diff(t), 0.01)
    assert (got[0].time[0] - clock.start_ns) / NS == pytest.approx(t[0], abs=1e-8)
    assert rows.health_problems() == ["bus has sent nothing for 2 s"]
    assert clock.now() == pytest.approx(t[-1] + 0.01 + DELAY_S)
    blocks.close()
    assert not feed._thread.is_alive()


def test_suspended_host_leaves_rows_out(clock: Steered) -> None:
    feed = Scripted("bus", clock)
    rows = rows_of(clock, feed)
    blocks = rows.blocks()
    before = next(blocks)
    clock.move(60.0)
    after = next(blocks)
    assert after.t[0, 0] - before.t[-1, 0] > 59.0
    assert rows.skipped == pytest.approx(6000, abs=20)
    blocks.close()


@pytest.mark.skipif(
    not hasattr(time, "CLOCK_BOOTTIME"), reason="this system does not count while it is suspended"
)
def test_host_clock_continues_while_the_host_is_suspended(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    host = HostClock()
    awake = time.clock_gettime
    monkeypatch.setattr(time, "clock_gettime", lambda clock: awake(clock) + 3600.0)
    assert host.now() == pytest.approx(3600.0, abs=60.0)


def test_a_late_fix_is_moved_along_its_course_and_used_once(clock: Steered) -> None:
    bus = Scripted("bus", clock)
    receiver = Scripted("receiver", clock)
    rows = rows_of(clock, bus, receiver)
    blocks = rows.blocks()
    for _ in range(8):
        next(blocks)
    now = clock.now()
    # A north heading at a time whose row was already passed on.
    receiver.tell(now - 0.8, latitude=50.0, longitude=10.0, speed=20.0, course=0.0)
    block = next(blocks)
    place = np.isfinite(block.signals[:, 0, S.LATITUDE])
    assert np.flatnonzero(place).tolist() == [0]
    moved = np.radians(block.signals[0, 0, S.LATITUDE] - 50.0) * EARTH_RADIUS_M
    assert moved == pytest.approx(20.0 * (block.t[0, 0] - 0.005 - (now - 0.8)), rel=1e-3)
    assert block.signals[0, 0, S.LONGITUDE] == pytest.approx(10.0, abs=1e-9)
    assert block.signals[0, 0, S.YAW] == pytest.approx(np.pi / 2)
    assert rows.ground[0] == 20.0
    assert all(np.isnan(next(blocks).signals[:, 0, S.LATITUDE]).all() for _ in range(5))
    blocks.close()


def test_a_fix_at_zero_degrees_is_no_position(clock: Steered) -> None:
    receiver = Scripted("receiver", clock)
    blocks = rows_of(clock, Scripted("bus", clock), receiver).blocks()
    next(blocks)
    receiver.tell(clock.now(), latitude=0.0, longitude=0.0, speed=0.0, course=0.0)
    assert all(np.isnan(next(blocks).signals[:, 0, S.LATITUDE]).all() for _ in range(5))
    blocks.close()


def test_the_receivers_date_holds_where_the_hosts_is_wrong(clock: Steered) -> None:
    bus = Scripted("bus", clock)
    receiver = Scripted("receiver", clock)
    rows = rows_of(clock, bus, receiver)
    blocks = rows.blocks()
    next(blocks)
    for _ in range(10):
        receiver.tell(clock.now() + 86_400.0, latitude=50.0, longitude=10.0, speed=0.0, course=0.0)
        block = next(blocks)
    assert (block.time[0, 0] - clock.start_ns) / NS == pytest.approx(
        86_400.0 + block.t[0, 0], abs=0.01
    )
    blocks.close()


class Failing(Scripted):
    """Simulated live source whose driver first raises an error, then ends, and then works."""

    tries = 0

    def listen(self) -> None:
        self.tries += 1
        if self.tries == 1:
            raise OSError("no such device")
        if self.tries > 2:
            self.tell(self.clock.now(), ax=1.0)
            self.stopping.wait()


def test_failed_source_is_opened_again_and_reported_once(
    caplog: pytest.LogCaptureFixture,
) -> None:
    feed = Failing("bus", HostClock())
    with caplog.at_level(logging.WARNING):
        feed.start()
        until(lambda: feed.received_count)
    feed.close()
    assert feed.losses == 2
    assert [record.getMessage() for record in caplog.records] == [
        "bus: lost (no such device); trying again",
        "bus: lost (the source ended); trying again",
    ]


def test_rows_wait_for_a_slow_source_and_count_late_readings(
    clock: Steered,
) -> None:
    feed = Scripted("bus", clock)
    rows = rows_of(clock, feed)
    blocks = rows.blocks()
    feed.tell(0.0, ax=1.0)
    next(blocks)
    waited = clock.now()
    assert waited > 1.0, "its next reading is not there yet"
    feed.tell(clock.now(), ax=1.0)
    next(blocks)
    assert clock.now() - waited < 0.2, "it has told of a later time"
    assert rows.late == 0
    feed.tell(0.05, ax=1.0)
    next(blocks)
    assert rows.late == 1
    blocks.close()


class Hanging(Scripted):
    """Simulated live source whose driver hangs until the test lets it continue."""

    def __init__(self, name: str, clock: Steered) -> None:
        super().__init__(name, clock)
        self.entered = threading.Event()
        self.released = threading.Event()

    def listen(self) -> None:
        self.entered.set()
        self.released.wait()


def test_hanging_source_is_abandoned_and_reported(
    clock: Steered, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(feed, "LEAVE_S", 0.01)
    hanging = Hanging("hanging", clock)
    other = Scripted("other", clock)
    for source in (hanging, other):
        source.start()
    hanging.entered.wait()
    hanging.close()
    assert hanging.is_listening
    monkeypatch.setattr(feed, "LEAVE_S", 30.0)
    other.close()
    assert not other.is_listening
    hanging.released.set()
    hanging.close()
    assert not hanging.is_listening
