"""Scanner that finds the fields in the bytes of many protobuf batches. It is compiled and creates
no object per message.

The protobuf library remains the reference. The scanner understands only messages in the usual form,
which GripMap's encoder and ordinary protobuf encoders produce. In this form, each field occurs
once, columns are packed and of equal length, numbers are in range, and names are plain ASCII. The
scanner marks all other messages as not understood, and `batch_decoder` lets the library decode and
encode them. Source: protobuf's encoding reference (tags, varints, packed fields).
"""

from __future__ import annotations

from functools import cache
from typing import Any, Final, NamedTuple

import numpy as np
from google.protobuf.descriptor import FieldDescriptor
from numpy.typing import NDArray

from schemas import mugrid
from schemas.numeric import BoolArray, ByteArray, IntArray
from schemas.runtime.jit import refcount_free, refcount_free_locked
from schemas.wire import MAX_ROWS, MESSAGES, NEEDED, Kind, column_types

NUMBERS: Final = ("boot", "region", "seq", "first_held")
TEXTS: Final = ("vehicle", "estimator")
# bytes per element; 0 for varints
_WIDTH: Final = {
    FieldDescriptor.TYPE_SFIXED64: 8,
    FieldDescriptor.TYPE_DOUBLE: 8,
    FieldDescriptor.TYPE_FLOAT: 4,
    FieldDescriptor.TYPE_INT32: 0,
    FieldDescriptor.TYPE_BYTES: 1,
}
# protobuf wire types
_VARINT = 0
_FIXED64 = 1
_RUN = 2
_FIELDS: Final = 64  # all field numbers are below this
_UNKNOWN: Final = -1
_TEXT: Final = len(NUMBERS)  # roles of fields: first the numbers, then the texts, then the columns
_COLUMN: Final = _TEXT + len(TEXTS)


class ScannedFields(NamedTuple):
    """Fields of k messages: values, or positions in the bytes of all messages.

    Attributes:
        understood: mask (k,), True if the other attributes are valid for the message.
        numbers: values of the fields NUMBERS of each message, (k, 4).
        texts: begin and end of the fields TEXTS, (k, 2, 2).
        begins: begin of each column, (k, columns).
        counts: number of elements of each column, (k, columns); for the likelihood, of bytes.
        sizes: number of records of each message, (k,).
    """

    understood: BoolArray
    numbers: IntArray
    texts: IntArray
    begins: IntArray
    counts: IntArray
    sizes: IntArray


class _Layout(NamedTuple):
    """Fields of a kind of message, as arrays for compiled code: the role of each field number; for
    each column the width [bytes], the number of elements per record, and True if it is required.
    """

    roles: IntArray
    widths: IntArray
    per_record: IntArray
    needed: BoolArray


class _Scan(NamedTuple):
    """Input and output of a scan of messages: all bytes, the layout of the fields, True if names
    must be ASCII, and the result.
    """

    data: ByteArray
    layout: _Layout
    strict: bool
    out: ScannedFields


@cache
def _make_layout(kind: Kind) -> _Layout:
    fields = MESSAGES[kind].DESCRIPTOR.fields_by_name
    names = list(column_types(kind))
    roles = np.full(_FIELDS, _UNKNOWN)
    for role, name in enumerate((*NUMBERS, *TEXTS, *names)):
        roles[fields[name].number] = role
    return _Layout(
        roles,
        np.array([_WIDTH[fields[name].type] for name in names]),
        np.array([mugrid.BINS if name == "log_likelihood" else 1 for name in names]),
        np.array([name in NEEDED[kind] for name in names]),
    )


def walk_fields(
    kind: Kind, data: ByteArray, ends: IntArray, *, strict: bool = True
) -> ScannedFields:
    """Scan messages that are concatenated in `data`; return the positions of their fields.

    Args:
        kind: kind of the messages.
        data: bytes of all messages.
        ends: end of each message in `data`, (k,).
        strict: True to mark messages with non-ASCII names as not understood, so that the library
            checks them; False if the library itself wrote the bytes.
    """
    layout = _make_layout(kind)
    k = len(ends)
    columns = len(layout.widths)
    out = ScannedFields(
        np.zeros(k, bool),
        np.zeros((k, len(NUMBERS)), np.int64),
        np.zeros((k, len(TEXTS), 2), np.int64),
        np.zeros((k, columns), np.int64),
        np.zeros((k, columns), np.int64),
        np.zeros(k, np.int64),
    )
    first = list(column_types(kind)).index(NEEDED[kind][0])
    _scan_fields(_Scan(data, layout, strict, out), ends, first)
    return out


