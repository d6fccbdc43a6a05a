"""Check of each vehicle's path for plausibility: the vehicle must be able to have been at all the
places that it reports. Pure (no I/O).

A vehicle's path is a list of at most ANCHORS "anchors" (time and place), over all its batches,
starts and regions. A report is plausible if the vehicle could drive from the previous anchor to it,
and from it to the next anchor, at no more than the speed FASTEST. Positions jump when satellite
reception returns after a tunnel or a ferry. Therefore a vehicle has a budget of LEAP_M metres for
jumps. This budget refills slowly, so that a vehicle cannot jump with every row.

Reports may come in any order, for example old reports between live ones. When a path is full, one
anchor is dropped, preferably an old one. Therefore old anchors are farther apart than new ones. A
report whose time lies between two distant anchors must be near the straight line between them,
because the vehicle's actual path in between is no longer known.
"""

from __future__ import annotations

from typing import Final

import numpy as np

from schemas.numeric import BoolArray, Float32Array, FloatArray, IntArray
from schemas.runtime.jit import refcount_free_locked
from schemas.thresholds import METRES_PER_DEGREE, NS

# [m/s] Faster than any road vehicle, even with the error of its clock.
FASTEST: Final = 70.0
LEAP_M: Final = 2_000.0  # [m] budget for jumps of the position after a tunnel or a ferry
LEAP_M_PER_S: Final = 0.5  # [m/s] rate at which this budget is refilled
ANCHORS: Final = 16  # remembered points of a path; they take 280 bytes per vehicle
VEHICLES: Final = 200_000  # largest number of vehicles that are remembered
# [ns] Added to the age of an anchor. Without it, the newest anchors would count as infinitely
# dense.
_RECENT_NS: Final = 10 * NS
# [m] Largest plausible detour between two anchors, beyond the straight line, if one was dropped
# there.
_DETOUR_M: Final = 2_000.0
_START: Final = 64  # number of vehicles for which memory is allocated at the start


class VehiclePaths:
    """Recent path (times and places) of each vehicle since the start of the service."""

    def __init__(self) -> None:
        self._rows: dict[int, int] = {}  # row of each vehicle in the arrays
        self._make_room(_START)

    def _make_room(self, rows: int) -> None:
        self._time: IntArray = np.zeros((rows, ANCHORS), np.int64)
        self._place: Float32Array = np.zeros((rows, ANCHORS, 2), np.float32)
        # True if an anchor after this one was dropped
        self._is_gap: BoolArray = np.zeros((rows, ANCHORS), np.bool_)
        self._count: IntArray = np.zeros(rows, np.int64)
        self._leap: FloatArray = np.full(rows, LEAP_M)

    def find_implausible(
        self, vehicle: IntArray, time: IntArray, latitude: FloatArray, longitude: FloatArray
    ) -> BoolArray:
        """Return a mask of rows (n,): True if the vehicle cannot have been at the reported place.
        `time` is in ns, places in degrees. Plausible rows extend the paths.

        The rows of a vehicle must be adjacent, in the order of their arrival.
        """
        names, inverse = np.unique(vehicle, return_inverse=True)
        if len(self._rows) + len(names) > max(VEHICLES, len(names)):
            self._rows.clear()
            self._make_room(_START)
        row = np.array(
            [self._rows.setdefault(name, len(self._rows)) for name in names.tolist()], np.int64
        )
        while len(self._rows) > len(self._count):
            self._grow()
        place = np.column_stack([latitude, longitude]).astype(np.float64)
        out = np.zeros(len(place), np.bool_)
        paths = (self._time, self._place, self._is_gap, self._count, self._leap)
        _find_implausible(row[inverse], np.asarray(time, np.int64), place, paths, out)
        return out

    def _grow(self) -> None:
        time = self._time
        place = self._place
        is_gap = self._is_gap
        count = self._count
        leap = self._leap
        rows = len(count)
        self._make_room(2 * rows)
        self._time[:rows] = time
        self._place[:rows] = place
        self._is_gap[:rows] = is_gap
        self._count[:rows] = count
        self._leap[:rows] = leap


