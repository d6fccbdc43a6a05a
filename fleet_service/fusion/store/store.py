"""The store of a fusion (beliefs about all cells): the memory for its state, which consists of
tables and pools that grow. Compiled code receives all arrays as one `State`.
"""

from __future__ import annotations

from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from fleet_service.fusion import constants
from fleet_service.fusion.store.cells import Cells, cells_of, no_beliefs, rows_of_lines
from fleet_service.fusion.store.growth import (
    grow_entries,
    grow_rows,
    grow_windows,
    no_pairs,
    rebuild_reporters,
    resize_pairs,
    settle_pairs,
)
from fleet_service.fusion.store.records import (
    CELL,
    ENTRY,
    FREE_ENTRIES,
    FREE_WINDOWS,
    NONE,
    PAIRS,
    PEER,
    REPORTER,
    REPORTERS_USED,
    SETTLED,
    SOURCE,
    VEHICLE,
    WINDOW,
    Rows,
    State,
)
from fleet_service.fusion.store.table import (
    LEAST,
    assign_rows,
    is_full,
    places_for,
    rows_of,
    slots_for,
    table_of,
)
from schemas.numeric import BoolArray, IntArray
from schemas.runtime.jit import refcount_free_locked
from schemas.runtime.records import RecordArray
from schemas.thresholds import NS

_NOTHING = np.zeros(0, np.int32)
# [s] Time by which the checkpoint may be ahead of the clock: with little lateness, the rest of an
# epoch. One more epoch is allowed for the clock's error.
_AHEAD: Final = 2 * constants.EPOCH_NS // NS


