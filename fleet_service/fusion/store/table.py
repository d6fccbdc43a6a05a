"""Open-addressing hash tables: arrays of row numbers; the keys are stored in the rows themselves.
Compiled. At least one place (array item) of a table must be free.

A place contains the row number in its lower half and a part of the key's hash in its upper half.
Comparing the hash parts first avoids nearly all reads of rows with another key, each of which would
wait for memory.

The first place for a key is proportional to its hash. Therefore a table may have any length. A
longer copy of a table contains the rows in the same order, so that the copy can be filled from one
end to the other.

A slot is the storage of one cell and heading sector. A pair is one slot and one vehicle; a pair
record sums up the vehicle's reports there. Pair records are stored in the places of their hash
table themselves, so that no row number is needed.
"""

from __future__ import annotations

from typing import Final

import numpy as np

from fleet_service.fusion.store.cells import begin_slot
from fleet_service.fusion.store.records import NONE, Rows
from schemas.numeric import IntArray
from schemas.runtime.jit import refcount_free_inlined, refcount_free_locked
from schemas.runtime.prefetch import prefetch
from schemas.runtime.records import RecordArray

LEAST: Final = 1024  # number of places of a new table
# Largest share of a table's places that may be in use, so that a search reads two or three places.
PLACES_MOST: Final = 0.7
# Bits of a place: the lower half, and the non-negative numbers that fit into the upper half.
_LOWER: Final = np.iinfo(np.uint32).max
_TAG: Final = np.iinfo(np.int32).max
# Number of rows by which a prefetch is ahead of the work on a row, so that memory accesses overlap
# with this work.
AHEAD: Final = 16


@refcount_free_inlined
def _hash_key(key: int | np.int64) -> np.uint64:
    """Return the hash of a key, computed with the mixing steps of the splitmix64 generator, so that
    every bit of the key affects every bit of the hash.
    """
    h = np.uint64(key)
    h = (h ^ (h >> np.uint64(30))) * np.uint64(0xBF58476D1CE4E5B9)
    h = (h ^ (h >> np.uint64(27))) * np.uint64(0x94D049BB133111EB)
    return h ^ (h >> np.uint64(31))


@refcount_free_inlined
def _first_place(mixed: np.uint64, places: int) -> int:
    """Return the place (index) of a hash table with `places` places at which the search for a key
    begins; `mixed` is the key's hash.
    """
    return int(np.int64(((mixed >> np.uint64(32)) * np.uint64(places)) >> np.uint64(32)))


@refcount_free_inlined
def _row_at(held: int) -> int:
    """Return the row number in `held`, the content of a place of a hash table; NONE if the place is
    free.
    """
    return int(np.int32(held & _LOWER))


@refcount_free_inlined
def _place_content(mixed: np.uint64, row: int) -> int:
    """Return the integer that represents a key and its row in a hash table: the row number, and a
    part of the key's hash `mixed`. It never equals NONE, which marks a free place.
    """
    return int((np.int64(mixed & np.uint64(_TAG)) << 32) | row)


@refcount_free_inlined
def locate_key(table: IntArray, rows: RecordArray, key: int) -> int:
    """Return the place (index) of a hash table that refers to the row with `key`; if there is no
    such row, the free place where it belongs.
    """
    mixed = _hash_key(key)
    place = _first_place(mixed, len(table))
    tag = np.int64(mixed & np.uint64(_TAG))
    while table[place] != NONE and (
        (table[place] >> 32) != tag or rows[_row_at(table[place])].key != key
    ):
        place = place + 1 if place + 1 < len(table) else 0
    return place


@refcount_free_inlined
def find_row(table: IntArray, rows: RecordArray, key: int) -> int:
    """Return the row of `rows` with a given key, found by the hash table `table`; NONE if the key
    is unknown.
    """
    return _row_at(table[locate_key(table, rows, key)])


def rows_of(table: IntArray, rows: RecordArray, keys: IntArray) -> IntArray:
    """Return, for each of the `keys` (n,), the row of `rows` with this key, found by the hash
    table `table`; NONE if the key is unknown.
    """
    out = np.empty(len(keys), np.int64)
    _find_rows(table, rows, keys, out)
    return out


