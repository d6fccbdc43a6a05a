"""Room for the fusion's arrays: tables and pools that grow. The compiled code finds all of it in `State`."""

from __future__ import annotations

from typing import Any, TypeVar

import numpy as np
from numpy.typing import NDArray

from fleet_service.fusion import constants as c
from fleet_service.fusion.cells import CELL, NONE, Cells, Int32Array, Records, cells_of, no_beliefs, rows_of_lines
from fleet_service.fusion.pairs import mark_returned, moved, staying
from fleet_service.fusion.pools import (
    ENTRY,
    FREE_ENTRIES,
    FREE_WINDOWS,
    KEPT_VOICE,
    PAIR,
    PAIRS,
    VEHICLE,
    VOICE,
    VOICES,
    WINDOW,
    State,
)  # fmt: skip
from fleet_service.fusion.table import LEAST, PAIRS_MOST, ROWS_MOST, grown, is_full, numbered, room, rows_of, slots_for
from fleet_service.fusion.trust import no_peers
from fleet_service.fusion.window import due
from schemas.numeric import IntArray

_NOTHING = np.zeros(0, np.int32)
_HOUR = 3600
_AHEAD = 120  # s; a checkpoint with little lateness may be ahead of the clock by the rest of an epoch


class Stores:
    """Everything that a fusion holds, empty at first.

    Attributes:
        state: of compiled code.
        peers: (…) whom each vehicle met.
        names: (…) the vehicles' numbers by index; `vehicles` of them are known.
        size, vehicles: slots and vehicles in use.
        hour: until which pairs were dropped [s].
    """

    def __init__(self) -> None:
        self.state = State(
            no_beliefs(0), np.zeros(0, CELL), no_beliefs(0), np.zeros(0, CELL), np.zeros(0, KEPT_VOICE),
            np.zeros(0, WINDOW), _NOTHING, np.zeros(0, ENTRY), _NOTHING, _no_pairs(LEAST), np.zeros(0, VOICE),
            np.zeros(4, np.int64),
        )  # fmt: skip
        self.peers = no_peers(0)
        self.names: Records = np.zeros(0, VEHICLE)
        self.size = self.vehicles = 0
        self._slots: IntArray = np.full(LEAST, NONE, np.int64)
        self._known: IntArray = np.full(LEAST, NONE, np.int64)
        self.hour = 0  # whose pairs were dropped last

    @staticmethod
    def of(state: State, peers: Records, names: Records, size: int, vehicles: int, hour: int) -> Stores:
        """Stores with these contents."""
        stores = Stores()
        stores.state, stores.peers, stores.names = state, peers, names
        stores.size, stores.vehicles, stores.hour = size, vehicles, hour
        stores._slots = grown(state.cells, size, size)
        stores._known = grown(names, vehicles, vehicles)
        return stores

    @property
    def live(self) -> Cells:
        """The slots by columns."""
        return cells_of(self.state.belief, self.state.cells)

    @property
    def waiting(self) -> int:
        """Entries in use."""
        return len(self.state.free_entries) - int(self.state.used[FREE_ENTRIES])

    def due_windows(self, before: int) -> tuple[IntArray, IntArray]:
        """Windows with entries before `before` [ns]: those without a value, and those with one in the order of cells.

        Values that pass the checkpoint meet others, which is what reputation is made of; so their order may not depend
        on who came first. All else is done in the order of memory.
        """
        quiet, talking = due(self.state.windows, before)
        return quiet, talking[np.argsort(self.state.cells["key"][self.state.windows["slot"][talking]])]

    def slots_of(self, keys: IntArray) -> IntArray:
        """Slot of each key, NONE where there is none."""
        return rows_of(self._slots, self.state.cells, np.asarray(keys, np.int64))

    def slots_for(self, keys: IntArray) -> IntArray:
        """Slot of each key; new ones begin with the prior."""
        slots = self.slots_of(keys)
        new = np.flatnonzero(slots == NONE)
        if not len(new):
            return slots
        most = self.size + len(distinct(keys[new]))
        if is_full(most, len(self._slots), ROWS_MOST):
            self._slots = grown(self.state.cells, self.size, most)
        if most > len(self.state.cells):
            rows = max(most, 2 * len(self.state.cells))
            belief, cells = _longer(self.state.belief, rows), _longer(self.state.cells, rows)
            self.state = self.state._replace(belief=belief, cells=cells)
        slots[new], self.size = slots_for(self._slots, self.state.belief, self.state.cells, keys[new], self.size)
        return slots

    def known(self, vehicle: IntArray) -> IntArray:
        """Index of each vehicle, NONE for an unknown one."""
        return rows_of(self._known, self.names, vehicle)

    def vehicles_of(self, vehicle: IntArray) -> IntArray:
        """Index of each vehicle; an unknown one gets the next."""
        index = self.known(vehicle)
        if not len(index) or index.min() != NONE:
            return index
        most = self.vehicles + len(distinct(vehicle[index == NONE]))
        if is_full(most, len(self._known), ROWS_MOST):
            self._known = grown(self.names, self.vehicles, most)
        if most > len(self.names):
            rows = max(most, 2 * len(self.names))
            self.names, peers = _longer(self.names, rows), no_peers(rows)
            peers[: len(self.peers)] = self.peers
            self.peers = peers
        index, self.vehicles = numbered(self._known, self.names, vehicle, self.vehicles)
        return index

    def reserve(self, rows: int) -> None:
        """Make room for the votes of a batch in every pool."""
        used = self.state.used
        if used[FREE_ENTRIES] < rows:
            self._more_entries(self.waiting + rows)
        if used[FREE_WINDOWS] < rows:
            self._more_windows(len(self.state.free_windows) - int(used[FREE_WINDOWS]) + rows)
        if used[VOICES] + rows > len(self.state.voices):
            most = max(int(used[VOICES]) + rows, 2 * len(self.state.voices))
            self.state = self.state._replace(voices=_longer(self.state.voices, most))
        if is_full(int(used[PAIRS]) + rows, len(self.state.pairs), PAIRS_MOST):
            self._rebuild_pairs(0, int(used[PAIRS]) + rows)

    def _more_entries(self, most: int) -> None:
        entries = _longer(self.state.entries, max(2 * len(self.state.entries), most))
        free = _restacked(self.state.free_entries, self.state.used, FREE_ENTRIES, len(entries))
        self.state = self.state._replace(entries=entries, free_entries=free)

    def _more_windows(self, most: int) -> None:
        old, rows = self.state, max(2 * len(self.state.windows), most)
        windows = _longer(old.windows, rows)
        windows["slot"][len(old.windows) :] = NONE
        self.state = old._replace(
            windows=windows, kept=_longer(old.kept, rows), kept_belief=_longer(old.kept_belief, rows),
            kept_voices=_longer(old.kept_voices, rows),
            free_windows=_restacked(old.free_windows, old.used, FREE_WINDOWS, rows),
        )  # fmt: skip

    def forget(self, checkpoint_s: int) -> None:
        """Once in an hour of the checkpoint drop what nobody asks for any more: what vehicles said FORGOTTEN_S before
        it (`votes.recall`), speakers and witnesses of an hour before it (`trust.meet`, `Fusion.witnesses`)."""
        hour = checkpoint_s - checkpoint_s % _HOUR
        if hour != self.hour:
            self.hour = hour
            self._rebuild_pairs(hour - int(c.FORGOTTEN_S), 0)
            self._rebuild_voices(hour - _HOUR - _AHEAD)

    def _rebuild_pairs(self, least: int, most: int) -> None:
        """Drop pairs last heard before `least` [s], and make room for `most`."""
        state = self.state
        old = state.pairs
        count = staying(old, least)
        new = _no_pairs(room(max(count, most), PAIRS_MOST))
        gone = moved(state.entries, old, new, least)
        mark_returned(state.cells, state.kept, old["slot"][gone], self.names["key"][old["vehicle"][gone]])
        state.used[PAIRS] = count
        self.state = state._replace(pairs=new)

    def _rebuild_voices(self, least: int) -> None:
        """Drop voices that were last heard before `least` [s], but for those of a window."""
        cells, old = self.state.cells[: self.size], self.state.voices
        slots = np.flatnonzero(cells["voice"] != NONE)
        voice = cells["voice"][slots]
        heard = np.maximum(old["spoke"].max(axis=1, initial=0), old["witnessed"].max(axis=(1, 2), initial=0))
        stay = (heard[voice] >= least) | (cells["window"][slots] != NONE)
        cells["voice"][slots] = NONE
        cells["voice"][slots[stay]] = np.arange(stay.sum())
        self.state.used[VOICES] = stay.sum()
        self.state = self.state._replace(voices=old[voice[stay]])


def distinct(values: IntArray) -> IntArray:
    """Each value once, ascending; by sorting, which for numbers of this kind is several times faster than a set."""
    ordered = np.sort(values)
    return np.asarray(ordered[np.append(np.ones(len(ordered[:1]), bool), ordered[1:] != ordered[:-1])])


def _no_pairs(places: int) -> Records:
    pairs = rows_of_lines(places, PAIR)
    pairs["slot"] = NONE
    return pairs


Array = TypeVar("Array", bound=NDArray[Any])


def _longer(old: Array, rows: int) -> Array:
    new = rows_of_lines(rows, old.dtype, *old.shape[1:])
    new[: len(old)] = old
    return new  # type: ignore[return-value] # of the very type of `old`


def _restacked(old: Int32Array, used: IntArray, which: int, rows: int) -> Int32Array:
    """Free rows of a grown pool: those of the old one, and the new ones; counted in `used[which]`."""
    count, more = int(used[which]), rows - len(old)
    new = np.zeros(rows, np.int32)
    new[:count] = old[:count]
    new[count : count + more] = np.arange(len(old), rows)
    used[which] = count + more
    return new