class Store:
    """Complete state of a fusion, empty at first.

    Attributes:
        state: arrays for compiled code.
        peers: record of each vehicle with its comparisons with other vehicles.
        names: record of each vehicle with its permanent number; the first `vehicles` are in use.
        size, vehicles: number of slots (one per cell and heading sector) and of vehicles in use.
        forgotten_at: checkpoint time [s], in whole quarters of an hour, at which `forget` last
            deleted old records.
    """

    def __init__(self) -> None:
        self.state = State(
            live=Rows(no_beliefs(0), np.zeros(0, CELL), np.zeros(0, REPORTER)),
            base=Rows(no_beliefs(0), np.zeros(0, CELL), np.zeros(0, SOURCE)),
            windows=np.zeros(0, WINDOW),
            free_windows=_NOTHING,
            entries=np.zeros(0, ENTRY),
            free_entries=_NOTHING,
            pairs=no_pairs(LEAST),
            settled=np.zeros(0, SETTLED),
            settled_keys=np.zeros(0, np.uint32),
            settled_std=np.zeros(0, np.uint16),
            settled_begin=np.zeros((1, 2), np.uint32),
            used=np.zeros(6, np.int64),
        )
        self.peers = no_peers(0)
        self.names: RecordArray = np.zeros(0, VEHICLE)
        self.size = 0
        self.vehicles = 0
        self._slots: IntArray = np.full(LEAST, NONE, np.int64)
        self._known: IntArray = np.full(LEAST, NONE, np.int64)
        self.forgotten_at = 0
        self._columns: tuple[Rows, Cells] | None = None  # columns of the rows `state.live`

    @staticmethod
    def of(
        state: State,
        peers: RecordArray,
        names: RecordArray,
        size: int,
        vehicles: int,
        forgotten_at: int,
    ) -> Store:
        """Return the store (complete state) of a fusion that contains the given arrays and
        counts.
        """
        store = Store()
        store.state = state
        store.peers = peers
        store.names = names
        store.size = size
        store.vehicles = vehicles
        store.forgotten_at = forgotten_at
        store._slots = table_of(state.live.cells, size, size)
        store._known = table_of(names, vehicles, vehicles)
        return store

    @property
    def live(self) -> Cells:
        """Return the state of all slots as columns: belief, counts and times."""
        if self._columns is None or self._columns[0] is not self.state.live:
            self._columns = (self.state.live, cells_of(self.state.live))
        return self._columns[1]

    @property
    def waiting(self) -> int:
        """Return the number of entries (observations) in the lateness windows (lists of recent
        observations, which are not final) of all cells.
        """
        return len(self.state.free_entries) - int(self.state.used[FREE_ENTRIES])

    def due_windows(self, before: int) -> tuple[IntArray, IntArray]:
        """Return the lateness windows (recent observations of one cell) that contain observations
        older than `before` [ns]: first the windows without a value of friction, then those with a
        value, sorted by cell.

        Friction values that leave the window are compared with other values to compute trust in
        vehicles. The order of these comparisons must not depend on the order of arrival, so windows
        with values are sorted. All others stay in the order of memory, which is faster.
        """
        plain, valued = find_due_windows(self.state.windows, before)
        return plain, valued[
            np.argsort(self.state.live.cells["key"][self.state.windows["slot"][valued]])
        ]

    def slots_of(self, keys: IntArray) -> IntArray:
        """Return the slot (row number) (n,) of each key; NONE if the key has no slot."""
        return rows_of(self._slots, self.state.live.cells, np.asarray(keys, np.int64))

    @property
    def table(self) -> IntArray:
        """Return the hash table in which compiled code finds slots by key."""
        return self._slots

    def slots_for(self, keys: IntArray) -> IntArray:
        """Return the slot (row number) (n,) of each key. An unknown key gets a new slot, which
        begins with the prior.
        """
        slots = self.slots_of(keys)
        new = np.flatnonzero(slots == NONE)
        if not len(new):
            return slots
        most = self.size + len(distinct_values(keys[new]))
        if is_full(most, len(self._slots)):
            self._slots = table_of(self.state.live.cells, self.size, most)
        if most > len(self.state.live.cells):
            live = self.state.live
            rows = max(most, 2 * len(self.state.live.cells))
            live = live._replace(
                belief=grow_rows(live.belief, rows), cells=grow_rows(live.cells, rows)
            )
            self.state = self.state._replace(live=live)
        found = np.empty(len(new), np.int64)
        self.size = slots_for(self._slots, self.state.live, keys[new], self.size, found)
        slots[new] = found
        return slots

    def known(self, vehicle: IntArray) -> IntArray:
        """Return the row number (n,) of each of the given vehicle numbers (n,); NONE for an unknown
        vehicle.
        """
        return rows_of(self._known, self.names, vehicle)

    def vehicles_of(self, vehicle: IntArray) -> IntArray:
        """Return the row number (n,) of each of the given vehicle numbers (n,); an unknown vehicle
        gets the next free index.
        """
        index = self.known(vehicle)
        if not len(index) or index.min() != NONE:
            return index
        most = self.vehicles + len(distinct_values(vehicle[index == NONE]))
        if is_full(most, len(self._known)):
            self._known = table_of(self.names, self.vehicles, most)
        if most > len(self.names):
            rows = max(most, 2 * len(self.names))
            self.names = grow_rows(self.names, rows)
            peers = no_peers(rows)
            peers[: len(self.peers)] = self.peers
            self.peers = peers
        self.vehicles = assign_rows(self._known, self.names, vehicle, self.vehicles, index)
        return index

    def reserve(self, rows: int) -> None:
        """Enlarge every array of records so that each has space for `rows` more votes (effects of
        one observation on one cell).
        """
        used = self.state.used
        if used[FREE_ENTRIES] < rows:
            self.state = grow_entries(self.state, self.waiting + rows)
        if used[FREE_WINDOWS] < rows:
            most = len(self.state.free_windows) - int(used[FREE_WINDOWS]) + rows
            self.state = grow_windows(self.state, most)
        live = self.state.live
        if used[REPORTERS_USED] + rows > len(live.reporters):
            most = max(int(used[REPORTERS_USED]) + rows, 2 * len(live.reporters))
            self.state = self.state._replace(
                live=live._replace(reporters=grow_rows(live.reporters, most))
            )
        pairs = int(used[PAIRS]) + rows
        if is_full(pairs, len(self.state.pairs)):
            places = max(places_for(pairs), 2 * len(self.state.pairs))
            self.state = resize_pairs(self.state, places)

    def forget(self, checkpoint_s: int) -> None:
        """Delete old data and move inactive data to compact storage. `checkpoint_s` [s] is the time
        before which observations are final.

        When this time enters a new quarter of an hour, two kinds of data are deleted: reports that
        no longer have an effect (`settled.oldest_remembered`), and lists of a cell's recent
        reporters that are older than SOURCE_NS. The records of vehicles in cells where all their
        observations are final are moved then (`settle_pairs`), and also whenever many such records
        exist.
        """
        now = checkpoint_s - checkpoint_s % constants.FORGOTTEN_EVERY_S
        state = self.state
        settling = int(state.used[PAIRS]) - self.waiting
        # A settling pair takes five times the memory of a settled one, but settling reads all
        # settled pairs. So settle only if enough pairs rest.
        some = (len(state.settled) + self.size) // 32
        if now != self.forgotten_at or settling > max(LEAST, self.waiting, some):
            self.state = settle_pairs(state, self.names[: self.vehicles], self.size, now)
        if now != self.forgotten_at:
            self.forgotten_at = now
            self.state = rebuild_reporters(
                self.state, self.size, now - constants.SOURCE_NS // NS - _AHEAD
            )

    def untouched(self, before: int) -> BoolArray:
        """Return a mask of slots, (size,): True if the last visit of a vehicle was before `before`
        [ns] and no other record refers to the slot.
        """
        cells = self.state.live.cells[: self.size]
        pairs = self.state.pairs
        found = (cells["time"] < before) & (cells["window"] == NONE) & (cells["reporters"] == NONE)
        found[pairs["slot"][pairs["slot"] != NONE]] = False
        begins = self.state.settled_begin[:, 0]
        found[: len(begins) - 1] &= begins[1:] == begins[:-1]
        return np.asarray(found)

    def drop(self, gone: BoolArray) -> IntArray:
        """Delete the slots that the mask `gone` (size,) selects; all must be `untouched` (not
        visited recently, and not referred to). Return the new number of each slot, NONE for deleted
        ones.
        """
        stay = np.flatnonzero(~gone)
        place = np.full(self.size, NONE, np.int64)
        place[stay] = np.arange(len(stay))
        live = self.state.live
        belief = no_beliefs(len(stay))
        cells = rows_of_lines(len(stay), CELL)
        belief[:] = live.belief[stay]
        cells[:] = live.cells[stay]
        begins = self.state.settled_begin
        begins = begins[np.append(stay[stay < len(begins) - 1], len(begins) - 1)]
        live = live._replace(belief=belief, cells=cells)
        self.state = self.state._replace(live=live, settled_begin=begins)
        for pointing in (self.state.windows["slot"], self.state.pairs["slot"]):
            used = pointing != NONE
            pointing[used] = place[pointing[used]]
        self.size = len(stay)
        self._slots = table_of(cells, self.size, self.size)
        self.state = resize_pairs(self.state, places_for(int(self.state.used[PAIRS])))
        return place


