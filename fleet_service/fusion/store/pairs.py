"""Memory of the reports that one vehicle made in one cell. This combination of vehicle and cell is
called a pair. A pair is active while the vehicle has reported in the cell recently; the module
`settled` stores the reports of all other pairs.

Recent reports of an active pair form a linked list in order of time, because a late report may
still be inserted. One record (`PairRecord`) summarises the older reports.
"""

from __future__ import annotations

from fleet_service.fusion.belief import ReportKind
from fleet_service.fusion.store.records import NONE, PAIRS, State
from fleet_service.fusion.store.settled import activate_reports
from fleet_service.fusion.store.table import AHEAD, pair_place
from schemas.runtime.jit import refcount_free_inlined, refcount_free_locked
from schemas.runtime.prefetch import prefetch
from schemas.runtime.records import RecordArray
from schemas.thresholds import NS


@refcount_free_inlined
def comes_before(entries: RecordArray, a: int, b: int) -> bool:
    """Return True if observation `a` changes the belief before observation `b`. The order is by
    time, then by number of the vehicle, random number of its agent's start, and sequence number.
    `a` and `b` are row numbers of `entries`.
    """
    if entries[a].time != entries[b].time:
        return bool(entries[a].time < entries[b].time)
    if entries[a].number != entries[b].number:
        return bool(entries[a].number < entries[b].number)
    if entries[a].boot != entries[b].boot:
        return bool(entries[a].boot < entries[b].boot)
    return bool(entries[a].sequence < entries[b].sequence)


@refcount_free_inlined
def pair_of(state: State, slot: int, vehicle: int) -> int:
    """Return the row number of the record of a vehicle in a slot (cell and heading sector) in the
    table of active pairs. If there is no such record, create one and copy the vehicle's settled
    (earlier) reports in this slot into it.
    """
    pairs = state.pairs
    pair = pair_place(pairs, slot, vehicle)
    if pairs[pair].slot == NONE:
        pairs[pair].slot = slot
        pairs[pair].vehicle = vehicle
        pairs[pair].last = NONE
        pairs[pair].waiting = 0
        pairs[pair].time[0] = 0
        pairs[pair].time[1] = 0
        state.used[PAIRS] += 1
        activate_reports(state, pair)
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
    if kind == ReportKind.VALUE:
        pairs[pair].std = entries[entry].last_std
    pairs[pair].waiting -= 1
    if entries[entry].after == NONE:
        pairs[pair].last = NONE
    else:
        entries[entries[entry].after].before = NONE


@refcount_free_locked
def move_pairs(entries: RecordArray, old: RecordArray, new: RecordArray) -> None:
    """Move the records of active pairs (one vehicle in one slot each) from the hash table `old` to
    the hash table `new`.
    """
    for step in range(len(old) + AHEAD):
        if step < len(old) and old[step].slot != NONE:
            prefetch(entries, old[step].last, 0)
        place = step - AHEAD
        if place < 0 or old[place].slot == NONE:
            continue
        to = pair_place(new, old[place].slot, old[place].vehicle)
        new[to] = old[place]
        entry = int(old[place].last)
        while entry != NONE:
            entries[entry].pair = to
            entry = int(entries[entry].before)
