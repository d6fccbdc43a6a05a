"""What the public sees: cells of enough vehicles, and how hard one may brake on them."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from datetime import datetime
from pathlib import Path

import numpy as np
import pyarrow as pa
import pytest

from fleet_service.app.engine import Engine
from fleet_service.ingest.inbox import Message
from fleet_service.serve.view import CellView, coarse
from schemas import query, wire
from schemas.config import ServiceConfig
from schemas.wire import Kind
from tests.fleet_service.examples import LATITUDE, LONGITUDE, SECOND, batch, key

Start = Callable[[int], Engine]


@pytest.fixture
def start(tmp_path: Path) -> Iterator[Start]:
    """An engine that shows cells of so many vehicles."""
    opened: list[Engine] = []

    def begin(public: int) -> Engine:
        opened.append(Engine(ServiceConfig(public_vehicles=public), tmp_path))
        return opened[-1]

    yield begin
    for engine in opened:
        engine.close()


def hear(engine: Engine, *names: str) -> None:
    """One visit of each."""
    now = time.time_ns()
    sent = [Message(Kind.OBSERVATION, key(n), wire.encode(batch(n, 1, now - SECOND, [0.8])), "") for n in names]
    engine.ingest(sent, now)
    engine.flush()


def rows(engine: Engine, **parameters: str) -> list[dict[str, object]]:
    """Cells of an answer."""
    tiles = engine.answer(query.parse(parameters), lambda _: True, time.time_ns())
    return [row for _, payload in tiles for row in pa.ipc.open_stream(payload).read_all().to_pylist()]


def test_a_cell_is_public_from_k_vehicles_on_in_answers_and_tiles(start: Start) -> None:
    engine = start(3)
    hear(engine, "sim-001", "sim-002")
    for parameters in ({}, {"min_vehicles": "1"}, {"basis": "borrowed"}):
        assert not rows(engine, **parameters)
    assert not engine.tiles(time.time_ns())
    hear(engine, "sim-003")
    assert [row["vehicles"] for row in rows(engine)] == [3]
    assert len(engine.tiles(time.time_ns())) == 1
    assert not rows(engine, min_vehicles="4")


def test_the_past_is_no_more_public_than_the_present(start: Start) -> None:
    engine = start(2)
    hear(engine, "sim-001")
    at = time.strftime("%Y-%m-%dT%H:%M:%SZ", time.gmtime())
    assert not rows(engine, at=at)


def test_a_route_tells_the_deceleration_that_is_safe_at_95_percent(start: Start) -> None:
    engine = start(1)
    hear(engine, "sim-001", "sim-002", "sim-003")
    (row,) = rows(engine, route=f"{LONGITUDE - 0.001},{LATITUDE}|{LONGITUDE + 0.001},{LATITUDE}")
    assert row["safe_deceleration"] == pytest.approx(9.81 * float(str(row["mu_lower"])), rel=1e-5)
    assert 5.0 < float(str(row["safe_deceleration"])) < 0.8 * 9.81


def test_no_single_passage_shows_where_persons_are_kept_private(start: Start) -> None:
    """Times and counts are coarse: a pass at night changes neither."""
    engine = start(3)
    hear(engine, *(f"sim-{k:03}" for k in range(6)))
    (before,) = rows(engine)
    assert (before["vehicles"], before["observations"]) == (5, 5)
    hear(engine, "sim-006")
    (after,) = rows(engine)
    assert (after["vehicles"], after["observations"]) == (5, 5)
    for name in ("first_time", "last_time"):
        moment = after[name]
        assert isinstance(moment, datetime)
        assert (moment.minute % 15, moment.second, moment.microsecond) == (0, 0, 0)


def test_coarse_counts_are_never_more_than_there_were() -> None:
    counts = np.arange(1, 4000)
    zeros = np.zeros(len(counts), np.int64)
    cells = CellView(
        zeros, zeros, np.zeros((len(counts), 32)), zeros.astype(np.float32), counts, counts, zeros, zeros, zeros > 0
    )
    seen = coarse(cells)
    assert (seen.vehicles <= counts).all()
    assert (seen.vehicles >= 0.39 * counts).all()
    assert (coarse(seen).vehicles == seen.vehicles).all()
