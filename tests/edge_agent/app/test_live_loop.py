"""Tests of the pipeline and the live loop. At the end, the open visits (passes through map cells)
must be closed. The delay behind real time must be counted, and the loop must stop on request.
"""

from __future__ import annotations

import socket
import threading
from collections.abc import Iterator
from contextlib import closing
from dataclasses import replace
from itertools import count
from pathlib import Path

import numpy as np
import pytest

from edge_agent.app import agent
from edge_agent.app.live_loop import STATUS_EVERY_S, LoopOptions, Progress, run_live_loop
from edge_agent.estimators import create
from edge_agent.inputs.block import Block
from edge_agent.inputs.context import context_block
from edge_agent.lab.simulation import SimulatedFleet
from edge_agent.lab.simulation.blocks import blocks
from edge_agent.lab.truth_file import TruthRecorder
from edge_agent.observe.cell_tracker import NOWHERE, locate_vehicles, new_tracks
from edge_agent.observe.observation_builder import RecordBlock
from edge_agent.observe.pipeline import Pipeline
from edge_agent.publish.outbox import Outbox
from schemas import grid
from schemas.config import AgentConfig, ZenohSettings
from schemas.errors import InputError
from schemas.wire import Kind

VEHICLES = 3
RATE = 50.0


class Basket:
    """Simulated publisher that stores all records that the live loop offers for publication."""

    is_broken = False

    def __init__(self) -> None:
        self.taken: list[RecordBlock] = []

    def offer(self, *records: RecordBlock) -> None:
        self.taken += records

    def column(self, kind: Kind, name: str) -> np.ndarray:
        parts = [
            r.vehicle if name == "vehicle" else r.columns[name]
            for r in self.taken
            if r.kind is kind
        ]
        return np.concatenate(parts)


def pipeline_of(fleet: SimulatedFleet) -> Pipeline:
    return Pipeline(create("ckf", fleet.vehicles), len(fleet.vehicles), AgentConfig())


def fleet_blocks(
    count: int, recorder: TruthRecorder | None = None, seed: int = 1
) -> tuple[SimulatedFleet, list[Block]]:
    fleet = SimulatedFleet("demo", VEHICLES, seed, RATE)
    source = blocks(fleet, RATE, recorder)
    return fleet, [next(source) for _ in range(count)]


def join_blocks(parts: list[Block]) -> Block:
    return Block(
        *(np.concatenate([getattr(b, name) for b in parts]) for name in ("t", "time", "signals"))
    )


def test_every_visit_of_a_drive_becomes_one_observation_with_a_likelihood() -> None:
    fleet, parts = fleet_blocks(300)
    pipeline = pipeline_of(fleet)
    basket = Basket()
    for block in parts:
        basket.offer(*pipeline.step(block)[1:])
    last = pipeline.finish()
    assert last is not None
    basket.offer(last)
    whole = join_blocks(parts)
    _, located = locate_vehicles(new_tracks(VEHICLES), whole.t, whole.signals)
    visits = np.count_nonzero(located.closes & (located.cell != NOWHERE))
    assert len(basket.column(Kind.OBSERVATION, "cell")) == visits > 20
    assert len(last.vehicle) == np.count_nonzero(located.cell[-1] != NOWHERE)
    likelihood = basket.column(Kind.OBSERVATION, "log_likelihood")
    assert (likelihood.min(axis=1) == 0).all()
    assert likelihood.any(axis=1).mean() > 0.5


def test_the_records_of_a_fleet_do_not_depend_on_the_blocks() -> None:
    fleet, parts = fleet_blocks(60)
    whole = Basket()
    pieces = Basket()
    whole.offer(*pipeline_of(fleet).step(join_blocks(parts))[1:])
    pipeline = pipeline_of(fleet)
    for block in parts:
        pieces.offer(*pipeline.step(block)[1:])
    for kind in Kind:
        assert len(whole.column(kind, "vehicle"))
        for name in whole.taken[kind is Kind.STATE].columns:
            expected = whole.column(kind, name)
            found = pieces.column(kind, name)
            assert np.array_equal(expected, found, equal_nan=expected.dtype.kind == "f"), name


