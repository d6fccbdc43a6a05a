"""The past is rebuilt in a process of its own, from as many rows as are asked for, or not at all."""

from __future__ import annotations

import time
from contextlib import closing
from pathlib import Path

import pytest

from fleet_service.app import past
from fleet_service.app.engine import Engine
from fleet_service.archive.compaction import compact
from fleet_service.ingest.inbox import Message
from fleet_service.replay.rebuild import rows_near
from schemas import query, wire
from schemas.config import ServiceConfig
from schemas.errors import InputError
from schemas.wire import Kind
from tests.fleet_service.examples import LATITUDE, LONGITUDE, TILE, batch, key

NEAR = f"{LONGITUDE - 0.1},{LATITUDE - 0.1},{LONGITUDE + 0.1},{LATITUDE + 0.1}"


@pytest.fixture
def root(tmp_path: Path) -> Path:
    """Some compacted rows of one place."""
    now = time.time_ns()
    with closing(Engine(ServiceConfig(), tmp_path)) as engine:
        for seq in range(1, 5):
            sent = [batch(f"car-{k:03}", seq, now, [0.8] * 20) for k in range(5)]
            engine.ingest([Message(Kind.OBSERVATION, key(b.vehicle), wire.encode(b), "") for b in sent], now)
            engine.flush()
    compact(tmp_path)
    return tmp_path


def question(**parameters: str) -> past.PastQuery:
    return past.PastQuery(query.parse(parameters), time.time_ns(), 120.0, None)


def test_rows_are_counted_before_any_is_read(root: Path) -> None:
    now = time.time_ns()
    assert rows_near(root, now, None, 10**6) == 400
    assert rows_near(root, now, past.box_of(question(bbox=NEAR)), 10**6) == 400
    assert rows_near(root, now, past.box_of(question(bbox="0,0,1,1")), 10**6) == 0


def test_what_would_read_too_much_is_refused_and_a_narrower_box_is_not(
    root: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(past, "MOST_ROWS", 399)
    with pytest.raises(InputError, match="at: would have to read too much of the archive; narrow bbox"):
        list(past.ask(root, question(), lambda _: True))
    assert list(past.ask(root, question(bbox="0,0,1,1"), lambda _: True)) == []


def test_the_answer_of_the_other_process_is_that_of_this_one(root: Path) -> None:
    asked = question(bbox=NEAR)
    (mine,) = past.replies(root, asked)
    (theirs,) = past.ask(root, asked, lambda _: True)
    assert theirs == mine
    assert mine[0] == TILE
    assert list(past.ask(root, asked, lambda _: False)) == []
