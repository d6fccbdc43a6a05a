"""Tests that an answer which fails carries an error. A client would mistake a missing answer for an
empty map.
"""

from __future__ import annotations

import sys
import threading
import time
from collections.abc import Callable, Iterator
from types import SimpleNamespace
from typing import Any

import pyarrow as pa
import pytest
import zenoh

from fleet_service.counts import ServiceCounts
from fleet_service.serve import queryable as scheduling
from fleet_service.serve.query import AnswerSize
from fleet_service.serve.queryable import (
    COST,
    LIGHT,
    LIGHT_PER_S,
    MOST,
    TILE_COST,
    WAITING,
    Answering,
    MapQueryable,
)
from schemas import keys
from schemas.query import Format, MapQuery
from tests.fleet_service.examples import TILE
from tests.waiting import PATIENCE_S, matched, until

FAILURES = (
    pa.ArrowInvalid("a file is no Parquet"),
    OSError("the disk is gone"),
    ValueError("something else"),
)


def texts(session: zenoh.Session, selector: str) -> list[str]:
    """Return all replies and errors to the query `selector` as texts. They are sorted, because
    Zenoh does not order them.
    """
    return sorted(
        part.payload.to_string()
        for reply in session.get(selector, timeout=PATIENCE_S)
        if (part := reply.ok or reply.err)
    )


@pytest.mark.parametrize("failure", FAILURES, ids=lambda failure: type(failure).__name__)
@pytest.mark.parametrize("parameters", ["", "?at=2026-01-31T07:00:00Z"], ids=["now", "past"])
def test_an_answer_that_fails_midway_is_an_error_and_the_next_works(
    session: zenoh.Session, failure: Exception, parameters: str
) -> None:
    turns: list[int] = []

    def answer(
        query: MapQuery, wanted: Callable[[int], bool], only: int | None
    ) -> Iterator[tuple[int, bytes]]:
        turns.append(1)
        yield TILE, b"a tile"
        if len(turns) == 1:
            raise failure

    counts = ServiceCounts()
    key = keys.map_key(TILE)
    queryable = session.declare_queryable(
        key, MapQueryable(Answering(lambda *_: AnswerSize(1, 1), answer), counts), complete=True
    )
    querier = session.declare_querier(key)
    matched(querier)
    first = texts(session, key + parameters)
    assert first == [
        "a tile",
        f"query: failed in the service ({type(failure).__name__}); ask again later",
    ]
    # The previous query about the past releases its place a moment after its answer.
    until(lambda: texts(session, key + parameters) == ["a tile"])
    assert counts.failures["answer"] == 1
    querier.undeclare()
    queryable.undeclare()


