"""The cells: one row ("slot") per cell and sector that anybody visited. Columns to read, records in memory.

The belief of a slot is one run of 64 bytes and all else another, so that a visit to a cell that was not lately in use
costs two reads of memory and not one for every column.
"""

from __future__ import annotations

from typing import Any, Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from fleet_service.fusion.belief import FULL, PackedArray
from schemas import mugrid
from schemas.numeric import Float32Array, IntArray
from schemas.runtime.jit import LINE, refcount_free, refcount_free_inlined
from schemas.thresholds import NS

NONE: Final = -1
NOBODY: Final = -1
SECOND: Final = NS
Records = NDArray[np.void]
Int32Array = NDArray[np.int32]
UIntArray = NDArray[np.uint32]

CELL: Final = np.dtype(
    [("key", "i8"), ("time", "i8"), ("first", "i8"), ("returned", "u8"), ("aged", "f4"), ("visits", "u4"),
     ("vehicles", "u4"), ("values", "f4"), ("crowd", "f4", (2,)), ("window", "i4"), ("voice", "i4")]
)  # fmt: skip


class Cells(NamedTuple):
    """What is known of each slot.

    Attributes:
        belief: (n, 32) bins in 16 bits, see `belief.unpack`, at `time` less `aged`.
        key: (n,) cell · 4 + sector.
        time: (n,) last observation that was folded [ns]; 0 before the first.
        first: (n,) first one [ns].
        returned: (n,) a bit for each remainder of the vehicles whose visits were forgotten, so that who comes back is
            not counted as another.
        aged: (n,) seconds before `time` that the belief has not forgotten yet.
        visits: (n,) observations.
        vehicles: (n,) distinct vehicles.
        values: (n,) votes with a value, fractions of repeated ones summed.
        crowd: (n, 2) bounds and values of vehicles that are not trusted, as far as they are not renewed.
        window: (n,) row of the slot's window, or NONE.
        voice: (n,) row of its voices, or NONE where nobody gave a value or bore witness lately.
    """

    belief: PackedArray
    key: IntArray
    time: IntArray
    first: IntArray
    returned: NDArray[np.uint64]
    aged: Float32Array
    visits: UIntArray
    vehicles: UIntArray
    values: Float32Array
    crowd: Float32Array
    window: Int32Array
    voice: Int32Array


def cells_of(belief: PackedArray, records: Records) -> Cells:
    """Columns of records."""
    return Cells(belief, *(records[name] for name in CELL.names or ()))


def rows_of_lines(rows: int, kind: np.dtype[Any], *shape: int) -> NDArray[Any]:
    """Zeros (rows, *shape) that begin where a LINE does, so that a row of 64 bytes costs one read of memory."""
    size = rows * kind.itemsize * int(np.prod(shape, dtype=np.int64))
    memory = np.zeros(size + LINE, np.uint8)
    begin = -memory.ctypes.data % LINE
    return memory[begin : begin + size].view(kind).reshape(rows, *shape)


def no_beliefs(rows: int) -> PackedArray:
    """Room for beliefs at rest."""
    return rows_of_lines(rows, np.dtype(np.uint16), mugrid.BINS)


@refcount_free
def begin(belief: PackedArray, cells: Records, slot: int, key: int) -> None:
    """A slot that holds the prior."""
    belief[slot] = FULL
    cells[slot].key = key
    cells[slot].window = NONE
    cells[slot].voice = NONE


@refcount_free_inlined
def copy_slot(
    belief: PackedArray, cells: Records, at: int, to_belief: PackedArray, to_cells: Records, to: int
) -> None:  # fmt: skip
    """What is known of a slot, from one row to another; not its window and voice."""
    for i in range(mugrid.BINS):
        to_belief[to, i] = belief[at, i]
    window, voice = to_cells[to].window, to_cells[to].voice
    to_cells[to] = cells[at]
    to_cells[to].window, to_cells[to].voice = window, voice