@refcount_free_locked
def _find_rows(table: IntArray, rows: RecordArray, keys: IntArray, out: IntArray) -> None:
    for step in range(len(keys) + 2 * AHEAD):
        if step < len(keys):
            out[step] = _first_place(_hash_key(keys[step]), len(table))
            prefetch(table, out[step], 0)
        if 0 <= step - AHEAD < len(keys):
            prefetch(rows, _row_at(table[out[step - AHEAD]]), 0)
        if step >= 2 * AHEAD:
            out[step - 2 * AHEAD] = find_row(table, rows, keys[step - 2 * AHEAD])


@refcount_free_locked
def slots_for(table: IntArray, live: Rows, keys: IntArray, used: int, out: IntArray) -> int:
    """Write the slot of each of the `keys` (n,), cell · 4 + sector, to `out` (n,). An
    unknown key gets the next free slot; the table must have room for it. `used` is the number of
    slots in use before the call; return the number afterwards.
    """
    for i in range(len(keys)):
        place = locate_key(table, live.cells, keys[i])
        if table[place] == NONE:
            table[place] = _place_content(_hash_key(keys[i]), used)
            begin_slot(live, used, keys[i])
            used += 1
        out[i] = _row_at(table[place])
    return used


@refcount_free_locked
def assign_rows(
    table: IntArray, rows: RecordArray, keys: IntArray, used: int, out: IntArray
) -> int:
    """Write the row of each of the `keys` (n,) to `out` (n,). An unknown key is written to
    the next free row. `used` is the number of rows in use before the call; return the number
    afterwards.
    """
    for i in range(len(keys)):
        place = locate_key(table, rows, keys[i])
        if table[place] == NONE:
            table[place] = _place_content(_hash_key(keys[i]), used)
            rows[used].key = keys[i]
            used += 1
        out[i] = _row_at(table[place])
    return used


@refcount_free_locked
def fill_table(table: IntArray, rows: RecordArray, used: int) -> None:
    """Enter the row numbers from 0 to `used` - 1 into the empty hash table `table`, at the places
    that the keys of these rows determine.
    """
    for row in range(used):
        table[locate_key(table, rows, rows[row].key)] = _place_content(
            _hash_key(rows[row].key), row
        )


@refcount_free_inlined
def first_place(pairs: RecordArray, slot: int, vehicle: int) -> int:
    """Return the place (index) of the hash table `pairs` at which the search for a pair (slot and
    vehicle) begins.
    """
    return _first_place(_hash_key((np.int64(slot) << np.int64(32)) | np.int64(vehicle)), len(pairs))


@refcount_free_inlined
def pair_place(pairs: RecordArray, slot: int, vehicle: int) -> int:
    """Return the place (index) of the record of a pair (slot and vehicle) in the hash table
    `pairs`. If there is no such record, return the free place where it belongs; its field `slot` is
    NONE.
    """
    place = first_place(pairs, slot, vehicle)
    while pairs[place].slot != NONE and (
        pairs[place].slot != slot or pairs[place].vehicle != vehicle
    ):
        place = place + 1 if place + 1 < len(pairs) else 0
    return place


def table_of(rows: RecordArray, used: int, entries: int) -> IntArray:
    """Return a hash table (one array of row numbers) that has room for `entries` row numbers and
    contains the first `used` rows.
    """
    table = np.full(places_for(entries), NONE, np.int64)
    fill_table(table, rows, used)
    return table


def places_for(entries: int) -> int:
    """Return the length (number of places) of a hash table for `entries` entries. Even with 25 %
    more entries, at most the share PLACES_MOST of the places is in use. Reason: most entries are
    kept for an hour, but old ones are deleted only every quarter of an hour.
    """
    return max(LEAST, int(1.25 * entries / PLACES_MOST))


def is_full(entries: int, places: int) -> bool:
    """Return True if the number of row numbers in a hash table exceeds the share PLACES_MOST of
    its places.
    """
    return entries > PLACES_MOST * places
