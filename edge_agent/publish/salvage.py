"""Recovery of rows from a damaged SQLite file. Pages are read one by one, without the b-tree. The
module is pure: bytes in, rows out.

Source: "Database File Format" of sqlite.org, sections 1.6 (b-tree pages), 2.1 (records) and 4.1
(write-ahead log). A recovered row may be incomplete, deleted or older than another copy. Therefore
the caller must verify it; batches have a checksum for this purpose.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import Final

PAGE: Final = 4096  # [byte] default page size of SQLite
_LEAF: Final = 0x0D  # type byte of a page with rows of a table
_HEADER: Final = 100  # [byte] file header before the cells of the first page
_WAL_HEADER: Final = 32
_FRAME: Final = 24
# Maximum and minimum number of bytes of a row within its page; the rest is on overflow pages.
_MOST_LOCAL: Final = PAGE - 35
_LEAST_LOCAL: Final = (PAGE - 12) * 32 // 255 - 23
_INTEGERS: Final = {1: 1, 2: 2, 3: 3, 4: 4, 5: 6, 6: 8}  # serial type -> size of an integer [byte]
_LARGEST: Final = 1 << 20  # [byte] largest accepted row; a batch has less than a tenth of it

Value = int | str | bytes | None


def recover_rows(database: bytes, log: bytes) -> Iterator[tuple[int, list[Value]]]:
    """Yield (row id, column values) of every intact cell (stored row) of a damaged SQLite file.
    `database` is the content of the file and `log` that of its write-ahead log. The cells of the
    log come first, newest page first.
    """
    pages = {at // PAGE + 1: database[at : at + PAGE] for at in range(0, len(database), PAGE)}
    newer = [
        (int.from_bytes(log[at : at + 4], "big"), log[at + _FRAME : at + _FRAME + PAGE])
        for at in range(_WAL_HEADER, len(log) - _FRAME, _FRAME + PAGE)
    ]
    current = pages | dict(newer)
    for number, page in [*reversed(newer), *pages.items()]:
        yield from _leaf_cells(number, page, current)


def _leaf_cells(
    number: int, page: bytes, pages: dict[int, bytes]
) -> Iterator[tuple[int, list[Value]]]:
    begin = _HEADER if number == 1 else 0
    if len(page) < PAGE or page[begin] != _LEAF:
        return
    count = min(int.from_bytes(page[begin + 3 : begin + 5], "big"), PAGE // 4)
    for place in range(count):
        at = int.from_bytes(page[begin + 8 + 2 * place : begin + 10 + 2 * place], "big")
        try:
            yield _read_cell(page, at, pages)
        except (IndexError, KeyError, ValueError):  # incomplete row; includes UnicodeDecodeError
            continue


def _read_cell(page: bytes, at: int, pages: dict[int, bytes]) -> tuple[int, list[Value]]:
    size, at = _read_varint(page, at)
    key, at = _read_varint(page, at)
    if size > _LARGEST:
        raise ValueError("no row is so large")
    local = size
    if size > _MOST_LOCAL:
        surplus = _LEAST_LOCAL + (size - _LEAST_LOCAL) % (PAGE - 4)
        local = surplus if surplus <= _MOST_LOCAL else _LEAST_LOCAL
    record = page[at : at + local]
    following = int.from_bytes(page[at + local : at + local + 4], "big") if local < size else 0
    while len(record) < size:
        overflow_page = pages[following]
        following = int.from_bytes(overflow_page[:4], "big")
        record = record + overflow_page[4:]
    return key, _read_record(record[:size])


def _read_record(record: bytes) -> list[Value]:
    end, at = _read_varint(record, 0)
    types = []
    values = []
    while at < end:
        kind, at = _read_varint(record, at)
        types.append(kind)
    for kind in types:
        value, at = _read_value(record, at, kind)
        values.append(value)
    return values


def _read_value(record: bytes, at: int, kind: int) -> tuple[Value, int]:
    if kind == 0:
        return None, at
    if kind in (8, 9):
        return kind - 8, at
    size = _INTEGERS.get(kind, (kind - 12) // 2)
    part = record[at : at + size]
    if size < 0 or len(part) < size or kind == 7:
        raise ValueError("no value")
    if kind in _INTEGERS:
        return int.from_bytes(part, "big", signed=True), at + size
    return (part.decode() if kind % 2 else part), at + size


def _read_varint(data: bytes, at: int) -> tuple[int, int]:
    value = 0
    for place in range(9):
        byte = data[at]
        at += 1
        if place == 8:
            return (value << 8) | byte, at
        value = (value << 7) | (byte & 0x7F)
        if byte < 0x80:
            break
    return value, at
