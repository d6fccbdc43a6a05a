"""Changes of the memory of a fusion's state: larger arrays of records, and deletion of old records.
Each function returns the new state.

An entry is one observation in one cell. It waits in the cell's lateness window until it is older
than the checkpoint (latest time minus the allowed delay). Until then it is not final, because an
earlier observation may still arrive.
"""

from __future__ import annotations

from typing import Any, TypeVar

import numpy as np
from numpy.typing import NDArray

from fleet_service.fusion.belief import ReportKind
from fleet_service.fusion.store.cells import rows_of_lines
from fleet_service.fusion.store.pairs import move_pairs
from fleet_service.fusion.store.records import (
    FREE_ENTRIES,
    FREE_WINDOWS,
    NONE,
    PAIR,
    PAIRS,
    REPORTERS_USED,
    Int32Array,
    Rows,
    State,
)
from fleet_service.fusion.store.settled import (
    drop_reports,
    insert_reports,
    remove_settling_pairs,
)
from fleet_service.fusion.store.table import places_for
from schemas.numeric import IntArray
from schemas.runtime.records import RecordArray


def grow_entries(state: State, most: int) -> State:
    """Return the fusion's state with space for at least `most` entries (observations that are not
    yet final): twice the present space, or `most` if this is more.
    """
    entries = grow_rows(state.entries, max(2 * len(state.entries), most))
    free = _free_rows(state.free_entries, state.used, FREE_ENTRIES, len(entries))
    return state._replace(entries=entries, free_entries=free)


def grow_windows(state: State, most: int) -> State:
    """Return the fusion's state with space for at least `most` lateness windows (lists of the
    recent observations of one cell): twice the present space, or `most` if this is more.
    """
    rows = max(2 * len(state.windows), most)
    windows = grow_rows(state.windows, rows)
    windows["slot"][len(state.windows) :] = NONE
    base = Rows(
        grow_rows(state.base.belief, rows),
        grow_rows(state.base.cells, rows),
        grow_rows(state.base.reporters, rows),
    )
    free = _free_rows(state.free_windows, state.used, FREE_WINDOWS, rows)
    return state._replace(windows=windows, base=base, free_windows=free)


def resize_pairs(state: State, places: int) -> State:
    """Return the fusion's state with `places` places in its hash table `State.pairs`, which must be
    more than the pairs in use. A pair is the record of one vehicle in one slot (cell and heading
    sector) in which the vehicle has reported recently.
    """
    new = no_pairs(places)
    move_pairs(state.entries, state.pairs, new)
    return state._replace(pairs=new)


def settle_pairs(state: State, names: RecordArray, size: int, now: int) -> State:
    """Return the fusion's state after records that can no longer change have been moved to compact
    storage. A pair is the record of one vehicle in one slot.

    If all observations of a pair are final, its reports move from the hash table `State.pairs` to
    the sorted arrays `State.settled`. Reports that are too old to have an effect at `now` [s] are
    deleted.

    `names` (V,) are the records of the vehicles, and `size` is the number of slots in use.
    """
    places = places_for(int(state.used[PAIRS]))
    reports, values = drop_reports(state, names, now)
    begins = np.empty((size + 1, 2), np.uint32)
    begins[: len(state.settled_begin)] = state.settled_begin
    begins[len(state.settled_begin) :] = reports, values
    state = state._replace(settled_begin=begins)
    settling = remove_settling_pairs(state, names, size, now)
    # in place, because a copy would take as much memory again
    more = int(settling.kinds.sum())
    more_values = int(settling.kinds[ReportKind.VALUE])
    state.settled.resize(reports + more, refcheck=False)
    state.settled_keys.resize(reports + more, refcheck=False)
    state.settled_std.resize(values + more_values, refcheck=False)
    insert_reports(state, settling, now, reports, values, len(names))
    # The table usually keeps its size, because as many pairs will follow.
    return resize_pairs(state, places) if 2 * places < len(state.pairs) else state


def rebuild_reporters(state: State, size: int, least: int) -> State:
    """Return the fusion's state without outdated lists of reporters. Each list belongs to one slot
    and contains the vehicles that recently reported there. A list is deleted if its newest report
    is older than `least` [s] and all observations in its slot are final. `size` is the number of
    slots in use.
    """
    live = state.live
    cells = live.cells[:size]
    slots = np.flatnonzero(cells["reporters"] != NONE)
    row = cells["reporters"][slots]
    old = live.reporters
    last = np.maximum(
        old["time"].max(axis=1, initial=0), old["source_time"].max(axis=(1, 2), initial=0)
    )
    stay = (last[row] >= least) | (cells["window"][slots] != NONE)
    cells["reporters"][slots] = NONE
    cells["reporters"][slots[stay]] = np.arange(stay.sum())
    state.used[REPORTERS_USED] = stay.sum()
    return state._replace(live=live._replace(reporters=old[row[stay]]))


def no_pairs(places: int) -> RecordArray:
    """Return an empty hash table of pair records (one vehicle in one slot each)."""
    pairs = rows_of_lines(places, PAIR)
    pairs["slot"] = NONE
    return pairs


Array = TypeVar("Array", bound=NDArray[Any])


def grow_rows(old: Array, rows: int) -> Array:
    """Return a copy of an array that has space for `rows` rows."""
    new = rows_of_lines(rows, old.dtype, *old.shape[1:])
    new[: len(old)] = old
    return new  # type: ignore[return-value] # of the very type of `old`


def _free_rows(old: Int32Array, used: IntArray, which: int, rows: int) -> Int32Array:
    """Return the list of free rows of an array of records that has grown to `rows`: the earlier
    free rows `old` and the new rows. The number of free rows is written to `used[which]`; `used`
    contains the counts of the fusion's memory.
    """
    count = int(used[which])
    more = rows - len(old)
    new = np.zeros(rows, np.int32)
    new[:count] = old[:count]
    new[count : count + more] = np.arange(len(old), rows)
    used[which] = count + more
    return new
