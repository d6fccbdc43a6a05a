"""Compact storage for the reports of vehicles that have not returned to a cell recently. A pair is
one vehicle in one slot (cell and heading sector). A pair can be settled (moved to this storage)
once all its reports are final, so that no late report can change their order.

The last report of each kind (value or lower bound) is stored in sorted arrays without free rows. If
the vehicle reports in the slot again, its reports are copied back to the table of active pairs
(`pairs.pair_of`). The functions are compiled.
"""

from __future__ import annotations

from typing import Any, Final, NamedTuple

import numpy as np

from fleet_service.fusion import constants
from fleet_service.fusion.belief import ReportKind
from fleet_service.fusion.store.records import (
    NONE,
    PAIR,
    PAIRS,
    SETTLED_SINCE,
    SETTLED_VEHICLES,
    Int32Array,
    State,
)
from fleet_service.fusion.store.table import AHEAD, first_place
from schemas.numeric import IntArray
from schemas.runtime.jit import refcount_free_inlined, refcount_free_locked
from schemas.runtime.prefetch import prefetch
from schemas.runtime.records import RecordArray

_VALUES_S: Final = int(constants.FORGOTTEN_S)
_BOUNDS_S: Final = int(constants.VOTE_RENEWAL_S)
# 2⁶⁴ divided by the golden ratio: the multiples of this number are far apart (Fibonacci hashing).
_FIBONACCI = np.uint64(0x9E3779B97F4A7C15)
# flag of a key: the pair is active again, so the report is not valid
_MOVED: Final = np.uint32(1)


@refcount_free_inlined
def oldest_remembered(now: int, kind: int) -> int:
    """Return the time [s] of the oldest report of a kind (BOUND or VALUE) that is still remembered
    at `now` [s]. Older reports have no effect, whether or not their record is already deleted.
    """
    return int(
        now
        - now % constants.FORGOTTEN_EVERY_S
        - (_VALUES_S if kind == ReportKind.VALUE else _BOUNDS_S)
    )


@refcount_free_inlined
def _to_int(number: np.unsignedinteger[Any]) -> int:
    """Convert an unsigned number to a signed one, because Numba would otherwise compute with signed
    and unsigned numbers together in floating point.
    """
    return int(np.int64(number))


@refcount_free_inlined
def _make_key(vehicle: int, kind: int) -> np.uint32:
    """Return the sort key of a vehicle's report in `State.settled_keys`: 4·vehicle + 2·kind.
    `vehicle` is the index of the vehicle, and `kind` is BOUND or VALUE.

    The lowest bit, the flag _MOVED, is 0 here. It is set later if the vehicle reports in the cell
    again. The report is then copied to `State.pairs`, and the stored one is invalid.
    """
    return np.uint32(4 * vehicle + 2 * kind)


@refcount_free_inlined
def _full_time(stored: np.uint16, since: int) -> int:
    """Return the full time [s] of a report of which `SettledRecord.time` stores only the last 16
    bits. `since` [s] is at most 18 h before this time (`State.used[SETTLED_SINCE]`).
    """
    return int(since + ((_to_int(stored) - since) & 0xFFFF))


@refcount_free_inlined
def guess_row(state: State, slot: int, vehicle: int) -> int:
    """Return the row of `State.settled` at which the reports of a vehicle in a slot probably begin,
    if there are any. Rows are sorted by the vehicle's index, which is below
    `used[SETTLED_VEHICLES]`.
    """
    begin = _to_int(state.settled_begin[slot, 0])
    rows = _to_int(state.settled_begin[slot + 1, 0]) - begin
    share = np.float32(vehicle) / np.float32(max(state.used[SETTLED_VEHICLES], 1))
    return begin + min(int(np.float32(rows) * share), rows - 1)


