"""Records of named fields as a NumPy structured array: the state of each vehicle in compiled code.

The annotations of a class define the fields: float, int, bool, a NumPy number, another such class,
or Annotated[FloatArray, size, ...] and its counterparts for other numbers. `record_type` returns
the type and `records` the array. Compiled code sees a row as an object with these names.

A tuple of arrays would be slower: each array in it costs 0.1 to 0.3 µs per call, and a record array
costs as much as one array. The data of one vehicle are contiguous, and sizes are constants, so
short loops are unrolled.
"""

from __future__ import annotations

from functools import cache
from typing import (
    Annotated,
    Any,
    Protocol,
    TypeAlias,
    TypeVar,
    get_args,
    get_origin,
    get_type_hints,
)

import numpy as np
from numpy.typing import NDArray

from schemas.numeric import FloatArray, IntArray

RecordArray: TypeAlias = NDArray[np.void]
R_co = TypeVar("R_co", covariant=True)


class EmptyRecord:
    """Record for compiled functions that need no data of this kind; its only field is not used."""

    unused: bool


_NUMBERS = (np.int8, np.uint8, np.uint16, np.int32, np.uint32, np.uint64, np.float32)
KINDS: dict[Any, Any] = {
    float: "f8",
    int: "i8",
    bool: "?",
    FloatArray: "f8",
    IntArray: "i8",
    **{number: number for number in _NUMBERS},
    # a value, not an annotation
    **{NDArray[number]: number for number in _NUMBERS},  # type: ignore[valid-type]
}


class Records(Protocol[R_co]):
    """Type annotation for a record array that is passed to compiled code: its rows have the fields
    of the class R.
    """

    def __getitem__(self, index: int | tuple[int, int], /) -> R_co:
        """Return a row of the record array as a view."""
        ...

    def __setitem__(self, index: int | tuple[int, int], row: object, /) -> None:
        """Copy another row into the row of the record array at `index`."""
        ...


@cache
def record_type(kind: type) -> np.dtype[np.void]:
    """Return the structured NumPy type whose fields are the annotations of `kind`; fields of base
    classes come first.
    """
    fields = []
    for name, hint in get_type_hints(kind, include_extras=True).items():
        held, *sizes = get_args(hint) if get_origin(hint) is Annotated else (hint,)
        fields.append(
            (
                name,
                KINDS[held] if held in KINDS else record_type(held),
                tuple(int(size) for size in sizes),
            )
        )
    return np.dtype(fields, align=True)


def records(kind: type, *shape: int) -> RecordArray:
    """Return an array of records of the class `kind`, all zero."""
    return np.zeros(shape, record_type(kind))


def put_record(row: np.void, value: tuple[Any, ...]) -> None:
    """Copy the values of a named tuple into a row; nested tuples fill nested records."""
    for name, part in zip(row.dtype.names or (), value, strict=True):
        if isinstance(part, tuple):
            put_record(row[name], part)
        else:
            row[name] = part
