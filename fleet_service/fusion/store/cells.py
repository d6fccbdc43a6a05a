"""State of the stored cells as columns for readers, and operations on the rows of cells."""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from fleet_service.fusion.belief import FULL, PackedArray
from fleet_service.fusion.store.records import (
    CELL,
    NONE,
    SOURCES,
    Int32Array,
    Rows,
    UInt16Array,
    UIntArray,
)
from schemas import mugrid
from schemas.numeric import ByteArray, Float32Array, IntArray
from schemas.runtime.jit import LINE, refcount_free, refcount_free_inlined
from schemas.runtime.records import RecordArray


class Cells(NamedTuple):
    """State of all slots (one per cell and heading sector) as columns.

    `belief` (n, 32) contains the probabilities of the friction bins as 16-bit integers, see
    `belief.unpack_belief`. The other columns are the fields of `records.CellRecord`, which explains
    them. They have the shape (n,), except `untrusted` (n, 2: bounds, values) and `manoeuvres` (n,
    4: one weight per kind of manoeuvre).
    """

    belief: PackedArray
    key: IntArray
    time: IntArray
    first: IntArray
    returned: NDArray[np.uint64]
    visits: UIntArray
    vehicles: UIntArray
    values: Float32Array
    window: Int32Array
    reporters: Int32Array
    aged: UInt16Array
    used: ByteArray
    shared: ByteArray
    untrusted: UInt16Array
    manoeuvres: ByteArray


def cells_of(rows: Rows) -> Cells:
    """Return the state of n cells, given as an array of records, as `Cells`: one column (n,) or (n,
    k) per field.
    """
    return Cells(rows.belief, *(rows.cells[name] for name in CELL.names or ()))


def rows_of_lines(rows: int, kind: np.dtype[Any], *shape: int) -> NDArray[Any]:
    """Return an array of zeros (rows, *shape) aligned to cache lines (LINE bytes), so that a row of
    64 bytes costs one memory access.
    """
    size = rows * kind.itemsize * int(np.prod(shape, dtype=np.int64))
    memory = np.zeros(size + LINE, np.uint8)
    begin = -memory.ctypes.data % LINE
    return memory[begin : begin + size].view(kind).reshape(rows, *shape)


def no_beliefs(rows: int) -> PackedArray:
    """Return an array (rows, 32) of zeros for beliefs whose probabilities are stored as 16-bit
    integers.
    """
    return rows_of_lines(rows, np.dtype(np.uint16), mugrid.BINS)


@refcount_free
def begin_slot(live: Rows, slot: int, key: int) -> None:
    """Initialise the slot (storage) of a cell and heading sector, given by its key, with the
    uniform prior.
    """
    live.belief[slot] = FULL
    cell = live.cells[slot]
    cell.key = key
    cell.window = NONE
    cell.reporters = NONE


@refcount_free_inlined
def copy_row(source: Rows, at: int, target: Rows, to: int) -> None:
    """Copy the state of a cell from row `at` of `source` to row `to` of `target`. The target keeps
    its own `window` and `reporters`, which are row numbers of the cell's recent observations and
    recent reporters.
    """
    for i in range(mugrid.BINS):
        target.belief[to, i] = source.belief[at, i]
    window = target.cells[to].window
    reporters = target.cells[to].reporters
    target.cells[to] = source.cells[at]
    target.cells[to].window = window
    target.cells[to].reporters = reporters


@refcount_free_inlined
def copy_sources(source: RecordArray, at: int, target: RecordArray, to: int) -> None:
    """Copy a cell's sources, which are the vehicles that recently reported ice or grip there, and
    the times of their reports. The copy is from row `at` of `source` to row `to` of `target`.
    """
    for side in range(2):
        for k in range(SOURCES):
            target[to].source[side, k] = source[at].source[side, k]
            target[to].source_time[side, k] = source[at].source_time[side, k]
