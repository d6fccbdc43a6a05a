"""Records of named fields as a NumPy structured array. They hold, for example, the state of each
vehicle for compiled code.

A record is defined by a class whose annotations are the fields. A field is a float, int, bool, a
NumPy number, another record class, or Annotated[FloatArray, size, ...] and its counterparts for
other numbers. `record_type` returns the structured NumPy type of a class, and `records` an array of
this type. Compiled code sees a row of the array as an object with the names of the fields.

A tuple with one array per field would be slower, because passing an array costs 0.1 to 0.3 µs per
call. For a record array this cost arises only once. The data of one vehicle are contiguous. Field
sizes are constants, so that the compiler unrolls short loops.

Annotated[LaneArray, size, ...] adds a last axis of LANES numbers, which compiled code reads as one
vector (`lanes.py`). Such fields begin at a cache line, because a vector that crosses two lines is
read twice.
"""

from __future__ import annotations

import math
from functools import cache
from typing import (
    Annotated,
    Any,
    Final,
    NewType,
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
LaneArray = NewType("LaneArray", FloatArray)
# Numbers in a vector of 512 bits; processors with shorter registers use two or four.
LANES: Final = 8
LINE: Final = 8 * LANES  # [bytes] size of a vector and of a cache line
R_co = TypeVar("R_co", covariant=True)


class EmptyRecord:
    """Record without content, for calls of a compiled function that requires a record as argument
    but reads no field of it.
    """

    unused: bool


_NUMBERS = (np.int8, np.uint8, np.uint16, np.int32, np.uint32, np.uint64, np.float32)
KINDS: dict[Any, Any] = {
    float: "f8",
    int: "i8",
    bool: "?",
    FloatArray: "f8",
    IntArray: "i8",
    **{number: number for number in _NUMBERS},
    # mypy takes this dictionary key for an annotation.
    **{NDArray[number]: number for number in _NUMBERS},  # type: ignore[valid-type]
}


class Records(Protocol[R_co]):
    """Type annotation for a record array that is passed to compiled code: its rows have the fields
    of the class R.
    """

    def __getitem__(self, index: int | tuple[int, int], /) -> R_co:
        """Return the row of the record array at `index` as a view (no copy)."""
        ...

    def __setitem__(self, index: int | tuple[int, int], row: object, /) -> None:
        """Copy the record `row` into the row of the record array at `index`."""
        ...


@cache
def record_type(kind: type) -> np.dtype[np.void]:
    """Return the structured NumPy type whose fields are the annotations of `kind`; fields of base
    classes come first.
    """
    names = []
    formats: list[Any] = []
    offsets = []
    end = 0
    for name, hint in get_type_hints(kind, include_extras=True).items():
        number, *sizes = get_args(hint) if get_origin(hint) is Annotated else (hint,)
        shape = tuple(int(size) for size in sizes)
        form = np.dtype((_number_type(number), (*shape, LANES) if number is LaneArray else shape))
        offsets.append(_round_up(end, _alignment(number)))
        names.append(name)
        formats.append(form)
        end = offsets[-1] + form.itemsize
    return np.dtype(
        {
            "names": names,
            "formats": formats,
            "offsets": offsets,
            "itemsize": _round_up(end, _alignment(kind)),
        },
        align=True,
    )


def _number_type(annotation: Any) -> Any:  # noqa: ANN401 a field's annotation
    if annotation is LaneArray:
        return np.dtype("f8")
    return np.dtype(KINDS[annotation]) if annotation in KINDS else record_type(annotation)


@cache
def _alignment(annotation: Any) -> int:  # noqa: ANN401 a field's annotation
    """Return the alignment [bytes] of a record's field with the type `annotation`. The field's
    offset in the record must be a multiple of this number.
    """
    if annotation is LaneArray:
        return LINE
    if annotation in KINDS:
        return int(np.dtype(KINDS[annotation]).alignment)
    hints = get_type_hints(annotation, include_extras=True).values()
    parts = (get_args(hint)[0] if get_origin(hint) is Annotated else hint for hint in hints)
    return max((_alignment(part) for part in parts), default=1)


def _round_up(value: int, step: int) -> int:
    return -(-value // step) * step


def records(kind: type, *shape: int) -> RecordArray:
    """Return an array of records of the class `kind`, all zero; it begins at a cache line if the
    records contain vectors ("lanes").
    """
    form = record_type(kind)
    if _alignment(kind) < LINE:
        return np.zeros(shape, form)
    size = math.prod(shape) * form.itemsize
    room = np.zeros(size + LINE, np.uint8)
    begin = -room.ctypes.data % LINE
    return room[begin : begin + size].view(form).reshape(shape)


def put_record(row: np.void, value: tuple[Any, ...]) -> None:
    """Copy the values of the named tuple `value` into `row`, a row of a record array. Nested tuples
    fill nested records.
    """
    for name, part in zip(row.dtype.names or (), value, strict=True):
        if isinstance(part, tuple):
            put_record(row[name], part)
        else:
            row[name] = part