def test_a_pipeline_without_samples_has_nothing_to_finish() -> None:
    fleet, _ = fleet_blocks(0)
    assert pipeline_of(fleet).finish() is None


def run(
    parts: Iterator[Block], fleet: SimulatedFleet, stop: threading.Event, **options: object
) -> tuple[Progress, Basket, list[float]]:
    basket = Basket()
    reported = []
    report = lambda progress: reported.append(progress.signals_s)  # noqa: E731
    chosen = LoopOptions(report, **options)  # type: ignore[arg-type]
    progress = run_live_loop(
        parts,
        pipeline_of(fleet),
        basket,  # type: ignore[arg-type]
        stop,
        chosen,
    )
    return progress, basket, reported


def test_a_simulated_source_hands_its_context_to_the_observations(
    caplog: pytest.LogCaptureFixture,
) -> None:
    """Car 0 brakes with ABS now and then. Its published observations must contain the ABS flag.

    The flag of car 1 is always on, so it carries no information. Car 2 sends no flag. The published
    flag of both cars must be unknown.
    """
    fleet, parts = fleet_blocks(300)
    for place, block in enumerate(parts):
        abs_active = np.full(block.t.shape, np.nan)
        abs_active[:, 0] = place % 50 > 40
        abs_active[:, 1] = 1.0
        parts[place] = replace(
            block,
            context=context_block(
                block.t.shape[0],
                block.t.shape[1],
                {"abs_active": abs_active, "air_temperature": -3.0},
            ),
        )
    _, basket, _ = run(iter(parts), fleet, threading.Event(), clock=count(0.0, 0.1).__next__)
    plain = Basket()
    pipeline = pipeline_of(fleet)
    for block in parts:
        plain.offer(*pipeline.step(replace(block, context=None))[1:])
    last = pipeline.finish()
    assert last is not None
    plain.offer(last)
    whose = basket.column(Kind.OBSERVATION, "vehicle")
    flag = basket.column(Kind.OBSERVATION, "abs_active")
    assert set(flag[whose == 0].tolist()) == {0, 1}
    assert set(flag[whose > 0].tolist()) == {-1}
    filled = np.isfinite(basket.column(Kind.OBSERVATION, "air_temperature"))
    assert filled.mean() >= 0.9
    messages = [
        record.getMessage()
        for record in caplog.records
        if "is treated as unknown" in record.getMessage()
    ]
    assert messages == [
        (
            "vehicle 1: abs_active has been on since the start: it is treated as unknown; "
            "correct the profile"
        )
    ]
    for name in plain.taken[0].columns.keys() - {"abs_active", "air_temperature"}:
        one, other = (b.column(Kind.OBSERVATION, name) for b in (plain, basket))
        assert np.array_equal(one, other, equal_nan=one.dtype.kind == "f"), name


