"""Scheduling of queries. Cheap queries are answered in Zenoh's thread, expensive ones in a separate
thread, tile by tile.

Zenoh queries are anonymous, so per-client limits are impossible. Queries are scheduled by estimated
cost instead:

- The next tile belongs to the query that would have ended first on an idle service
  (`_QueuedQuery.rank`). So a small query overtakes a large earlier one, but a stream of small
  queries cannot starve a large one.
- If too many queries wait, the one that would have ended last gets an error that asks the client to
  retry.
- Cheap answers together may cost at most LIGHT_PER_S per second. Further cheap queries are queued
  as expensive ones, smallest first.
- After each tile of an expensive answer, the thread rests as long as the tile took.
- A query beyond the size limit gets an error with a hint.
- One past map is rebuilt at a time, in a separate process. A few such queries wait for their turn;
  further ones get an error that asks the client to retry.
"""

from __future__ import annotations

import heapq
import logging
import threading
import time
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass, field
from functools import lru_cache
from typing import Final, NamedTuple

import zenoh

from fleet_service.counts import ServiceCounts
from fleet_service.serve.query import AnswerSize
from schemas import keys, query
from schemas.errors import InputError
from schemas.query import Format, MapQuery

log = logging.getLogger(__name__)
TEXT: Final = "text/plain"
# Cost of one cell, by format. Therefore one tile is a cheap answer in each format, but a city as
# text is not.
COST: Final = {Format.ARROW: 1, Format.JSON: 20, Format.GEOJSON: 20}
TILE_COST: Final = 750  # cost of a tile in addition to its cells: half a millisecond of work
LIGHT: Final = 30_000  # largest cost of a cheap answer: 20 ms of work in Arrow format
# Largest cost of an answer: ten million cells in Arrow (700 MB), or half a million as text (250
# MB).
MOST: Final = 10_000_000
PER_S: Final = 1_500_000  # [1/s] cost that the service can answer per second
# [1/s] The same for cheap answers, which Zenoh's thread gives one after the other.
LIGHT_PER_S: Final = PER_S / 2
# Largest number of waiting queries. Further ones get an error that asks the client to try again.
WAITING: Final = 64
# Pause after each tile of an expensive answer, as a multiple of the tile's time. Cheap answers can
# use the processor in it.
REST: Final = 1.0
LONGEST_REST_S: Final = 0.05
# Largest number of queries about the past, including the one that is being answered.
PAST_WAITING: Final = 8
# [s] Longest wait of such a query for its turn. Clients wait longer than this.
PAST_WAIT_S: Final = 4.0


def _past_is_busy() -> InputError:
    return InputError("at", "too many past maps are being rebuilt", "ask again later")


class Answering(NamedTuple):
    """Functions that produce answers to map queries.

    Attributes:
        size: returns an upper bound of the number of cells and tiles of an answer.
        answer: yields the tile number and payload of every reply. Arguments are the query, a
            function that accepts tiles, and the only possible tile if the query's key names one.
    """

    size: Callable[[MapQuery, Callable[[int], bool], int | None], AnswerSize]
    answer: Callable[[MapQuery, Callable[[int], bool], int | None], Iterable[tuple[int, bytes]]]


@dataclass(order=True)
class _QueuedQuery:
    """Expensive map query that waits in the queue for its first or its next reply.

    Attributes:
        rank: time [s] at which the query would be finished on an idle service.
        number: serial number of the query, which decides between equal ranks.
    """

    rank: float
    number: int
    request: zenoh.Query = field(compare=False)
    map_query: MapQuery = field(compare=False)
    tiles: Iterator[tuple[int, bytes]] | None = field(default=None, compare=False)


@dataclass
class _Answered:
    """Result of one step of an answer to a query: `is_complete` is True if the answer is complete,
    and False if more replies follow in a later step.
    """

    is_complete: bool = True


