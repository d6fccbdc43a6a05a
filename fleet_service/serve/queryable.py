"""Answering queries: what is light at once in Zenoh's thread, what is heavy one after the other in a thread of its own.

Who asks for much waits behind who asks for much, and nobody who asks for little waits for either: the heavy answers go
a tile at a time and rest after each as long as it took. What is more than an answer may hold is an error that says how
to ask. One past is rebuilt at a time, in a process of its own; who asks meanwhile is told to ask again.
"""

from __future__ import annotations

import logging
import queue
import threading
import time
from collections import Counter
from collections.abc import Callable, Iterable
from functools import lru_cache
from typing import Final, NamedTuple

import zenoh

from schemas import keys, query
from schemas.errors import InputError
from schemas.query import Format, MapQuery

log = logging.getLogger(__name__)
TEXT: Final = "text/plain"
# Cells times what one costs in its form: a tile of text is light, a city of it is not.
COST: Final = {Format.ARROW: 1, Format.JSON: 20, Format.GEOJSON: 20}
LIGHT: Final = 30_000  # 20 ms of an Arrow answer
MOST: Final = 10_000_000  # ten million cells of Arrow, 700 MB; half a million as text, 250 MB
WAITING: Final = 8  # heavy questions; more are told to come again
REST: Final = 1.0  # after a tile of a heavy answer, by the time it took: light ones find the interpreter free
LONGEST_REST_S: Final = 0.05


class Answering(NamedTuple):
    """What answers.

    Attributes:
        cells: how many cells an answer may have at the most.
        answer: gives tile and payload of every reply to a query, for the tiles that a predicate wants, and the only
            one, where the query's key is a tile's.
    """

    cells: Callable[[MapQuery, Callable[[int], bool], int | None], int]
    answer: Callable[[MapQuery, Callable[[int], bool], int | None], Iterable[tuple[int, bytes]]]


class MapQueryable:
    """The callback of the queryables.

    Args:
        answering: counts and makes answers.
        counts: takes `queries`, `heavy_queries`, `bad_queries.FIELD` and `answer_failures`.
    """

    def __init__(self, answering: Answering, counts: Counter[str]) -> None:
        self._answering, self._counts = answering, counts
        self._past = threading.Lock()
        self._heavy: queue.Queue[tuple[zenoh.Query, MapQuery]] = queue.Queue(WAITING)
        self._worker: threading.Thread | None = None
        self._starting = threading.Lock()

    def __call__(self, request: zenoh.Query) -> None:
        """Answer one query, now or a little later."""
        self._counts["queries"] += 1
        try:
            pairs: Iterable[tuple[str, str]] = request.parameters  # type: ignore[assignment] # stub: no iterable
            wanted = query.parse({name: value for name, value in pairs if not name.startswith("_")})  # Zenoh's own
            if wanted.at is None:
                cost = self._answering.cells(wanted, *_wanted(request)) * COST[wanted.format]
                if cost > MOST:
                    fix = "narrow bbox, or take format=arrow" if COST[wanted.format] > 1 else "narrow bbox"
                    raise InputError("bbox", "the answer would be too large", fix)
        except InputError as error:
            self._refuse(request, error)
            return
        if wanted.at is not None:
            self._ask_past(request, wanted)
        elif cost <= LIGHT:
            self._reply(request, wanted)
        else:
            self._queue(request, wanted)

    def _ask_past(self, request: zenoh.Query, wanted: MapQuery) -> None:
        if self._past.acquire(blocking=False):
            threading.Thread(target=self._answer_past, args=(request, wanted), name="past", daemon=True).start()
        else:
            self._refuse(request, InputError("at", "another past is being rebuilt", "ask again later"))

    def _queue(self, request: zenoh.Query, wanted: MapQuery) -> None:
        self._counts["heavy_queries"] += 1
        try:
            self._heavy.put_nowait((request, wanted))
        except queue.Full:
            self._refuse(request, InputError("query", "too many ask for as much", "ask again later, or for less"))
        with self._starting:
            if self._worker is None or not self._worker.is_alive():
                self._worker = threading.Thread(target=self._work, name="heavy answers", daemon=True)
                self._worker.start()

    def _work(self) -> None:
        while True:
            self._reply(*self._heavy.get(), rest=REST)

    def _answer_past(self, request: zenoh.Query, wanted: MapQuery) -> None:
        try:
            self._reply(request, wanted)
        finally:
            self._past.release()

    def _reply(self, request: zenoh.Query, wanted: MapQuery, rest: float = 0.0) -> None:
        with request:
            try:
                self._send(request, wanted, rest)
            except InputError as error:
                self._refuse(request, error)
            except zenoh.ZError:  # the session closed meanwhile: nobody is there to hear it
                pass
            except Exception as error:  # whatever it is: a query that ends without a reply says that there is no data
                self._counts["answer_failures"] += 1
                log.exception("a query could not be answered")
                request.reply_err(
                    f"query: could not be answered ({type(error).__name__}); ask again later", encoding=TEXT
                )

    def _send(self, request: zenoh.Query, wanted: MapQuery, rest: float) -> None:
        began = time.perf_counter()
        for tile, payload in self._answering.answer(wanted, *_wanted(request)):
            request.reply(keys.map_key(tile), payload, encoding=wanted.format.encoding)
            if rest:
                time.sleep(min(rest * (time.perf_counter() - began), LONGEST_REST_S))
                began = time.perf_counter()

    def _refuse(self, request: zenoh.Query, error: InputError) -> None:
        field = error.field if error.field in MapQuery.model_fields else "query"  # else the asker's own word
        self._counts[f"bad_queries.{field}"] += 1
        with request:
            request.reply_err(str(error), encoding=TEXT)


def _wanted(request: zenoh.Query) -> tuple[Callable[[int], bool], int | None]:
    """Whether a tile's key matches the query's; and the only tile that can, where the query's key names it."""
    expression = request.key_expr
    only = _tile(str(expression))
    return (lambda tile: tile == only or expression.intersects(zenoh.KeyExpr(keys.map_key(tile)))), only


@lru_cache(1 << 12)
def _tile(expression: str) -> int | None:
    """The tile that a key names; None where it is none's, or many."""
    try:
        return keys.parse(expression).quadint
    except InputError:
        return None