Paths = tuple[IntArray, Float32Array, BoolArray, IntArray, FloatArray]


@refcount_free_locked
def _find_implausible(
    row: IntArray, time: IntArray, place: FloatArray, paths: Paths, out: BoolArray
) -> None:
    """Find the rows that are implausible for their vehicle's path, and add the plausible rows to
    the paths. This is the compiled part of `VehiclePaths.find_implausible`.

    `row` (n,) is the number of the vehicle's path, `time` (n,) in ns, `place` (n, 2) in degrees.
    The mask `out` (n,), False at first, becomes True for implausible rows.
    """
    anchors, places, is_gap, count, leap = paths
    for n in range(len(row)):
        v = row[n]
        t = time[n]
        held = count[v]
        after = held
        while after > 0 and anchors[v, after - 1] > t:
            after -= 1
        excess = 0.0
        if after > 0:
            excess = _excess_distance(t - anchors[v, after - 1], places[v, after - 1], place[n])
        if after < held:
            excess = max(
                excess, _excess_distance(anchors[v, after] - t, places[v, after], place[n])
            )
        if 0 < after < held and is_gap[v, after - 1]:
            gap_start = places[v, after - 1]
            gap_end = places[v, after]
            detour = (
                _distance_m(gap_start, place[n])
                + _distance_m(place[n], gap_end)
                - _distance_m(gap_start, gap_end)
            )
            if detour > _DETOUR_M:
                excess = np.inf
        if after == held and held > 0:
            leap[v] = min(LEAP_M, leap[v] + LEAP_M_PER_S * (t - anchors[v, held - 1]) / NS)
        if excess > leap[v]:
            out[n] = True
            continue
        leap[v] -= excess
        if held == ANCHORS:
            dropped = _least_needed(anchors[v])
            is_gap[v, dropped - 1] = True
            for k in range(dropped, ANCHORS - 1):
                anchors[v, k] = anchors[v, k + 1]
                places[v, k, 0] = places[v, k + 1, 0]
                places[v, k, 1] = places[v, k + 1, 1]
                is_gap[v, k] = is_gap[v, k + 1]
            held -= 1
            after -= after > dropped
        for k in range(held, after, -1):
            anchors[v, k] = anchors[v, k - 1]
            places[v, k, 0] = places[v, k - 1, 0]
            places[v, k, 1] = places[v, k - 1, 1]
            is_gap[v, k] = is_gap[v, k - 1]
        anchors[v, after] = t
        places[v, after, 0] = place[n, 0]
        places[v, after, 1] = place[n, 1]
        is_gap[v, after] = after > 0 and after < held and is_gap[v, after - 1]
        count[v] = held + 1


@refcount_free_locked
def _least_needed(anchors: IntArray) -> int:
    """Return the index of the path's anchor (time and place) that can be dropped with the least
    loss, given the anchors' times (ANCHORS,) [ns]. It is the anchor with the shortest time between
    its two neighbours, relative to its age. The first and the last anchor stay.
    """
    newest = anchors[-1]
    best = 1
    least = np.inf
    for k in range(1, len(anchors) - 1):
        gap = (anchors[k + 1] - anchors[k - 1]) / float(newest - anchors[k] + _RECENT_NS)
        if gap < least:
            best = k
            least = gap
    return best


@refcount_free_locked
def _excess_distance(elapsed_ns: int, start: Float32Array, end: FloatArray) -> float:
    """Return the distance between two places (2,) [deg] minus the distance that a vehicle covers at
    the speed FASTEST in the time `elapsed_ns` [ns]. The result is in metres, at least 0.
    """
    return max(_distance_m(start, end) - FASTEST * elapsed_ns / NS, 0.0)


@refcount_free_locked
def _distance_m(start: Float32Array, end: FloatArray | Float32Array) -> float:
    """Return the distance [m] between two places (2,) [deg], the shorter way around the earth."""
    north = end[0] - start[0]
    east = (end[1] - start[1] + 180.0) % 360.0 - 180.0
    return float(np.hypot(north, east * np.cos(np.radians(end[0])))) * METRES_PER_DEGREE
