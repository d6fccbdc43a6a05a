"""An answer that fails says so: without a word its asker would take it for a map without data."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Iterator

import pyarrow as pa
import pytest
import zenoh

from fleet_service.serve.queryable import MapQueryable
from schemas import keys
from schemas.query import MapQuery
from tests.fleet_service.examples import TILE
from tests.waiting import matched, until

FAILURES = (pa.ArrowInvalid("a file is no Parquet"), OSError("the disk is gone"), ValueError("something else"))


def texts(session: zenoh.Session, selector: str) -> list[str]:
    """All replies, errors too, in the order of the alphabet: Zenoh has none."""
    return sorted(part.payload.to_string() for reply in session.get(selector) if (part := reply.ok or reply.err))


@pytest.mark.parametrize("failure", FAILURES, ids=lambda failure: type(failure).__name__)
@pytest.mark.parametrize("parameters", ["", "?at=2026-01-31T07:00:00Z"], ids=["now", "past"])
def test_an_answer_that_fails_on_the_way_is_an_error_and_the_next_one_is_answered(
    session: zenoh.Session, failure: Exception, parameters: str
) -> None:
    turns: list[int] = []

    def answer(query: MapQuery, wanted: Callable[[int], bool], only: int | None) -> Iterator[tuple[int, bytes]]:
        turns.append(1)
        yield TILE, b"a tile"
        if len(turns) == 1:
            raise failure

    counts: Counter[str] = Counter()
    key = keys.map_key(TILE)
    queryable = session.declare_queryable(key, MapQueryable(answer, counts), complete=True)
    querier = session.declare_querier(key)
    matched(querier)
    first = texts(session, key + parameters)
    assert first == ["a tile", f"query: could not be answered ({type(failure).__name__}); ask again later"]
    until(lambda: texts(session, key + parameters) == ["a tile"])  # the past before is let go a moment after its answer
    assert counts["answer_failures"] == 1
    querier.undeclare()
    queryable.undeclare()
