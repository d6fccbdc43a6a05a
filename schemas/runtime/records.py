"""Rows of named fields, as one NumPy array of a structured type: what a compiled kernel carries for each vehicle.

The annotations of a class are the fields: float, int, bool, a NumPy number, another such class, or
Annotated[FloatArray, size, ...] and likewise for arrays of the other numbers.
`record_type` makes the type of it and `records` the array; a kernel sees a row as an object with these names.

Why not a tuple of arrays: handing one to a kernel costs .1 to .3 us for each array in it, a record array as much as one
of them; what belongs to one vehicle lies together; and sizes are constants, so that short loops are unrolled.
"""

from __future__ import annotations

from functools import cache
from typing import Annotated, Any, Protocol, TypeAlias, TypeVar, get_args, get_origin, get_type_hints

import numpy as np
from numpy.typing import NDArray

from schemas.numeric import FloatArray, IntArray

RecordArray: TypeAlias = NDArray[np.void]
R_co = TypeVar("R_co", covariant=True)


class Nothing:
    """A record without anything to say."""

    unused: bool


_NUMBERS = (np.int8, np.uint8, np.uint16, np.int32, np.uint32, np.uint64, np.float32)
KINDS: dict[Any, Any] = {
    float: "f8",
    int: "i8",
    bool: "?",
    FloatArray: "f8",
    IntArray: "i8",
    **{number: number for number in _NUMBERS},
    **{NDArray[number]: number for number in _NUMBERS},  # type: ignore[valid-type] # a value, not an annotation
}


class Records(Protocol[R_co]):
    """A record array as a kernel sees it: rows with the fields of R."""

    def __getitem__(self, index: int | tuple[int, int], /) -> R_co:
        """The row, which is part of the array."""
        ...

    def __setitem__(self, index: int | tuple[int, int], row: object, /) -> None:
        """Copy another row there."""
        ...


@cache
def record_type(kind: type) -> np.dtype[np.void]:
    """The structured type whose fields are the annotations of `kind`, those of its bases first."""
    fields = []
    for name, hint in get_type_hints(kind, include_extras=True).items():
        held, *sizes = get_args(hint) if get_origin(hint) is Annotated else (hint,)
        fields.append((name, KINDS[held] if held in KINDS else record_type(held), tuple(int(size) for size in sizes)))
    return np.dtype(fields, align=True)


def records(kind: type, *shape: int) -> RecordArray:
    """Rows of `kind` in an array of this shape, all zero."""
    return np.zeros(shape, record_type(kind))


def put_record(row: np.void, value: tuple[Any, ...]) -> None:
    """A row becomes the value of a named tuple whose annotations say the fields."""
    for name, part in zip(row.dtype.names or (), value, strict=True):
        if isinstance(part, tuple):
            put_record(row[name], part)
        else:
            row[name] = part