@refcount_free_inlined
def _find_first(state: State, slot: int, vehicle: int) -> int:
    """Return the first row of a slot in `State.settled` with reports of a vehicle. If there is
    none, return the first row of a vehicle with a higher index. The search begins at the probable
    row and doubles its steps, so that it reads few cache lines.
    """
    keys = state.settled_keys
    begin = _to_int(state.settled_begin[slot, 0])
    end = _to_int(state.settled_begin[slot + 1, 0])
    key = _make_key(vehicle, ReportKind.BOUND)
    low = begin
    high = end
    step = 4
    row = guess_row(state, slot, vehicle)
    if begin < end and keys[row] < key:
        while row < end and keys[row] < key:
            low = row + 1
            row += step
            step *= 2
        high = min(row, end)
    else:
        while row >= begin and keys[row] >= key:
            high = row
            row -= step
            step *= 2
        low = max(row + 1, begin)
    while low < high:
        middle = (low + high) >> 1
        if keys[middle] < key:
            low = middle + 1
        else:
            high = middle
    return low


@refcount_free_inlined
def activate_reports(state: State, pair: int) -> None:
    """Copy a vehicle's last bound and last value of friction in a cell from the array
    `State.settled` to row `pair` of `State.pairs`. The caller has just added this row, because the
    vehicle reports there again. The records in `State.settled` are marked as invalid. Do nothing if
    there is none for this vehicle and cell.
    """
    this = state.pairs[pair]
    slot = int(this.slot)
    if slot >= len(state.settled_begin) - 1:
        return
    keys = state.settled_keys
    end = _to_int(state.settled_begin[slot + 1, 0])
    row = _find_first(state, slot, this.vehicle)
    while row < end and _to_int(keys[row] >> 2) == this.vehicle:
        kind = _to_int(keys[row] >> 1) & 1
        this.time[kind] = _full_time(state.settled[row].time, state.used[SETTLED_SINCE])
        this.mean[kind] = state.settled[row].mean
        this.spent[kind] = state.settled[row].spent
        if kind == ReportKind.VALUE:
            value = _to_int(state.settled_begin[slot, 1])
            for other in range(_to_int(state.settled_begin[slot, 0]), row):
                value += _to_int(keys[other] >> 1) & 1
            this.std = state.settled_std[value]
        keys[row] |= _MOVED
        row += 1


@refcount_free_inlined
def _move_report(state: State, row: int, to: int, value: int, to_value: int) -> int:
    """Move a report within the arrays of settled reports (`State.settled`, `settled_keys`) from row
    `row` to row `to`. If it is a value, also move its standard deviation in `State.settled_std`
    from row `value` to row `to_value`. Return 1 for a value, else 0.
    """
    state.settled_keys[to] = state.settled_keys[row]
    state.settled[to] = state.settled[row]
    is_value = _to_int(state.settled_keys[to] >> 1) & 1
    if is_value:
        state.settled_std[to_value] = state.settled_std[value]
    return is_value


def drop_reports(state: State, names: RecordArray, now: int) -> tuple[int, int]:
    """Delete two groups of reports from `State.settled`: reports that are too old to be remembered
    at `now` [s], and reports of vehicles that report in the same cell again. The remaining reports
    move to the beginning of the arrays. Return the number of remaining reports, and the number of
    friction values among them. `names` are the records of the vehicles.
    """
    reports = _drop_reports(state, names, now)
    return reports, int(state.settled_begin[-1, 1])


@refcount_free_locked
def _drop_reports(state: State, names: RecordArray, now: int) -> int:
    begins = state.settled_begin
    keys = state.settled_keys
    since = state.used[SETTLED_SINCE]
    reports = 0
    values = 0
    value = 0
    begin = 0
    for slot in range(len(begins) - 1):
        end = _to_int(begins[slot + 1, 0])
        begins[slot, 0] = reports
        begins[slot, 1] = values
        staying = NONE
        for row in range(begin, end):
            kind = _to_int(keys[row] >> 1) & 1
            vehicle = _to_int(keys[row] >> 2)
            value += kind
            if keys[row] & _MOVED:
                continue
            if _full_time(state.settled[row].time, since) >= oldest_remembered(now, kind):
                staying = vehicle
                values += _move_report(state, row, reports, value - 1, values)
                reports += 1
            elif staying != vehicle and (row + 1 == end or _to_int(keys[row + 1] >> 2) != vehicle):
                _mark_returned(state, slot, names[vehicle].key)
        begin = end
    begins[-1, 0] = reports
    begins[-1, 1] = values
    return reports


