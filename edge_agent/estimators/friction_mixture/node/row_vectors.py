"""Operations on vectors (called rows) with one number per measurement. There are ROWS = 6
measurements: four wheels and two axles.

An array `rows` (n, ROWS, LANES) contains n vectors, rows[0] to rows[n - 1], for each of LANES nodes
(friction hypotheses). Every operation applies to all LANES nodes at once, each with its own
numbers.

A single vector is a tuple, so that the compiler keeps it in registers during a loop. Elements of an
array would be read from memory again after each write to any array.
"""

from __future__ import annotations

from typing import TypeAlias

from schemas.numeric import FloatArray
from schemas.runtime.jit import inlined
from schemas.runtime.lanes import lanes_at, put_lanes

Row: TypeAlias = tuple[float, float, float, float, float, float]


@inlined
def scale_row(rows: FloatArray, i: int, factor: float) -> Row:
    """Return `factor` times the vector rows[i], for each of LANES nodes.

    `rows` has the shape (n, ROWS, LANES). A vector has one number per measurement (ROWS = 6: four
    wheels, two axles).
    """
    return (
        factor * lanes_at(rows, (i, 0)),
        factor * lanes_at(rows, (i, 1)),
        factor * lanes_at(rows, (i, 2)),
        factor * lanes_at(rows, (i, 3)),
        factor * lanes_at(rows, (i, 4)),
        factor * lanes_at(rows, (i, 5)),
    )


@inlined
def add_row(total: Row, rows: FloatArray, i: int, factor: float) -> Row:
    """Return the vector `total` plus `factor` times the vector rows[i], for each of LANES nodes.

    `rows` has the shape (n, ROWS, LANES). A vector, such as `total` and the result, has one number
    per measurement (ROWS = 6: four wheels, two axles).
    """
    return (
        total[0] + factor * lanes_at(rows, (i, 0)),
        total[1] + factor * lanes_at(rows, (i, 1)),
        total[2] + factor * lanes_at(rows, (i, 2)),
        total[3] + factor * lanes_at(rows, (i, 3)),
        total[4] + factor * lanes_at(rows, (i, 4)),
        total[5] + factor * lanes_at(rows, (i, 5)),
    )


@inlined
def multiply_row(row: Row, rows: FloatArray, i: int) -> float:
    """Return the scalar product of the vectors `row` and rows[i], one number for each of LANES
    nodes.

    `rows` has the shape (n, ROWS, LANES). A vector has one number per measurement (ROWS = 6: four
    wheels, two axles).
    """
    first = row[0] * lanes_at(rows, (i, 0)) + row[1] * lanes_at(rows, (i, 1))
    middle = row[2] * lanes_at(rows, (i, 2)) + row[3] * lanes_at(rows, (i, 3))
    last = row[4] * lanes_at(rows, (i, 4)) + row[5] * lanes_at(rows, (i, 5))
    return first + middle + last


@inlined
def put_row(rows: FloatArray, i: int, row: Row) -> None:
    """Write the vector `row` to rows[i], for each of LANES nodes.

    `rows` has the shape (n, ROWS, LANES). A vector has one number per measurement (ROWS = 6: four
    wheels, two axles).
    """
    put_lanes(rows, (i, 0), row[0])
    put_lanes(rows, (i, 1), row[1])
    put_lanes(rows, (i, 2), row[2])
    put_lanes(rows, (i, 3), row[3])
    put_lanes(rows, (i, 4), row[4])
    put_lanes(rows, (i, 5), row[5])