def find_due_windows(windows: RecordArray, before: int) -> tuple[IntArray, IntArray]:
    """Return the lateness windows that contain observations older than `before` [ns], as two arrays
    of row numbers: windows in which all observations are lower bounds of friction, and windows with
    at least one measured value.
    """
    found = np.empty(len(windows), np.int64)
    plain = _find_due_windows(windows, before, 0, found)
    valued = _find_due_windows(windows, before, 1, found[plain:])
    return found[:plain], found[plain : plain + valued]


@refcount_free_locked
def _find_due_windows(windows: RecordArray, before: int, with_value: int, out: IntArray) -> int:
    """Write to `out` the rows of the lateness windows that contain observations older than `before`
    [ns]: those with at least one value if `with_value` is 1, else those without. Return their
    number.
    """
    count = 0
    for window in range(len(windows)):
        is_due = windows[window].slot != NONE and windows[window].first < before
        if is_due and (windows[window].values > 0) == with_value:
            out[count] = window
            count += 1
    return count


def no_peers(vehicles: int) -> RecordArray:
    """Return empty comparison records, one row for each of the `vehicles` vehicles that have not
    been compared with others yet.
    """
    peers = np.zeros(vehicles, PEER)
    peers["other"] = NONE
    return peers


def distinct_values(values: NDArray[np.integer[Any]]) -> NDArray[np.integer[Any]]:
    """Return the distinct values of an array (n,) in ascending order. Sorting is several times
    faster than a set here.
    """
    ordered = np.sort(values)
    return np.asarray(
        ordered[np.append(np.ones(len(ordered[:1]), bool), ordered[1:] != ordered[:-1])]
    )
