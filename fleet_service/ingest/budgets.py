"""Budgets of one vehicle besides its bytes: new places, and streams. Pure except for the counts.

A row beyond its vehicle's budget, or at an impossible place, is archived and acknowledged like any other, but does not
reach the map. So nothing is lost, nothing is sent again, and no car fills the memory or is in two towns at once.
"""

from __future__ import annotations

from typing import Final

import numpy as np

from schemas.numeric import BoolArray, FloatArray, IntArray
from schemas.runtime.jit import compiled
from schemas.thresholds import METRES_PER_DEGREE, NS

# A car on roads that are all new passes 3 cells of 10 m a second; of such a cell 1 kB is kept.
NEW_CELLS_PER_HOUR: Final = 14_000.0
NEW_CELLS_AT_ONCE: Final = 11_000.0  # an hour on such roads, that a service was away: its backlog reaches the map
# A start, two kinds, and a region every quarter of an hour; after an outage a handful of starts.
STREAMS_PER_HOUR: Final = 60.0
STREAMS_AT_ONCE: Final = 120.0
FASTEST: Final = 70.0  # m/s; no road vehicle, and no error of a clock
LEAP_M: Final = 2_000.0  # of a position that comes back after a tunnel or a ferry's hold
VEHICLES: Final = 200_000  # that are remembered
NEVER: Final = np.iinfo(np.int64).min  # was a vehicle heard that is not known
HOUR: Final = 3600.0


class Bucket:
    """Budgets by vehicle: an amount at once, and an amount per hour."""

    def __init__(self, at_once: float, per_hour: float) -> None:
        self._at_once, self._rate = at_once, per_hour / HOUR
        self._left: dict[int, tuple[float, float]] = {}

    def take(self, vehicle: int, wanted: int, now: float) -> int:
        """Take up to `wanted` from a vehicle's budget; return the amount taken. now [s]."""
        left, since = self._left.get(vehicle, (self._at_once, now))
        left = min(self._at_once, left + max(now - since, 0.0) * self._rate)
        given = min(wanted, int(left))
        if len(self._left) >= VEHICLES:
            self._left.clear()
        self._left[vehicle] = (left - given, now)
        return given


class NewCells:
    """Budgets of cells without earlier visits."""

    def __init__(self, at_once: float = NEW_CELLS_AT_ONCE) -> None:
        self._budgets = Bucket(at_once, NEW_CELLS_PER_HOUR)

    def beyond(self, vehicle: IntArray, cell: IntArray, now: float) -> BoolArray:
        """Return rows (n,) in new cells beyond their vehicle's budget; the others are charged. now [s]."""
        out = np.zeros(len(vehicle), bool)
        order = np.lexsort((cell, vehicle))
        who, where = vehicle[order], cell[order]
        starts = np.flatnonzero(np.diff(who, prepend=who[:1] - 1))
        counts = np.diff(starts, append=len(who))
        place = np.cumsum(np.diff(where, prepend=where[:1]) != 0)
        place -= np.repeat(place[starts], counts)  # number of a row's cell among its vehicle's
        wanted = place[starts + counts - 1] + 1
        for name, start, count, cells in np.column_stack([who[starts], starts, counts, wanted]).tolist():
            given = self._budgets.take(name, cells, now)
            if given < cells:
                out[order[start : start + count]] = place[start : start + count] >= given
        return out


class Tracks:
    """Last place of each vehicle, to check whether it can be at its next one."""

    def __init__(self) -> None:
        self._places: dict[int, int] = {}  # place in the arrays, by vehicle
        self._last_time = np.full(64, NEVER)
        self._last_place = np.zeros((64, 2))

    def impossible(self, vehicle: IntArray, time: IntArray, latitude: FloatArray, longitude: FloatArray) -> BoolArray:
        """Return rows (n,) too far from their vehicle's previous row, in the order of the rows; time [ns]."""
        names, inverse = np.unique(vehicle, return_inverse=True)
        if len(self._places) + len(names) > max(VEHICLES, len(names)):
            self._places.clear()
            self._last_time[:] = NEVER
        at = np.array([self._places.setdefault(name, len(self._places)) for name in names.tolist()], np.int64)
        while len(self._places) > len(self._last_time):
            self._last_time = np.r_[self._last_time, np.full(len(self._last_time), NEVER)]
            self._last_place = np.concatenate([self._last_place, np.zeros_like(self._last_place)])
        place = np.column_stack([latitude, longitude]).astype(float)
        return _impossible(at[inverse], np.asarray(time, np.int64), place, self._last_time, self._last_place)


@compiled
def _impossible(
    vehicle: IntArray, time: IntArray, place: FloatArray, last_time: IntArray, last_place: FloatArray
) -> BoolArray:
    """Compute `Tracks.impossible`; places of rows (n, 2) and of vehicles (k,), (k, 2), which are updated."""
    out = np.zeros(len(vehicle), np.bool_)
    stop = 0
    while stop < len(vehicle):
        start, stop = stop, stop + 1  # a run of one vehicle's rows
        while stop < len(vehicle) and vehicle[stop] == vehicle[start]:
            stop += 1
        v = vehicle[start]
        then, there = last_time[v], last_place[v].copy()
        newest = -1
        for row in range(start, stop):
            out[row] = then != NEVER and _leap(time[row] - then, there, place[row])
            if not out[row]:
                then, there = time[row], place[row]
                if newest < 0 or time[row] > time[newest]:
                    newest = row
        if newest >= 0 and time[newest] >= last_time[v]:
            last_time[v] = time[newest]
            last_place[v] = place[newest]
    return out


@compiled
def _leap(apart: int, there: FloatArray, here: FloatArray) -> bool:
    """Return True if two places (2,) [deg] are farther apart than a vehicle can drive in the time between them [ns]."""
    north, east = here[0] - there[0], (here[1] - there[1] + 180.0) % 360.0 - 180.0  # around the date line the short way
    metres = np.hypot(north, east * np.cos(np.radians(here[0]))) * METRES_PER_DEGREE
    return bool(metres > LEAP_M + FASTEST * abs(apart) / NS)