def test_a_query_with_a_too_large_answer_is_refused_with_a_hint(session: zenoh.Session) -> None:
    key = keys.map_key(TILE)
    counts = ServiceCounts()
    asked = Answering(lambda *_: AnswerSize(MOST // COST[Format.JSON] + 1, 1), nothing)
    queryable = session.declare_queryable(key, MapQueryable(asked, counts), complete=True)
    querier = session.declare_querier(key)
    matched(querier)
    assert texts(session, f"{key}?format=json") == [
        "bbox: the answer would be too large; use a smaller bbox, or format=arrow"
    ]
    assert texts(session, key) == []
    assert counts.heavy_queries == 1
    querier.undeclare()
    queryable.undeclare()


def nothing(
    query: MapQuery, wanted: Callable[[int], bool], only: int | None
) -> Iterator[tuple[int, bytes]]:
    """Return an empty answer to a map query, that is, one that contains no tile."""
    return iter(())


@pytest.mark.parametrize(
    "much",
    [AnswerSize(LIGHT + 1, 1), AnswerSize(1, LIGHT // TILE_COST + 1)],
    ids=["cells", "tiles"],
)
def test_small_query_does_not_wait_for_a_large_one(
    session: zenoh.Session, much: AnswerSize
) -> None:
    """The service must answer a query for little data while it still answers a query for much data.
    A query can ask for much data in two ways: its answer has many cells, or many tiles with few
    cells each. The test covers both.
    """
    key = keys.map_key(TILE)
    counts = ServiceCounts()
    light_came = threading.Event()

    def size(query: MapQuery, wanted: Callable[[int], bool], only: int | None) -> AnswerSize:
        return much if query.min_vehicles == 2 else AnswerSize(1, 1)

    def answer(
        query: MapQuery, wanted: Callable[[int], bool], only: int | None
    ) -> Iterator[tuple[int, bytes]]:
        if query.min_vehicles == 2:
            assert light_came.wait(30.0)
        yield TILE, b"a tile"

    replies = MapQueryable(Answering(size, answer), counts)
    queryable = session.declare_queryable(key, replies, complete=True)
    querier = session.declare_querier(key)
    matched(querier)
    heavy = session.get(f"{key}?min_vehicles=2", timeout=60.0)
    assert texts(session, key) == ["a tile"]
    # An answer has no time limit, so the operator must see that the service hangs.
    until(lambda: replies.hangs_s > 0.0)
    light_came.set()
    assert [reply.ok.payload.to_string() for reply in heavy if reply.ok] == ["a tile"]
    until(lambda: replies.hangs_s == 0.0)
    querier.undeclare()
    queryable.undeclare()


# Cost of a query by its `min_vehicles`; one query of each kind.
COSTS = {2: MOST, 3: 2 * LIGHT, 4: LIGHT}


class Half:
    """Zenoh queryable (handler of queries) for tests of scheduling. It answers each query with two
    tiles. A query with the highest cost gets further replies until the test sets the event `go`.
    """

    def __init__(self, session: zenoh.Session) -> None:
        self.counts = ServiceCounts()
        self.go = threading.Event()
        self.session = session
        self.begun = threading.Semaphore(0)
        self.queryable = MapQueryable(Answering(self.size, self.answer), self.counts)
        self.key = keys.map_key(TILE)

    def size(self, query: MapQuery, wanted: Callable[[int], bool], only: int | None) -> AnswerSize:
        return AnswerSize(COSTS[query.min_vehicles], 0)

    def answer(
        self, query: MapQuery, wanted: Callable[[int], bool], only: int | None
    ) -> Iterator[tuple[int, bytes]]:
        yield TILE, b"first"
        while query.min_vehicles == 2 and not self.go.is_set():
            self.begun.release()
            yield TILE, b"more"
        yield TILE, b"last"

    def ask(self, kind: int) -> list[str]:
        """Send a query of the cost class `kind`, and return the replies as texts. Zenoh passes on
        only the last reply with the same key, so the list usually has one item.
        """
        return texts(self.session, f"{self.key}?min_vehicles={kind}")


@pytest.fixture
def half(session: zenoh.Session) -> Iterator[Half]:
    """Yield a Zenoh queryable (handler of queries) that answers with two tiles. Queries of the
    test's session already reach it.
    """
    made = Half(session)
    declared = session.declare_queryable(made.key, made.queryable, complete=True)
    querier = session.declare_querier(made.key)
    matched(querier)
    yield made
    made.go.set()
    querier.undeclare()
    declared.undeclare()


def test_small_query_is_answered_during_a_large_earlier_one(half: Half) -> None:
    large = half.session.get(f"{half.key}?min_vehicles=2", timeout=60.0)
    assert half.begun.acquire(timeout=30.0)
    assert half.ask(3) == ["last"]
    assert not half.go.is_set()
    half.go.set()
    assert [reply.ok.payload.to_string() for reply in large if reply.ok] == ["last"]


def test_light_questions_beyond_their_share_are_still_answered(
    half: Half, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A client sends more small queries than its share of the service allows. They may wait behind
    heavy queries, but the service must refuse none. The service's clock stands still, so that the
    share does not refill.
    """
    now = time.monotonic()
    clock = SimpleNamespace(monotonic=lambda: now, sleep=time.sleep)
    monkeypatch.setattr(scheduling, "time", clock)
    share = int(LIGHT_PER_S / LIGHT)
    for _ in range(2 * share):
        assert half.ask(4) == ["last"]
    assert half.counts.queries - half.counts.heavy_queries == share
    assert not half.counts.refused_queries


def test_most_costly_query_is_deferred_under_overload(half: Half) -> None:
    large = [
        half.session.get(f"{half.key}?min_vehicles=2", timeout=60.0) for _ in range(WAITING + 2)
    ]
    until(lambda: half.counts.refused_queries >= 1)
    assert half.ask(3) == ["last"]
    half.go.set()
    answers = [
        sorted(part.payload.to_string() for r in one if (part := r.ok or r.err)) for one in large
    ]
    refused = [answer for answer in answers if "last" not in answer]
    assert len(refused) == half.counts.refused_queries < len(large)
    assert all(
        "query: too many large queries are waiting; ask again later, or query a smaller area"
        in answer
        for answer in refused
    )


class BadQuery:
    """Query with an unusable box, as Zenoh passes it to a handler."""

    parameters = (("bbox", "1,2"),)

    def reply_err(self, payload: str, encoding: zenoh.Encoding) -> None:
        """Accept the error."""

    def drop(self) -> None:
        """End the query."""

    def __enter__(self) -> BadQuery:
        return self

    def __exit__(self, *_: object) -> None:
        self.drop()


@pytest.fixture
def frequent_switches() -> Iterator[None]:
    """Let threads interrupt each other as often as possible."""
    before = sys.getswitchinterval()
    sys.setswitchinterval(1e-6)
    yield
    sys.setswitchinterval(before)


@pytest.mark.usefixtures("frequent_switches")
def test_refused_queries_of_several_threads_are_all_counted() -> None:
    request: Any = BadQuery()
    for _ in range(400):
        counts = ServiceCounts()
        replies = MapQueryable(Answering(lambda *_: AnswerSize(1, 1), nothing), counts)
        begin = threading.Barrier(4)

        def call(replies: MapQueryable = replies, begin: threading.Barrier = begin) -> None:
            begin.wait()
            for _ in range(5):
                replies(request)

        threads = [threading.Thread(target=call) for _ in range(4)]
        for thread in threads:
            thread.start()
        for thread in threads:
            thread.join()
        assert (counts.queries, counts.bad_queries["bbox"]) == (20, 20)
