"""Open-addressing hash tables: arrays of row numbers whose keys lie in the rows themselves, so that a place costs four
bytes. Compiled; at least one place must be free."""

from __future__ import annotations

from typing import Final

import numpy as np

from fleet_service.fusion.belief import PackedArray
from fleet_service.fusion.cells import NONE, Int32Array, Records, begin
from schemas.numeric import IntArray, compiled, lean

LEAST: Final = 1024  # places of a new table; a power of two, so that a mask finds the place


@lean
def _mixed(key: int | np.int64) -> np.uint64:
    """Every bit of the key moves the place: mixing steps of the splitmix64 generator."""
    h = np.uint64(key)
    h = (h ^ (h >> np.uint64(30))) * np.uint64(0xBF58476D1CE4E5B9)
    h = (h ^ (h >> np.uint64(27))) * np.uint64(0x94D049BB133111EB)
    return h ^ (h >> np.uint64(31))


@lean
def locate(table: Int32Array, rows: Records, key: int) -> int:
    """Place of the row with `key`, or the free place where it belongs."""
    mask = len(table) - 1
    place = np.int64(_mixed(key) & np.uint64(mask))
    while table[place] != NONE and rows[table[place]].key != key:
        place = (place + 1) & mask
    return int(place)


@compiled
def rows_of(table: Int32Array, rows: Records, wanted: IntArray) -> IntArray:
    """Row of each key, (n,); NONE where it is unknown."""
    out = np.empty(len(wanted), np.int64)
    for i in range(len(wanted)):
        out[i] = table[locate(table, rows, wanted[i])]
    return out


@compiled
def slots_for(
    table: Int32Array, belief: PackedArray, cells: Records, wanted: IntArray, used: int
) -> tuple[IntArray, int]:  # fmt: skip
    """Slot of each key, (n,), and how many are used then; an unknown key begins the next. Room must be there."""
    out = np.empty(len(wanted), np.int64)
    for i in range(len(wanted)):
        place = locate(table, cells, wanted[i])
        if table[place] == NONE:
            table[place] = used
            begin(belief, cells, used, wanted[i])
            used += 1
        out[i] = table[place]
    return out, used


@compiled
def numbered(table: Int32Array, rows: Records, wanted: IntArray, used: int) -> tuple[IntArray, int]:
    """Row of each key, (n,), and how many are used then; an unknown key is written to the next of `rows`."""
    out = np.empty(len(wanted), np.int64)
    for i in range(len(wanted)):
        place = locate(table, rows, wanted[i])
        if table[place] == NONE:
            table[place] = used
            rows[used].key = wanted[i]
            used += 1
        out[i] = table[place]
    return out, used


@compiled
def fill(table: Int32Array, rows: Records, used: int) -> None:
    """Enter the first `used` rows into an empty table."""
    for row in range(used):
        table[locate(table, rows, rows[row].key)] = row


@lean
def pair_place(pairs: Records, slot: int, vehicle: int) -> int:
    """Place of a pair in a table that holds the pairs themselves, or the free place (slot NONE) where it belongs."""
    mask = len(pairs) - 1
    key = (np.int64(slot) << np.int64(32)) | np.int64(vehicle)
    place = np.int64(_mixed(key) & np.uint64(mask))
    while pairs[place].slot != NONE and (pairs[place].slot != slot or pairs[place].vehicle != vehicle):
        place = (place + 1) & mask
    return int(place)


def grown(rows: Records, used: int, places: int) -> Int32Array:
    """A table of `places` with the first `used` rows."""
    table = np.full(places, NONE, np.int32)
    fill(table, rows, used)
    return table


def room(entries: int) -> int:
    """Places for so many entries at two thirds of the load at the most: two or three probes."""
    return max(LEAST, 1 << (3 * entries // 2).bit_length())