class _TokenBucket:
    """Token bucket (allowance that refills at a constant rate) that limits the total estimated cost
    of the queries that are answered at once, per second.
    """

    def __init__(self) -> None:
        self._tokens = LIGHT_PER_S
        self._since = time.monotonic()
        self._guard = threading.Lock()

    def take(self, cost: float) -> bool:
        """Take `cost` tokens (estimated cost of a query) from the bucket; return False, and take
        nothing, if the bucket contains less.
        """
        with self._guard:
            now = time.monotonic()
            self._tokens = min(LIGHT_PER_S, self._tokens + (now - self._since) * LIGHT_PER_S)
            self._since = now
            if self._tokens < cost:
                return False
            self._tokens -= cost
            return True


class MapQueryable:
    """Handler of map queries: answers cheap queries at once, and queues or refuses expensive ones.

    Args:
        answering: functions that estimate the size of answers and produce them.
        counts: counts of the service; `queries`, `heavy_queries`, `refused_queries`, `bad_queries`
            and `failures["answer"]` are increased.
    """

    def __init__(self, answering: Answering, counts: ServiceCounts) -> None:
        self._answering = answering
        self._counts = counts
        # Zenoh calls this object from one thread per queryable; two more kinds of threads answer.
        self._counting = threading.Lock()
        self._past = threading.Lock()
        self._past_waiting = threading.BoundedSemaphore(PAST_WAITING)
        self._heavy: list[_QueuedQuery] = []  # heap, with the next query first
        self._light = _TokenBucket()
        self._worker: threading.Thread | None = None
        self._busy_since: float | None = None  # time [s] at which the current tile was begun
        self._has_queued = threading.Condition()

    @property
    def hangs_s(self) -> float:
        """Return the time [s] since the current tile of an expensive answer was begun; 0 if no tile
        is being computed.
        """
        since = self._busy_since
        return 0.0 if since is None else time.monotonic() - since

    def __call__(self, request: zenoh.Query) -> None:
        """Handle one map query: answer it at once, queue it, or refuse it."""
        with self._counting:
            self._counts.queries += 1
        with self._reply_to(request) as answered:
            # `zenoh.Parameters` is iterable, but its type stub does not declare this.
            pairs: Iterable[tuple[str, str]] = request.parameters  # type: ignore[assignment]
            # Names that begin with "_" are Zenoh's own parameters.
            map_query = query.parse(
                {name: value for name, value in pairs if not name.startswith("_")}
            )
            cost = self._estimate_cost(request, map_query) if map_query.at is None else 0.0
            answered.is_complete = False
        if answered.is_complete:  # refused
            return
        if map_query.at is not None:
            self._ask_past(request, map_query)
        elif cost <= LIGHT and self._light.take(cost):
            self._reply(request, map_query)
        else:
            self._queue_query(request, map_query, cost)

    def _estimate_cost(self, request: zenoh.Query, map_query: MapQuery) -> float:
        """Return the estimated cost of the answer to a query about the present map.

        Raises:
            InputError: the answer would be too large.
        """
        size = self._answering.size(map_query, *_key_filter(request))
        cost = size.cells * COST[map_query.format]
        if cost > MOST:
            fix = (
                "use a smaller bbox, or format=arrow"
                if COST[map_query.format] > 1
                else "use a smaller bbox"
            )
            raise InputError("bbox", "the answer would be too large", fix)
        return cost + size.tiles * TILE_COST

    def _ask_past(self, request: zenoh.Query, map_query: MapQuery) -> None:
        if self._past_waiting.acquire(blocking=False):
            threading.Thread(
                target=self._wait_for_past, args=(request, map_query), name="past", daemon=True
            ).start()
        else:
            self._refuse(request, _past_is_busy())

    def _wait_for_past(self, request: zenoh.Query, map_query: MapQuery) -> None:
        """Answer a query about a past map when all earlier queries of this kind have been answered;
        refuse it if it waits longer than PAST_WAIT_S.
        """
        try:
            if self._past.acquire(timeout=PAST_WAIT_S):
                try:
                    self._reply(request, map_query)
                finally:
                    self._past.release()
            else:
                self._refuse(request, _past_is_busy())
        finally:
            self._past_waiting.release()

    def _queue_query(self, request: zenoh.Query, map_query: MapQuery, cost: float) -> None:
        with self._has_queued:
            self._counts.heavy_queries += 1
            rank = time.monotonic() + cost / PER_S
            heapq.heappush(
                self._heavy, _QueuedQuery(rank, self._counts.heavy_queries, request, map_query)
            )
            dropped = max(self._heavy) if len(self._heavy) > WAITING else None
            if dropped is not None:
                self._counts.refused_queries += 1
                self._heavy.remove(dropped)
                heapq.heapify(self._heavy)
            self._has_queued.notify()
            if self._worker is None or not self._worker.is_alive():
                self._worker = threading.Thread(
                    target=self._answer_queued, name="heavy answers", daemon=True
                )
                self._worker.start()
        if dropped is not None:
            self._refuse(
                dropped.request,
                InputError(
                    "query",
                    "too many large queries are waiting",
                    "ask again later, or query a smaller area",
                ),
            )

    def _answer_queued(self) -> None:
        while True:
            with self._has_queued:
                self._has_queued.wait_for(lambda: self._heavy)
                first = heapq.heappop(self._heavy)
            began = time.monotonic()
            self._busy_since = began
            goes_on = self._answer_next_tile(first)
            self._busy_since = None
            if goes_on:
                with self._has_queued:
                    heapq.heappush(self._heavy, first)
            time.sleep(min(REST * (time.monotonic() - began), LONGEST_REST_S))

    def _answer_next_tile(self, heavy: _QueuedQuery) -> bool:
        """Answer a queued map query with one more tile; return True if further tiles may follow."""
        request = heavy.request
        with self._reply_to(request) as answered:
            if heavy.tiles is None:
                heavy.tiles = iter(self._answering.answer(heavy.map_query, *_key_filter(request)))
            for tile, payload in heavy.tiles:
                request.reply(keys.map_key(tile), payload, encoding=heavy.map_query.format.encoding)
                answered.is_complete = False
                break
        return not answered.is_complete

    def _reply(self, request: zenoh.Query, map_query: MapQuery) -> None:
        with self._reply_to(request):
            for tile, payload in self._answering.answer(map_query, *_key_filter(request)):
                request.reply(keys.map_key(tile), payload, encoding=map_query.format.encoding)

    @contextmanager
    def _reply_to(self, request: zenoh.Query) -> Iterator[_Answered]:
        """Provide a context in which a map query is answered. At the end, close the request unless
        more replies follow. An exception becomes an error reply.
        """
        answered = _Answered()
        try:
            yield answered
        except InputError as error:
            answered.is_complete = True
            self._refuse(request, error)
        except zenoh.ZError:  # the session has been closed, so nobody receives the reply
            answered.is_complete = True
        # Catch every error. A query that ends without a reply would mean that there are no data.
        except Exception as error:
            answered.is_complete = True
            with self._counting:
                self._counts.failures["answer"] += 1
            log.exception("a query failed")
            with suppress(zenoh.ZError):
                request.reply_err(
                    f"query: failed in the service ({type(error).__name__}); ask again later",
                    encoding=TEXT,
                )
        if answered.is_complete:
            request.drop()

    def _refuse(self, request: zenoh.Query, error: InputError) -> None:
        # Other field names are free text of the client, which must not become names of counters.
        field = error.field if error.field in MapQuery.model_fields else "query"
        with self._counting:
            self._counts.bad_queries[field] += 1
        with suppress(zenoh.ZError), request:  # the session may have been closed
            request.reply_err(str(error), encoding=TEXT)


def _key_filter(request: zenoh.Query) -> tuple[Callable[[int], bool], int | None]:
    """Return two items about the tiles that match a query's key: a function that accepts such
    tiles, and the tile if the key names exactly one (else None).
    """
    expression = request.key_expr
    only = _tile_of_key(str(expression))
    return (
        lambda tile: tile == only or expression.intersects(zenoh.KeyExpr(keys.map_key(tile)))
    ), only


@lru_cache(1 << 12)
def _tile_of_key(expression: str) -> int | None:
    """Return the tile that a key names; None if the key names no tile or several."""
    try:
        return keys.parse(expression).quadint
    except InputError:
        return None
