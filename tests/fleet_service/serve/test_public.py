"""Tests of the public view of a map: it shows only cells that enough vehicles visited, and the safe
deceleration on them.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from dataclasses import replace
from datetime import UTC, datetime, timedelta
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pytest

from fleet_service.app.engine import Engine
from fleet_service.archive.maintenance.retention import drop_checkpoints
from fleet_service.fusion import Fusion
from fleet_service.ingest.inbox import Message
from fleet_service.serve.public_cells import PERIOD_NS
from fleet_service.serve.view import CellView, coarsen_cells
from fleet_service.serve.visitors import PART_NS, Visitors
from schemas import grid, query, wire
from schemas.config import ServiceConfig
from schemas.wire import Kind
from tests.changed_tiles import changed_tiles
from tests.fleet_service.checkpoint_writer import save_checkpoint
from tests.fleet_service.examples import (
    CELL,
    LATITUDE,
    LONGITUDE,
    SECOND,
    START,
    batch,
    key,
    observations,
    value,
)

Start = Callable[[int], Engine]
# Five more vehicles. Two vehicles may share one of the 64 bits, but five practically never have
# fewer than three bits.
MORE = tuple(f"sim-01{k}" for k in range(5))


@pytest.fixture
def start(tmp_path: Path) -> Iterator[Start]:
    """Yield a function that opens an engine (service without network). The engine shows readers
    only cells that at least `public` vehicles visited.
    """
    opened: list[Engine] = []

    def begin(public: int) -> Engine:
        opened.append(Engine(ServiceConfig(public_vehicles=public), tmp_path))
        return opened[-1]

    yield begin
    for engine in opened:
        engine.close()


def hear(engine: Engine, *names: str, now: int | None = None) -> None:
    """Let the engine (service without network) process one observation of each vehicle in `names`,
    at the time `now` [ns].
    """
    now = time.time_ns() if now is None else now
    sent = [
        Message(Kind.OBSERVATION, key(n), wire.encode(batch(n, 1, now - SECOND, [0.8])), "")
        for n in names
    ]
    engine.intake.ingest(sent, now)
    engine.settlement.flush()


def later() -> int:
    """Return a time [ns] at which readers will see the observations that are made now."""
    return time.time_ns() + PERIOD_NS


def rows(engine: Engine, now: int | None = None, **parameters: str) -> list[dict[str, object]]:
    """Return the cells with which the engine (service without network) answers a map query with the
    given parameters at the time `now`.
    """
    tiles = engine.queries.answer(
        query.parse(parameters), lambda _: True, time.time_ns() if now is None else now
    )
    return [
        row for _, payload in tiles for row in pa.ipc.open_stream(payload).read_all().to_pylist()
    ]


def test_a_cell_is_public_from_k_vehicles_on_in_answers_and_tiles(start: Start) -> None:
    engine = start(3)
    hear(engine, "sim-001", "sim-002")
    for parameters in ({}, {"min_vehicles": "1"}, {"basis": "borrowed"}):
        assert not rows(engine, None, **parameters)
    assert not changed_tiles(engine.queries, time.time_ns())
    hear(engine, *MORE)
    assert not rows(engine), "the next moment of publication has not come"
    assert [row["vehicles"] for row in rows(engine, later())] == [5]
    assert len(changed_tiles(engine.queries, later())) == 1
    assert not rows(engine, later(), min_vehicles="7")


def test_the_past_is_no_more_public_than_the_present(start: Start) -> None:
    engine = start(2)
    hear(engine, "sim-001")
    at = time.strftime("%Y-%m-%dT%H:%M:%SZ", time.gmtime())
    assert not rows(engine, at=at)


def test_route_states_the_deceleration_that_is_safe_at_95_percent(start: Start) -> None:
    engine = start(1)
    hear(engine, "sim-001", "sim-002", "sim-003")
    (row,) = rows(engine, route=f"{LONGITUDE - 0.001},{LATITUDE}|{LONGITUDE + 0.001},{LATITUDE}")
    assert row["safe_deceleration"] == pytest.approx(9.81 * float(str(row["mu_lower"])), rel=1e-5)
    assert 5.0 < float(str(row["safe_deceleration"])) < 0.8 * 9.81


def test_no_single_passage_shows_where_persons_are_kept_private(start: Start) -> None:
    """Readers must not notice the single passage of a vehicle through a public cell (one that
    readers may see). The published times and counts are rounded so that they stay the same.
    """
    engine = start(3)
    hear(engine, *(f"sim-{k:03}" for k in range(6)))
    (before,) = rows(engine, later())
    assert (before["vehicles"], before["observations"]) == (5, 5)
    hear(engine, "sim-006")
    (after,) = rows(engine, later())
    assert (after["vehicles"], after["observations"]) == (5, 5)
    for name in ("first_time", "last_time"):
        moment = after[name]
        assert isinstance(moment, datetime)
        assert (moment.minute % 15, moment.second, moment.microsecond) == (0, 0, 0)


def test_coarse_counts_are_never_more_than_there_were() -> None:
    counts = np.arange(1, 4000)
    zeros = np.zeros(len(counts), np.int64)
    cells = CellView(
        zeros,
        zeros,
        np.zeros((len(counts), 32)),
        zeros.astype(np.float32),
        counts,
        counts,
        zeros,
        zeros,
        zeros > 0,
    )
    seen = coarsen_cells(cells)
    assert (seen.vehicles <= counts).all()
    assert (seen.vehicles >= 0.39 * counts).all()
    assert (coarsen_cells(seen).vehicles == seen.vehicles).all()


def test_vehicle_alone_at_night_stays_hidden_where_many_passed_by_day(start: Start) -> None:
    """A vehicle that passes alone at night must not be visible in answers, routes, stored maps
    (snapshots) and tiles, although many passed by day. Only vehicles of the last hours may make a
    cell public.
    """
    engine = start(3)
    day = (time.time_ns() // (2 * PART_NS) - 2) * 2 * PART_NS + 8 * 3600 * SECOND
    names = [f"sim-{k:03}" for k in range(6)]
    route = f"{LONGITUDE - 0.001},{LATITUDE}|{LONGITUDE + 0.001},{LATITUDE}"
    hear(engine, *names, now=day)
    day += PERIOD_NS
    assert (
        len(rows(engine, day))
        == len(rows(engine, day, route=route))
        == engine.queries.whole_map(day).num_rows
        == 1
    )
    night = day + 18 * 3600 * SECOND
    hear(engine, "sim-007", now=night)
    changed_tiles(engine.queries, day)
    assert not rows(engine, night)
    assert not rows(engine, night, route=route)
    assert not engine.queries.whole_map(night).num_rows
    assert not changed_tiles(engine.queries, night)
    hear(engine, *MORE, now=night + SECOND)
    assert not rows(engine, night + 2 * SECOND)
    (row,) = rows(engine, night + PERIOD_NS)
    assert row["vehicles"] in (5, 10), "of twelve, less those that share a bit, rounded down"
    hour = datetime.fromtimestamp(day / 1e9, UTC)
    assert rows(engine, night, at=f"{hour + timedelta(minutes=1):%Y-%m-%dT%H:%M:%SZ}")
    assert not rows(engine, night, at=f"{hour + timedelta(hours=17):%Y-%m-%dT%H:%M:%SZ}")


def test_restart_restores_recent_vehicles_with_or_without_checkpoint(
    start: Start, tmp_path: Path
) -> None:
    engine = start(3)
    hear(engine, *MORE)
    engine.settlement.flush()
    save_checkpoint(engine)
    for _ in ("checkpoint", "log"):
        engine.close()
        engine = start(3)
        assert [row["vehicles"] for row in rows(engine, later())] == [5]
        drop_checkpoints(tmp_path)


@pytest.mark.parametrize("basis", ["checkpoint", "log"])
def test_a_restart_does_not_show_a_lone_vehicle(start: Start, tmp_path: Path, basis: str) -> None:
    """After a restart of the service, a lone vehicle in a public cell (one that readers may see)
    must not change the cell's values. Three vehicles, each alone in its hour, must not make another
    cell public.
    """
    beside: dict[str, Any] = {
        "latitude": [LATITUDE + 0.002],
        "cell": [grid.cell_of(LATITUDE + 0.002, LONGITUDE)],
    }
    began = (time.time_ns() // PART_NS - 1) * PART_NS
    shown = began + PERIOD_NS
    names = ["lone-1", "lone-2", "lone-3"]
    engine = start(3)
    hear(engine, *MORE, now=began)
    (before,) = rows(engine, shown)
    hear(engine, "lone-0", now=shown)
    for k, name in enumerate(names):  # one vehicle each hour
        now = shown + (k + 1) * 3600 * SECOND
        one = batch(name, 1, now, [0.8], **beside)
        engine.intake.ingest([Message(Kind.OBSERVATION, key(name), wire.encode(one), "")], now)
    at = shown + 4 * 3600 * SECOND
    expected = rows(engine, at)
    assert [row["cell"] for row in expected] == [before["cell"]]
    if basis == "checkpoint":
        save_checkpoint(engine)
    engine.close()
    again = rows(start(3), at)
    assert len(again) == 1
    for name in ("mu", "mu_lower", "mu_upper", "p_slippery", "vehicles", "observations"):
        assert again[0][name] == pytest.approx(expected[0][name], abs=1e-6)


def test_visitors_are_never_counted_as_more_than_they_were() -> None:
    fusion = Fusion(60.0)
    now = START
    visitors = Visitors(fusion)
    rng = np.random.default_rng(3)
    for turn in range(4):
        who = rng.integers(1, 2**62, 40)
        o = observations(np.arange(40) * 0.1, who, value(np.full(40, 0.8)))
        o = replace(o, time=o.time + turn * PART_NS)
        fusion.update(o)
        visitors.add(o)
        now = int(o.time[-1])
    slots = np.arange(fusion.size)
    assert 40 < visitors.count(slots, now)[0] <= 64
    assert 20 < visitors.count(slots, now + PART_NS)[0] <= 40
    assert visitors.count(slots, now + 2 * PART_NS)[0] == 0
    again = Visitors.of(fusion, visitors.columns())
    assert again.count(slots, now).tolist() == visitors.count(slots, now).tolist()
    assert (
        Visitors.of(Fusion(60.0), visitors.columns()).count(np.zeros(0, np.int64), now).tolist()
        == []
    )


def test_cells_unvisited_for_a_week_are_dropped_live_and_by_restart(start: Start) -> None:
    engine = start(1)
    now = time.time_ns()
    names = [f"sim-{k:03}" for k in range(4)]
    alone = LATITUDE - 0.002
    old = now - 8 * 86_400 * SECOND
    where: dict[str, Any] = {"latitude": [alone], "cell": [grid.cell_of(alone, LONGITUDE)]}
    sent = [
        Message(Kind.OBSERVATION, key(n), wire.encode(batch(n, 9, old, [0.8], **where)), "")
        for n in names
    ]
    engine.intake.ingest(sent, old)
    hear(engine, *names, now=now)
    hear(engine, *(f"sim-1{k:02}" for k in range(4)), now=now + 300 * SECOND)
    assert engine.state.fusion.size == 2
    ice = hear_ice(engine, now + 600 * SECOND)
    assert ice
    assert engine.drop_old() == 1
    assert engine.drop_old() == 0
    at = now + 601 * SECOND
    (row,) = [one for one in rows(engine, at) if one["cell"] == CELL]
    assert row["vehicles"] == 8
    assert [alert.cell for alert in engine.alerts.next_to_repeat(9)] == [ice[0].cell]
    hear(engine, "sim-020", now=at + SECOND)
    shown = {one["cell"]: one["vehicles"] for one in rows(engine, at + 2 * SECOND)}
    engine.close()
    again = start(1)
    assert {one["cell"]: one["vehicles"] for one in rows(again, at + 2 * SECOND)} == shown
    assert where["cell"][0] not in shown


def hear_ice(engine: Engine, now: int) -> list[wire.Alert]:
    """Let four vehicles report ice in one cell to the engine, so that it raises an alert. Return
    the engine's alerts.
    """
    where: dict[str, Any] = {
        "latitude": [LATITUDE + 0.002] * 3,
        "cell": [grid.cell_of(LATITUDE + 0.002, LONGITUDE)] * 3,
    }
    sent = [batch(f"sim-2{k:02}", 1, now, [0.12] * 3, **where) for k in range(4)]
    return engine.intake.ingest(
        [Message(Kind.OBSERVATION, key(one.vehicle), wire.encode(one), "") for one in sent], now
    )
