"""Store of the earlier reports of a pair, which is one vehicle in one cell. Recent reports form a
linked list, because a late one may still come between them. One record sums up the older reports.
"""

from __future__ import annotations

from typing import Final

import numpy as np

from fleet_service.fusion import constants as c
from fleet_service.fusion.belief import BOUND, VALUE
from fleet_service.fusion.store.records import NONE, PAIRS, State
from fleet_service.fusion.store.table import AHEAD, pair_place
from schemas.numeric import IntArray
from schemas.runtime.jit import compiled, refcount_free_inlined
from schemas.runtime.prefetch import prefetch
from schemas.runtime.records import RecordArray
from schemas.thresholds import NS

_VALUES_S: Final = int(c.FORGOTTEN_S)
_BOUNDS_S: Final = int(c.VOTE_RENEWAL_S)
_FIBONACCI = np.uint64(0x9E3779B97F4A7C15)  # 2⁶⁴ over the golden ratio: its multiples lie far apart


@refcount_free_inlined
def comes_before(entries: RecordArray, a: int, b: int) -> bool:
    """Return True if observation `a` comes before observation `b` in the order in which they change
    the belief: by time, then by vehicle, start of the vehicle, and sequence number. Both are row
    numbers of `entries`.
    """
    if entries[a].time != entries[b].time:
        return bool(entries[a].time < entries[b].time)
    if entries[a].number != entries[b].number:
        return bool(entries[a].number < entries[b].number)
    if entries[a].boot != entries[b].boot:
        return bool(entries[a].boot < entries[b].boot)
    return bool(entries[a].sequence < entries[b].sequence)


@refcount_free_inlined
def pair_of(pairs: RecordArray, used: IntArray, slot: int, vehicle: int) -> int:
    """Return the row of the pair of `slot` (cell and sector) and `vehicle`; create the pair (record
    of a vehicle in a cell) if it does not exist.
    """
    pair = pair_place(pairs, slot, vehicle)
    if pairs[pair].slot == NONE:
        pairs[pair].slot = slot
        pairs[pair].vehicle = vehicle
        pairs[pair].last = NONE
        pairs[pair].waiting = 0
        pairs[pair].time[0] = 0
        pairs[pair].time[1] = 0
        used[PAIRS] += 1
    return pair


@refcount_free_inlined
def link_pair(entries: RecordArray, pairs: RecordArray, pair: int, entry: int) -> None:
    """Insert an observation (row `entry` of `entries`), in order of time, into the linked list of
    its vehicle's recent observations in the cell.
    """
    pairs[pair].waiting += 1
    entries[entry].pair = pair
    before = int(pairs[pair].last)
    after = NONE
    while before != NONE and comes_before(entries, entry, before):
        before, after = int(entries[before].before), before
    entries[entry].before = before
    entries[entry].after = after
    if before != NONE:
        entries[before].after = entry
    if after == NONE:
        pairs[pair].last = entry
    else:
        entries[after].before = entry


@refcount_free_inlined
def commit_pair(entries: RecordArray, pairs: RecordArray, entry: int) -> None:
    """Add an observation (row `entry` of `entries`) to the record of its vehicle's older reports in
    the cell, and unlink it from the vehicle's later observations.
    """
    pair = int(entries[entry].pair)
    kind = int(entries[entry].kind)
    pairs[pair].time[kind] = entries[entry].time // NS
    pairs[pair].mean[kind] = entries[entry].last_mean
    pairs[pair].spent[kind] = entries[entry].spent
    if kind == VALUE:
        pairs[pair].std = entries[entry].last_std
    pairs[pair].waiting -= 1
    if entries[entry].after == NONE:
        pairs[pair].last = NONE
    else:
        entries[entries[entry].after].before = NONE


@refcount_free_inlined
def oldest_remembered(now: int, kind: int) -> int:
    """Return the time [s] of the oldest report of a kind (BOUND or VALUE) that is still remembered
    at `now` [s]. Older reports have no effect, whether or not their record is already deleted.
    """
    return int(now - now % c.FORGOTTEN_EVERY_S - (_VALUES_S if kind == VALUE else _BOUNDS_S))


@refcount_free_inlined
def _must_stay(pairs: RecordArray, place: int, now: int) -> bool:
    """Return True if the record of a vehicle and cell must stay: the vehicle has reported there so
    lately that the report is remembered at `now` [s], or has observations there that are younger
    than the checkpoint (the time before which observations are final).
    """
    pair = pairs[place]
    return bool(
        pair.last != NONE
        or pair.time[BOUND] >= oldest_remembered(now, BOUND)
        or pair.time[VALUE] >= oldest_remembered(now, VALUE)
    )


@compiled
def count_staying(pairs: RecordArray, now: int) -> int:
    """Return the number of records of a vehicle in a cell that must stay in memory, see
    `_must_stay`.
    """
    count = 0
    for place in range(len(pairs)):
        count += pairs[place].slot != NONE and _must_stay(pairs, place, now)
    return count


@compiled
def move_pairs(entries: RecordArray, old: RecordArray, new: RecordArray, now: int) -> IntArray:
    """Move the records of a vehicle in a cell that must stay (see `_must_stay`) to another table.
    Return the row numbers of the other pairs in the old table, one array.
    """
    dropped = np.empty(len(old), np.int64)
    count = 0
    for begin in range(0, len(old), AHEAD):
        end = min(begin + AHEAD, len(old))
        for place in range(begin, end):
            if old[place].slot != NONE and old[place].last != NONE:
                prefetch(entries, old[place].last, 0)
        for place in range(begin, end):
            if old[place].slot == NONE:
                continue
            if not _must_stay(old, place, now):
                dropped[count] = place
                count += 1
                continue
            to = pair_place(new, old[place].slot, old[place].vehicle)
            new[to] = old[place]
            entry = int(old[place].last)
            while entry != NONE:
                entries[entry].pair = to
                entry = int(entries[entry].before)
    return dropped[:count]


@refcount_free_inlined
def returning_bit(number: int) -> np.uint64:
    """Return the bit that represents a vehicle in `Cells.returned`; several vehicles share a
    bit.
    """
    return np.uint64(1) << ((np.uint64(number) * _FIBONACCI) >> np.uint64(58))


@compiled
def mark_returned(state: State, slots: IntArray, numbers: IntArray) -> None:
    """Record in each cell (slots (k,)) that a vehicle (numbers (k,)) has visited it. This is done
    before the vehicle's reports there are deleted, so that a later report does not count it as a
    new vehicle.
    """
    for k in range(len(slots)):
        slot = slots[k]
        bit = returning_bit(numbers[k])
        state.live.cells[slot].returned |= bit
        window = state.live.cells[slot].window
        if window != NONE:
            state.base.cells[window].returned |= bit
