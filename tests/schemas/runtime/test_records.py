"""Tests of records (structured arrays). The annotations of a class must become the fields of an
array, for Python and for compiled functions.
"""

from __future__ import annotations

from typing import Annotated, NamedTuple

import numpy as np

from schemas.numeric import FloatArray, IntArray
from schemas.runtime.jit import compiled
from schemas.runtime.records import Records, put_record, record_type, records

SIZE = 3


class Inner(NamedTuple):
    level: float
    curve: Annotated[FloatArray, SIZE]


class Outer(NamedTuple):
    begun: bool
    seen: int
    inner: Inner
    table: Annotated[FloatArray, 2, SIZE]
    marks: Annotated[IntArray, 4]


class Row:
    """Record type whose fields the test changes in a compiled function."""

    begun: bool
    seen: int
    inner: Inner
    table: Annotated[FloatArray, 2, SIZE]
    marks: Annotated[IntArray, 4]


class Wider:
    first: float


class Widest(Wider):
    second: float


@compiled
def fill_rows(rows: Records[Row], first: int, last: int) -> None:
    for n in range(first, last):
        row = rows[n]
        row.begun = True
        row.seen = row.seen + n
        row.inner.curve[1] = row.inner.level + n
        for j in range(row.table.shape[1]):
            row.table[1, j] = 10.0 * n + j


def test_the_annotations_are_the_fields_and_those_of_a_base_come_first() -> None:
    kind = record_type(Outer)
    assert kind.names == Outer._fields
    assert kind == record_type(Row)
    assert [kind[name].base for name in ("begun", "seen", "table", "marks")] == [
        "?",
        "i8",
        "f8",
        "i8",
    ]
    assert [kind[name].shape for name in ("begun", "table", "marks")] == [(), (2, SIZE), (4,)]
    assert kind["inner"].names == Inner._fields
    assert record_type(Widest).names == ("first", "second")


def test_kernel_accesses_only_the_given_rows() -> None:
    rows = records(Outer, 4)
    rows["inner"]["level"] = 0.5
    fill_rows(rows, 1, 3)
    assert rows["begun"].tolist() == [False, True, True, False]
    assert rows["seen"].tolist() == [0, 1, 2, 0]
    assert rows["inner"]["curve"][:, 1].tolist() == [0.0, 1.5, 2.5, 0.0]
    assert rows["table"][2].tolist() == [[0.0] * SIZE, [20.0, 21.0, 22.0]]


def test_nested_named_tuple_is_copied_into_a_record() -> None:
    rows = records(Outer, 2)
    put_record(
        rows[1], Outer(True, 7, Inner(0.25, np.arange(3.0)), np.ones((2, SIZE)), np.arange(4))
    )
    assert rows[1]["inner"]["curve"].tolist() == [0.0, 1.0, 2.0]
    assert rows["seen"].tolist() == [0, 7]