def gather_values(
    data: ByteArray, walked: ScannedFields, column: int, kind: Kind, into: NDArray[Any]
) -> None:
    """Copy the values of one column from all messages into the array `into` (n, …). Where a message
    lacks the column, the values of `into` stay unchanged.
    """
    width = int(_make_layout(kind).widths[column])
    each = int(_make_layout(kind).per_record[column])
    begins = walked.begins[:, column].copy()
    counts = walked.counts[:, column].copy()
    if width:
        _copy_bytes(
            data,
            begins,
            counts * width,
            walked.sizes * (each * width),
            into.reshape(-1).view(np.uint8),
        )
    else:
        _unpack_values(data, begins, counts, walked.sizes, into)


@refcount_free
def _read_varint(data: ByteArray, at: int, end: int) -> tuple[int, int]:
    """Return a variable-length integer and the position after it. The position is -1 if the bytes
    are not an integer of at most 64 bits.
    """
    value = 0
    shift = 0
    while at < end and shift < 64:
        byte = int(data[at])
        at += 1
        if shift == 63 and byte > 1:
            return 0, -1
        value |= (byte & 127) << shift
        if byte < 128:
            return value, at
        shift += 7
    return 0, -1


@refcount_free
def _scan_fields(scan: _Scan, ends: IntArray, first: int) -> None:
    """Find the protobuf fields of all messages, and store where they lie in the result `scan.out`.
    Message k ends at byte `ends[k]` of the data. `first` is the column whose length gives the
    number of records of a message.
    """
    data = scan.data
    layout = scan.layout
    out = scan.out
    at = 0
    for k in range(len(ends)):
        end = ends[k]
        seen = 0
        fine = True
        while fine and at < end:
            tag, at = _read_varint(data, at, min(end, at + 2))
            number = tag >> 3
            wire = tag & 7
            fine = (
                at >= 0
                and 0 < number < _FIELDS
                and layout.roles[number] != _UNKNOWN
                and not (seen >> number) & 1
            )
            if fine:
                seen |= 1 << number
                at = _scan_field(scan, k, at, end, layout.roles[number], wire)
                fine = at >= 0
        n = out.counts[k, first]
        fine = fine and 1 <= n <= MAX_ROWS
        for column in range(len(layout.widths)):
            count = out.counts[k, column]
            fine = fine and (
                count == n * layout.per_record[column] or (count == 0 and not layout.needed[column])
            )
        out.understood[k] = fine
        out.sizes[k] = n
        at = end


@refcount_free
def _scan_field(scan: _Scan, k: int, at: int, end: int, role: int, wire: int) -> int:
    """Record the position of one protobuf field of message `k` in `scan.out`; return the position
    of the byte after it, or -1 if the field does not have the form that our encoder writes.
    """
    data = scan.data
    out = scan.out
    if role == 0:  # `boot`, the only number with a fixed length
        if wire != _FIXED64 or end - at < 8:
            return -1
        value = 0
        for position in range(8):
            value |= int(data[at + position]) << (8 * position)
        out.numbers[k, role] = value
        return at + 8
    if role < _TEXT:
        out.numbers[k, role], at = _read_varint(data, at, end)
        return at if wire == _VARINT else -1
    length, at = _read_varint(data, at, end)
    if wire != _RUN or at < 0 or not 0 <= length <= end - at:
        return -1
    if role < _COLUMN:
        out.texts[k, role - _TEXT, 0] = at
        out.texts[k, role - _TEXT, 1] = at + length
        for position in range(at, at + length):
            if scan.strict and data[position] >= 128:
                return -1
        return at + length
    column = role - _COLUMN
    width = scan.layout.widths[column]
    count = 0
    if width > 0:
        count = length // width
        if count * width != length:
            return -1
    else:
        position = at
        while position < at + length:
            value, position = _read_varint(data, position, at + length)
            if position < 0 or not -(1 << 31) <= value < 1 << 31:
                return -1
            count += 1
    out.begins[k, column] = at
    out.counts[k, column] = count
    return at + length


@refcount_free_locked
def _copy_bytes(
    data: ByteArray, begins: IntArray, lengths: IntArray, lengths_out: IntArray, into: ByteArray
) -> None:
    to = 0
    for k in range(len(begins)):
        sent = data[begins[k] : begins[k] + lengths[k]]
        written = into[to : to + lengths[k]]
        # Indexing slices instead of `data` lets the compiler copy many bytes at once.
        for position in range(len(written)):
            written[position] = sent[position]
        to += lengths_out[k]


@refcount_free_locked
def _unpack_values(
    data: ByteArray, begins: IntArray, counts: IntArray, sizes: IntArray, into: IntArray
) -> None:
    to = 0
    for k in range(len(begins)):
        at = begins[k]
        for position in range(counts[k]):
            into[to + position], at = _read_varint(data, at, len(data))
        to += sizes[k]
