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

from fleet_service.fusion.store.cells import rows_of_lines
from fleet_service.fusion.store.pairs import count_staying, mark_returned, move_pairs
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
from fleet_service.fusion.store.table import PAIRS_MOST, places_for
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


def rebuild_pairs(state: State, names: RecordArray, now: int, most: int) -> State:
    """Return the fusion's state without the pair records (one per vehicle and cell) that are too
    old at `now` [s], and with room for `most` pair records. `names` are the records of the
    vehicles.
    """
    old = state.pairs
    count = count_staying(old, now)
    new = no_pairs(places_for(max(count, most), PAIRS_MOST))
    dropped = move_pairs(state.entries, old, new, now)
    mark_returned(state, old["slot"][dropped], names["key"][old["vehicle"][dropped]])
    state.used[PAIRS] = count
    return state._replace(pairs=new)


def rebuild_reporters(state: State, size: int, least: int) -> State:
    """Return the fusion's state without the lists of recent reporters whose last report was before
    `least` [s]. Cells with observations that are not yet final keep their lists. `size` is the
    number of slots (cells and sectors) in use.
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
    """Return an empty table of pair records (one per vehicle and cell)."""
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
    free rows `old` and the new rows. The number of free rows is stored in `used[which]`.
    """
    count = int(used[which])
    more = rows - len(old)
    new = np.zeros(rows, np.int32)
    new[:count] = old[:count]
    new[count : count + more] = np.arange(len(old), rows)
    used[which] = count + more
    return new
