"""The lateness window: the recent observations of a cell, stored in order of time. They change the
belief in this order, whatever their order of arrival. Observations older than the checkpoint
(latest time minus the allowed delay) are final.

A slot is the storage of one cell and heading sector. Its live row contains the belief after all
observations. A slot has a window while it has observations younger than the checkpoint. The window
contains these observations and the base, a copy of the row without their effect. An observation
that is newer than all others updates the live row. An older one makes the window stale. After each
batch, the live rows of all stale windows are computed again from their bases.

A commit moves observations that have become older than the checkpoint into the base. When the last
observation has been moved, the base equals the live row and the window is freed. Both rows go
through the same operations in the same order, so that they agree bit for bit.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from fleet_service.fusion.belief import PADDED, Bins, ReportKind
from fleet_service.fusion.store.cells import copy_row, copy_sources
from fleet_service.fusion.store.pairs import comes_before, commit_pair, link_pair, pair_of
from fleet_service.fusion.store.records import (
    FREE_ENTRIES,
    FREE_WINDOWS,
    NONE,
    REPORTERS_USED,
    Int32Array,
    State,
)
from fleet_service.fusion.store.settled import guess_row
from fleet_service.fusion.store.table import AHEAD, first_place
from fleet_service.fusion.trust import compare_reports, judge_flag
from fleet_service.fusion.votes import (
    CellPlace,
    describe_vote,
    discount_vote,
    load_likelihood,
    needs_reporters,
    update_cell,
)
from fleet_service.fusion.weather import Weather
from schemas.numeric import BoolArray, ByteArray, Float32Array, IntArray
from schemas.runtime.jit import refcount_free, refcount_free_inlined
from schemas.runtime.prefetch import prefetch
from schemas.runtime.records import RecordArray


class Arrivals(NamedTuple):
    """A batch of n observations, arrays of shape (n,) with the fields of `Observations`.

    `vehicle` is the index of the vehicle in this service, `number` its permanent number, and
    `weight` the trust in it. The other fields describe the visit: time, likelihood, grip used and
    so on (see `EntryRecord`).
    """

    time: IntArray
    number: IntArray
    boot: IntArray
    sequence: IntArray
    vehicle: IntArray
    weight: Float32Array
    share: Float32Array
    evidence: ByteArray
    reported: Float32Array
    used: ByteArray
    shared: ByteArray
    manoeuvre: NDArray[np.int8]
    late: ByteArray
    limited: NDArray[np.int8]


class Votes(NamedTuple):
    """Votes of a batch, arrays of shape (k,). A vote is the effect of one observation on one cell:
    row of the observation, and slot (cell and heading sector).

    Among the votes of one observation, the vote for its own sector comes first. At most `most`
    observations of a vehicle may wait in one cell.
    """

    row: IntArray
    slot: IntArray
    most: int


class Marks(NamedTuple):
    """Arrays that are filled while a batch of n observations is processed: a mask of the
    observations left out (n,), a mask of the accepted ones (n,), and the rows (k,) of windows whose
    belief must be computed again. A window contains the recent observations of a cell.
    """

    left_out: BoolArray
    seen: BoolArray
    stale: Int32Array


def absorb_votes(state: State, weather: Weather, arrivals: Arrivals, votes: Votes) -> BoolArray:
    """Add the votes of a batch (effects of its observations on cells) to the lateness windows
    (recent observations, sorted by time) of their cells, and update the beliefs.

    Every memory pool must have as many free rows as the batch has votes.

    Return a mask (n,) of the observations that were left out. An observation is left out if
    `votes.most` observations of its vehicle already wait in its own sector of the cell.
    """
    n = len(arrivals.time)
    k = len(votes.row)
    marks = Marks(np.zeros(n, np.bool_), np.zeros(n, np.bool_), np.empty(k, np.int32))
    scratch = np.zeros((3, PADDED), np.float32)
    waiting = _absorb_votes(state, weather, arrivals, votes, marks, scratch)
    _recompute_beliefs(state, weather, marks.stale[:waiting], scratch)
    return marks.left_out


@refcount_free
def _absorb_votes(
    state: State,
    weather: Weather,
    arrivals: Arrivals,
    votes: Votes,
    marks: Marks,
    scratch: Bins,
) -> int:
    """Add the votes (effects of observations on cells) to the lateness windows (recent
    observations, sorted by time) of their cells. Record in `marks` the observations that were left
    out, those that were accepted, and the windows whose belief must be computed again. Return the
    number of these windows.
    """
    cells = state.live.cells
    windows = state.windows
    entries = state.entries
    pairs = state.pairs
    waiting = 0
    for step in range(len(votes.row) + 3 * AHEAD):
        k = step - 3 * AHEAD
        _prefetch_votes(state, arrivals, votes, step, step - 2 * AHEAD - max(k, 0))
        if k < 0:
            continue
        row = votes.row[k]
        slot = votes.slot[k]
        if marks.left_out[row]:
            continue
        pair = pair_of(state, slot, arrivals.vehicle[row])
        if not marks.seen[row] and pairs[pair].waiting >= votes.most:
            marks.left_out[row] = True
            continue
        marks.seen[row] = True
        entry = _fill_entry(state, arrivals, row)
        new = entries[entry]
        describe_vote(entries, entry, arrivals.reported[row], scratch)
        window = int(cells[slot].window)
        if window == NONE:
            window = _open_window(state, slot)
        if cells[slot].reporters == NONE and needs_reporters(entries, entry):
            _open_reporters(state, slot, window)
        _link_entry(windows, entries, window, entry)
        link_pair(entries, pairs, pair, entry)
        if windows[window].stale:
            continue
        if new.following != NONE:
            windows[window].stale = 1
            marks.stale[waiting] = window
            waiting += 1
            continue
        discount_vote(entries, pairs, entry)
        place = CellPlace(slot, cells[slot].reporters)
        update_cell(state.live, place, entries, entry, weather, scratch)
    return waiting


@refcount_free_inlined
def _fill_entry(state: State, arrivals: Arrivals, row: int) -> int:
    """Copy an observation (row `row` of `arrivals`) into a free row of the store's entries (recent
    observations); return the number of this row.
    """
    state.used[FREE_ENTRIES] -= 1
    entry = int(state.free_entries[state.used[FREE_ENTRIES]])
    new = state.entries[entry]
    new.vehicle = arrivals.vehicle[row]
    new.weight = arrivals.weight[row]
    new.time = arrivals.time[row]
    new.number = arrivals.number[row]
    new.boot = arrivals.boot[row]
    new.sequence = arrivals.sequence[row]
    for i in range(arrivals.evidence.shape[1]):
        new.evidence[i] = arrivals.evidence[row, i]
    new.used = arrivals.used[row]
    new.shared = arrivals.shared[row]
    new.manoeuvre = arrivals.manoeuvre[row]
    new.late = arrivals.late[row]
    new.limited = arrivals.limited[row]
    new.share = arrivals.share[row]
    return entry


@refcount_free_inlined
def _prefetch_votes(state: State, arrivals: Arrivals, votes: Votes, step: int, ahead: int) -> None:
    """Prefetch the memory that later votes will access: for the vote in row `step` of `votes` the
    cell and the place of its settled reports, for the vote AHEAD rows before it the rows whose
    numbers these contain, and for the vote 2·AHEAD rows before it all other rows. The last are most
    of the memory, and the processor's first-level cache cannot hold them for more votes.
    `ahead` is the number of votes between the present one and the vote in row `step` - 2·AHEAD.

    The memory accesses of later votes then overlap with the work on the present vote. The code uses
    `max` and `min` instead of branches on the values that it loads. A processor that mispredicts a
    branch would discard its prefetches.
    """
    live = state.live
    base = state.base
    windows = state.windows
    used = state.used
    if step < len(votes.row):
        slot = votes.slot[step]
        prefetch(live.cells, slot, 0)
        prefetch(state.settled_begin, slot, 0)
    k = step - AHEAD
    if 0 <= k < len(votes.row):
        prefetch(windows, max(live.cells[votes.slot[k]].window, 0), 0)
        reporters = max(live.cells[votes.slot[k]].reporters, 0)
        prefetch(live.reporters, reporters, 1)
        prefetch(live.reporters, reporters, 2)
        slot = min(votes.slot[k], len(state.settled_begin) - 2)
        if slot >= 0:
            row = guess_row(state, slot, arrivals.vehicle[votes.row[k]])
            prefetch(state.settled_keys, row - 8, 0)
            prefetch(state.settled_keys, row + 8, 0)
    k = step - 2 * AHEAD
    if 0 <= k < len(votes.row):
        slot = votes.slot[k]
        prefetch(state.entries, windows[max(live.cells[slot].window, 0)].tail, 0)
        prefetch(live.belief, slot, 0)
        pair = first_place(state.pairs, slot, arrivals.vehicle[votes.row[k]])
        prefetch(state.pairs, pair, 0)
        prefetch(state.pairs, pair + 1, 0)
        entry = state.free_entries[used[FREE_ENTRIES] - 1 - ahead]
        prefetch(state.entries, entry, 0)
        prefetch(state.entries, entry, 1)
        window = state.free_windows[used[FREE_WINDOWS] - 1 - ahead]
        prefetch(base.cells, window, 0)
        prefetch(base.belief, window, 0)
        prefetch(windows, window, 0)


@refcount_free_inlined
def _open_window(state: State, slot: int) -> int:
    """Open a lateness window for a slot without one. Store in it a copy of the slot's belief, and
    return the row number of the window.
    """
    state.used[FREE_WINDOWS] -= 1
    window = int(state.free_windows[state.used[FREE_WINDOWS]])
    live = state.live
    new = state.windows[window]
    live.cells[slot].window = window
    new.slot = slot
    new.head = NONE
    new.tail = NONE
    new.stale = 0
    new.values = 0
    copy_row(live, slot, state.base, window)
    reporters = live.cells[slot].reporters
    if reporters != NONE:
        copy_sources(live.reporters, reporters, state.base.reporters, window)
    return window


@refcount_free
def _open_reporters(state: State, slot: int, window: int) -> None:
    """Allocate a list of recent reporters for a slot that has a window but no such list yet."""
    row = state.used[REPORTERS_USED]
    state.used[REPORTERS_USED] += 1
    state.live.cells[slot].reporters = row
    state.live.reporters[row].reporter[:] = NONE
    state.live.reporters[row].source[:] = NONE
    copy_sources(state.live.reporters, row, state.base.reporters, window)


@refcount_free
def _recompute_beliefs(state: State, weather: Weather, stale: Int32Array, scratch: Bins) -> None:
    live = state.live
    windows = state.windows
    entries = state.entries
    for window in stale:
        slot = int(windows[window].slot)
        reporters = live.cells[slot].reporters
        copy_row(state.base, window, live, slot)
        if reporters != NONE:
            copy_sources(state.base.reporters, window, live.reporters, reporters)
        entry = windows[window].head
        while entry != NONE:
            discount_vote(entries, state.pairs, entry)
            load_likelihood(entries, entry, scratch)
            place = CellPlace(slot, reporters)
            update_cell(live, place, entries, entry, weather, scratch)
            entry = entries[entry].following
        windows[window].stale = 0


class VehicleRecords(NamedTuple):
    """Records of all vehicles: each vehicle's comparisons with other vehicles (`peers`), and its
    permanent number (`names`).
    """

    peers: RecordArray
    names: RecordArray


def commit_windows(
    state: State,
    weather: Weather,
    vehicles: VehicleRecords,
    due_windows: IntArray,
    before: int,
) -> None:
    """Advance the checkpoint, before which observations are final, to `before` [ns] in the given
    lateness windows (k,), which contain the recent observations of cells. Older observations are
    moved from the window into the base, the cell's final state.
    """
    scratch = np.zeros((3, PADDED), np.float32)
    _commit_windows(state, weather, vehicles, due_windows, before, scratch)


@refcount_free_inlined
def _prefetch_due(state: State, due_windows: IntArray, step: int) -> None:
    """Prefetch the memory that `commit_windows` will access for later lateness windows (recent
    observations of cells): for row `step` of `due_windows` the window, and for the rows AHEAD,
    2·AHEAD and 3·AHEAD before it the records whose row numbers were prefetched before.
    """
    live = state.live
    base = state.base
    windows = state.windows
    entries = state.entries
    count = len(due_windows)
    if step < count:
        prefetch(windows, due_windows[step], 0)
    if 0 <= step - AHEAD < count:
        window = due_windows[step - AHEAD]
        prefetch(entries, windows[window].head, 0)
        prefetch(entries, windows[window].head, 1)
        prefetch(entries, windows[window].tail, 0)
        prefetch(live.cells, windows[window].slot, 0)
    if 0 <= step - 2 * AHEAD < count:
        window = due_windows[step - 2 * AHEAD]
        prefetch(state.pairs, entries[windows[window].head].pair, 0)
        if windows[window].values:
            prefetch(live.reporters, live.cells[windows[window].slot].reporters, 0)
            prefetch(live.reporters, live.cells[windows[window].slot].reporters, 1)
        if windows[window].tail != windows[window].head:
            prefetch(entries, entries[windows[window].head].following, 0)
            prefetch(base.cells, window, 0)
            prefetch(base.belief, window, 0)
    if 0 <= step - 3 * AHEAD < count:
        window = due_windows[step - 3 * AHEAD]
        if windows[window].tail != windows[window].head:
            prefetch(state.pairs, entries[entries[windows[window].head].following].pair, 0)


@refcount_free_inlined
def _prefetch_following(state: State, entry: int) -> None:
    """Prefetch the memory that `commit_windows` will access for the observation in row `entry`, and
    for the one that follows in its window.
    """
    entries = state.entries
    prefetch(state.pairs, entries[entry].pair, 0)
    prefetch(entries, entries[entry].following, 0)
    prefetch(entries, entries[entry].following, 1)


@refcount_free
def _commit_windows(
    state: State,
    weather: Weather,
    vehicles: VehicleRecords,
    due_windows: IntArray,
    before: int,
    scratch: Bins,
) -> None:
    peers, names = vehicles
    live = state.live
    windows = state.windows
    entries = state.entries
    for step in range(len(due_windows) + 4 * AHEAD):
        _prefetch_due(state, due_windows, step)
        if step < 4 * AHEAD:
            continue
        window = due_windows[step - 4 * AHEAD]
        slot = int(windows[window].slot)
        whole = entries[windows[window].tail].time < before
        entry = int(windows[window].head)
        while entry != NONE and entries[entry].time < before:
            following = int(entries[entry].following)
            if following != NONE:
                _prefetch_following(state, following)
            if not whole:
                load_likelihood(entries, entry, scratch)
                place = CellPlace(window, window)
                update_cell(state.base, place, entries, entry, weather, scratch)
            if entries[entry].limited > 0:
                judge_flag(live.reporters, live.cells[slot].reporters, peers, entries, entry)
            if entries[entry].kind == ReportKind.VALUE:
                windows[window].values -= 1
                compare_reports(
                    live.reporters, live.cells[slot].reporters, peers, names, entries, entry
                )
            commit_pair(entries, state.pairs, entry)
            state.free_entries[state.used[FREE_ENTRIES]] = entry
            state.used[FREE_ENTRIES] += 1
            entry = following
        _shorten_window(state, slot, window, entry)


@refcount_free_inlined
def _shorten_window(state: State, slot: int, window: int, entry: int) -> None:
    """Make `entry` the first observation of a lateness window; free the window if `entry` is
    NONE.
    """
    windows = state.windows
    windows[window].head = entry
    if entry == NONE:
        state.live.cells[slot].window = NONE
        windows[window].slot = NONE
        state.free_windows[state.used[FREE_WINDOWS]] = window
        state.used[FREE_WINDOWS] += 1
    else:
        state.entries[entry].previous = NONE
        windows[window].first = state.entries[entry].time


@refcount_free_inlined
def _link_entry(windows: RecordArray, entries: RecordArray, window: int, entry: int) -> None:
    """Insert an observation (row `entry` of `entries`) into the lateness window (the recent
    observations of its cell) in order of time. The search starts at the newest observation, because
    nearly all arrive in order.
    """
    after = windows[window].tail
    while after != NONE and comes_before(entries, entry, after):
        after = entries[after].previous
    following = windows[window].head if after == NONE else entries[after].following
    entries[entry].previous = after
    entries[entry].following = following
    windows[window].values += entries[entry].kind == ReportKind.VALUE
    if after == NONE:
        windows[window].head = entry
        windows[window].first = entries[entry].time
    else:
        entries[after].following = entry
    if following == NONE:
        windows[window].tail = entry
    else:
        entries[following].previous = entry