class SettlingPairs(NamedTuple):
    """Pairs (one vehicle in one slot each) that settle.

    Attributes:
        records: `PairRecord` of each pair, (k,).
        order: (k,) rows of `records`, sorted by slot and vehicle.
        kinds: (2,) number of their bounds, and of their values, that are still remembered.
    """

    records: RecordArray
    order: IntArray
    kinds: IntArray


class _Tally(NamedTuple):
    """Numbers of pairs that settle. The number of slot k is in `slots[k + 1]`, and the number of
    vehicle k in `vehicles[k + 1]`. `kinds` (2,) are the numbers of their bounds and of their values
    that are still remembered.
    """

    slots: Int32Array
    vehicles: Int32Array
    kinds: IntArray


def remove_settling_pairs(state: State, names: RecordArray, slots: int, now: int) -> SettlingPairs:
    """Remove the pairs without an observation that is still waiting to become final from the hash
    table `State.pairs`, and return them. These pairs can be settled, that is, moved to compact
    storage.

    If no report of a pair is still remembered at `now` [s], record in the cell that the vehicle was
    already counted there. `names` are the records of the vehicles, and `slots` is the number of
    slots in use.
    """
    records = np.empty(int(state.used[PAIRS]), PAIR)
    tally = _Tally(
        np.zeros(slots + 1, np.int32),
        np.zeros(len(names) + 1, np.int32),
        np.zeros(len(ReportKind), np.int64),
    )
    count = _remove_settling(state, names, now, tally, records)
    records = records[:count]
    order = np.empty((2, count), np.int64)
    _sort_pairs(records, np.cumsum(tally.slots), np.cumsum(tally.vehicles), order[0], order[1])
    return SettlingPairs(records, order[0], tally.kinds)


@refcount_free_locked
def _remove_settling(
    state: State, names: RecordArray, now: int, tally: _Tally, out: RecordArray
) -> int:
    """Move the records of the pairs without a waiting observation from the hash table to `out`,
    count them in `tally`, and return their number. Each other pair moves to the first free place
    from its first place on, so that a search still finds it. The scan begins after a free place, so
    that it meets the pairs in the order in which a search would meet them.
    """
    pairs = state.pairs
    count = 0
    free = 0
    while pairs[free].slot != NONE:
        free += 1
    for step in range(free + 1, free + len(pairs)):
        place = step if step < len(pairs) else step - len(pairs)
        ahead = min(place + AHEAD, len(pairs) - 1)
        prefetch(state.entries, pairs[ahead].last, 0)
        prefetch(tally.slots, pairs[ahead].slot + 1, 0)
        this = pairs[place]
        if this.slot == NONE:
            continue
        if this.last != NONE:
            _move_back(state, place)
            continue
        has_bound = this.time[ReportKind.BOUND] >= oldest_remembered(now, ReportKind.BOUND)
        has_value = this.time[ReportKind.VALUE] >= oldest_remembered(now, ReportKind.VALUE)
        tally.kinds[ReportKind.BOUND] += has_bound
        tally.kinds[ReportKind.VALUE] += has_value
        if not has_bound and not has_value:
            _mark_returned(state, this.slot, names[this.vehicle].key)
        tally.slots[this.slot + 1] += 1
        tally.vehicles[this.vehicle + 1] += 1
        out[count] = this
        count += 1
        _free_place(pairs, place)
    state.used[PAIRS] -= count
    return count


@refcount_free_inlined
def _move_back(state: State, place: int) -> None:
    """Move a pair record from a place of the hash table `State.pairs` to the first free place from
    its first place on, if this is another place.
    """
    pairs = state.pairs
    to = first_place(pairs, pairs[place].slot, pairs[place].vehicle)
    while to != place and pairs[to].slot != NONE:
        to = to + 1 if to + 1 < len(pairs) else 0
    if to == place:
        return
    pairs[to] = pairs[place]
    _free_place(pairs, place)
    entry = int(pairs[to].last)
    while entry != NONE:
        state.entries[entry].pair = to
        entry = int(state.entries[entry].before)


@refcount_free_inlined
def _free_place(pairs: RecordArray, place: int) -> None:
    this = pairs[place]
    this.slot = NONE
    this.vehicle = 0
    this.last = 0
    this.waiting = 0
    this.std = 0
    for kind in (ReportKind.BOUND, ReportKind.VALUE):
        this.time[kind] = 0
        this.mean[kind] = 0
        this.spent[kind] = 0


