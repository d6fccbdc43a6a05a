"""Answering queries: in Zenoh's thread where it is quick, in a thread of its own where the archive has to be replayed.

One past is rebuilt at a time; who asks meanwhile is told to ask again. So nobody can keep the others from the map by
asking for history.
"""

from __future__ import annotations

import logging
import threading
from collections import Counter
from collections.abc import Callable, Iterable
from functools import lru_cache
from typing import Final

import zenoh

from schemas import keys, query
from schemas.errors import InputError
from schemas.query import MapQuery

log = logging.getLogger(__name__)
TEXT: Final = "text/plain"
Answering = Callable[[MapQuery, Callable[[int], bool], int | None], Iterable[tuple[int, bytes]]]


class MapQueryable:
    """The callback of the queryables.

    Args:
        answer: gives tile and payload of every reply to a query, for the tiles that a predicate wants, and the only
            one, where the query's key is a tile's.
        counts: takes `queries`, `bad_queries.FIELD` and `answer_failures`.
    """

    def __init__(self, answer: Answering, counts: Counter[str]) -> None:
        self._answer, self._counts = answer, counts
        self._past = threading.Lock()

    def __call__(self, request: zenoh.Query) -> None:
        """Answer one query, now or a little later."""
        self._counts["queries"] += 1
        try:
            pairs: Iterable[tuple[str, str]] = request.parameters  # type: ignore[assignment] # stub: no iterable
            wanted = query.parse({name: value for name, value in pairs if not name.startswith("_")})  # Zenoh's own
        except InputError as error:
            self._refuse(request, error)
            return
        if wanted.at is None:
            self._reply(request, wanted)
        elif self._past.acquire(blocking=False):
            threading.Thread(target=self._answer_past, args=(request, wanted), name="past", daemon=True).start()
        else:
            self._refuse(request, InputError("at", "another past is being rebuilt", "ask again later"))

    def _answer_past(self, request: zenoh.Query, wanted: MapQuery) -> None:
        try:
            self._reply(request, wanted)
        finally:
            self._past.release()

    def _reply(self, request: zenoh.Query, wanted: MapQuery) -> None:
        with request:
            try:
                self._send(request, wanted)
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

    def _send(self, request: zenoh.Query, wanted: MapQuery) -> None:
        expression = request.key_expr
        only = _tile(str(expression))
        for tile, payload in self._answer(
            wanted, lambda t: t == only or expression.intersects(zenoh.KeyExpr(keys.map_key(t))), only
        ):
            request.reply(keys.map_key(tile), payload, encoding=wanted.format.encoding)

    def _refuse(self, request: zenoh.Query, error: InputError) -> None:
        field = error.field if error.field in MapQuery.model_fields else "query"  # else the asker's own word
        self._counts[f"bad_queries.{field}"] += 1
        with request:
            request.reply_err(str(error), encoding=TEXT)


@lru_cache(1 << 12)
def _tile(expression: str) -> int | None:
    """The tile that a key names; None where it is none's, or many."""
    try:
        return keys.parse(expression).quadint
    except InputError:
        return None