def test_records_are_stored_if_the_source_of_samples_fails(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    fleet, parts = fleet_blocks(10)
    spool = tmp_path / "spool.sqlite"
    unreachable = ZenohSettings(connect=["tcp/127.0.0.1:9"])
    config = AgentConfig(zenoh=unreachable, spool=spool, flush_s=60.0)

    def blocks() -> Iterator[Block]:
        yield from parts
        raise InputError("source", "failed", "repair it")

    monkeypatch.setattr(agent, "ENDED_DRAIN_S", 0.2)
    driver = agent.Agent(
        agent.AgentOptions(fleet.vehicles, fleet.names, config, "ckf"),
        agent.AgentSource(blocks(), clock=count(0.0, 10.0).__next__),
    )
    with pytest.raises(InputError, match="source: failed"):
        driver.drive()
    outbox = Outbox(spool)
    assert outbox.held.count_records(fleet.names, Kind.STATE) >= len(fleet.names)
    outbox.close()


class WaitingClock(threading.Event):
    """Simulated clock that is also the event on which the live loop waits. Only this waiting
    advances the clock, as if all computation took no time.
    """

    def __init__(self) -> None:
        super().__init__()
        self.now = 0.0

    def wait(self, timeout: float | None = None) -> bool:
        """Advance the clock by the timeout [s] and return at once."""
        self.now += timeout or 0.0
        return self.is_set()


def test_a_loop_that_keeps_up_is_not_behind_and_takes_its_time() -> None:
    fleet, parts = fleet_blocks(8)
    stop = WaitingClock()
    progress, basket, _ = run(iter(parts), fleet, stop, clock=lambda: stop.now)
    assert stop.now == pytest.approx(progress.signals_s)
    assert (progress.blocks, progress.late_blocks) == (8, 0)
    assert progress.signals_s == pytest.approx(8 * 0.1 - 1 / RATE)
    assert len(basket.column(Kind.STATE, "time"))


def test_a_loop_that_cannot_keep_up_counts_each_late_block_and_skips_none() -> None:
    fleet, parts = fleet_blocks(20)
    seconds = iter(np.arange(1000.0))
    progress, _, reported = run(
        iter(parts), fleet, threading.Event(), clock=lambda: float(next(seconds))
    )
    assert progress.blocks == 20
    assert progress.late_blocks >= 19
    assert progress.longest_lag_s > 10
    assert len(reported) > 2


def test_the_loop_ends_when_told_and_closes_the_open_visits() -> None:
    fleet, parts = fleet_blocks(50)
    stop = threading.Event()
    stop.set()
    progress, basket, _ = run(iter(parts), fleet, stop)
    assert progress.blocks == 1
    assert len(basket.column(Kind.OBSERVATION, "cell")) == VEHICLES


def test_the_loop_ends_after_its_duration() -> None:
    fleet = SimulatedFleet("demo", VEHICLES, 1, RATE)
    stop = WaitingClock()
    progress, _, _ = run(blocks(fleet, RATE), fleet, stop, duration_s=0.3, clock=lambda: stop.now)
    assert 2 <= progress.blocks <= 6


@pytest.mark.parametrize("broken", [False, True])
def test_systemd_watchdog_is_fed_unless_the_sending_thread_has_died(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, broken: bool
) -> None:
    monkeypatch.setattr(Basket, "is_broken", broken)
    with closing(socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM)) as manager:
        manager.bind(str(tmp_path / "notify"))
        manager.setblocking(False)
        monkeypatch.setenv("NOTIFY_SOCKET", str(tmp_path / "notify"))
        fleet, parts = fleet_blocks(3)
        _, _, reported = run(
            iter(parts), fleet, threading.Event(), clock=count(0.0, STATUS_EVERY_S).__next__
        )
        assert reported
        if broken:
            with pytest.raises(BlockingIOError):
                manager.recv(64)
        else:
            assert manager.recv(64) == b"READY=1\nWATCHDOG=1"


def test_the_truth_is_that_of_the_cells_the_vehicles_were_in(
    tmp_path_factory: pytest.TempPathFactory,
) -> None:
    import pyarrow as pa
    import pyarrow.parquet as pq

    recorder = TruthRecorder(("sim-001", "sim-002", "sim-003"))
    fleet, parts = fleet_blocks(300, recorder)
    path = tmp_path_factory.mktemp("truth") / "truth.parquet"
    recorder.write(path)
    truth = pq.read_table(path)
    assert set(truth["vehicle"].to_pylist()) == set(recorder.names)
    mine = truth.filter([name == "sim-001" for name in truth["vehicle"].to_pylist()])
    enter, leave = (np.array(mine[name].cast(pa.int64())) for name in ("enter_time", "leave_time"))
    whole = join_blocks(parts)
    assert enter[0] == whole.time[0, 0]
    assert leave[-1] == whole.time[-1, 0]
    assert (enter[1:] - leave[:-1] == round(1e9 / RATE)).all()
    repeated = np.searchsorted(enter, whole.time[:, 0], side="right") - 1
    fixes = np.isfinite(whole.signals[:, 0, -3])
    seen = grid.cell_of(whole.signals[fixes, 0, -3], whole.signals[fixes, 0, -2])
    assert (np.array(mine["cell"])[repeated[fixes]] == seen).mean() > 0.5
    assert 0.05 < np.min(np.array(mine["mu"])) <= np.max(np.array(mine["mu"])) < 1.2
    assert fleet.names == list(recorder.names)