@refcount_free_locked
def _sort_pairs(
    pairs: RecordArray,
    slot_begins: IntArray,
    vehicle_begins: IntArray,
    rows: IntArray,
    spare: IntArray,
) -> None:
    """Write the row numbers of `pairs` (k,) to `rows` (k,), sorted by slot, and then by vehicle.
    First all rows are sorted by vehicle, then by slot: each row is written to the next free place
    among those of its vehicle, or slot, whose places begin at the given numbers. This takes a third
    of the time of a sort by comparison. `spare` (k,) is scratch memory.
    """
    for k in range(len(rows)):
        place = vehicle_begins[pairs[k].vehicle]
        vehicle_begins[pairs[k].vehicle] += 1
        spare[place] = np.int64(pairs[k].slot) << 32 | k
    for k in range(len(rows)):
        slot = spare[k] >> 32
        rows[slot_begins[slot]] = np.int32(spare[k])
        slot_begins[slot] += 1


@refcount_free_locked
def insert_reports(
    state: State, settling: SettlingPairs, now: int, reports: int, values: int, vehicles: int
) -> None:
    """Insert the reports of pairs (one vehicle in one slot each) into the sorted arrays of settled
    reports. Reports that are no longer remembered at `now` [s] are left out.

    `reports` is the number of settled reports before the call, and `values` the number of friction
    values among them. The caller has lengthened the arrays by exactly the number of new reports.
    Therefore rows are moved in place, from the last to the first. `vehicles` is the number of known
    vehicles.
    """
    begins = state.settled_begin
    keys = state.settled_keys
    end = reports
    value = values
    to = len(keys)
    to_value = len(state.settled_std)
    records, order, _ = settling
    k = len(order) - 1
    for slot in range(len(begins) - 2, -1, -1):
        begin = _to_int(begins[slot, 0])
        begins[slot + 1, 0] = to
        begins[slot + 1, 1] = to_value
        while k >= 0 and records[order[k]].slot == slot:
            prefetch(records, order[max(k - AHEAD, 0)], 0)
            this = records[order[k]]
            k -= 1
            for kind in (ReportKind.VALUE, ReportKind.BOUND):
                if this.time[kind] < oldest_remembered(now, kind):
                    continue
                key = _make_key(this.vehicle, kind)
                while end > begin and keys[end - 1] > key:
                    end -= 1
                    to -= 1
                    is_value = _move_report(state, end, to, value - 1, to_value - 1)
                    value -= is_value
                    to_value -= is_value
                to -= 1
                keys[to] = key
                state.settled[to].time = this.time[kind] & 0xFFFF
                state.settled[to].mean = this.mean[kind]
                state.settled[to].spent = this.spent[kind]
                if kind == ReportKind.VALUE:
                    to_value -= 1
                    state.settled_std[to_value] = this.std
        if to == end:  # all reports before this one are already at their places
            break
        while end > begin:
            end -= 1
            to -= 1
            is_value = _move_report(state, end, to, value - 1, to_value - 1)
            value -= is_value
            to_value -= is_value
    state.used[SETTLED_SINCE] = oldest_remembered(now, ReportKind.VALUE)
    state.used[SETTLED_VEHICLES] = vehicles


@refcount_free_inlined
def returning_bit(number: int) -> np.uint64:
    """Return the bit that represents a vehicle in `Cells.returned`, the set of vehicles whose
    reports in a cell were deleted; several vehicles share a bit.
    """
    return np.uint64(1) << ((np.uint64(number) * _FIBONACCI) >> np.uint64(58))


@refcount_free_inlined
def _mark_returned(state: State, slot: int, number: int) -> None:
    """Record in a cell that a vehicle was counted there, before the vehicle's reports in the cell
    are deleted. If the vehicle returns, it is then not counted as a new vehicle. `number` is the
    permanent number of the vehicle.
    """
    bit = returning_bit(number)
    state.live.cells[slot].returned |= bit
    window = state.live.cells[slot].window
    if window != NONE:
        state.base.cells[window].returned |= bit
