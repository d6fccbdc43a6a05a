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

from typing import Annotated, Final

import numpy as np
from numpy.typing import NDArray

from schemas.numeric import BoolArray, Float32Array, FloatArray, IntArray
from schemas.runtime.jit import refcount_free_locked
from schemas.runtime.records import RecordArray, records
from schemas.thresholds import METRES_PER_DEGREE, NS

# [m/s] Faster than any road vehicle, even with the error of its clock.
FASTEST: Final = 70.0
LEAP_M: Final = 2_000.0  # [m] budget for jumps of the position after a tunnel or a ferry
LEAP_M_PER_S: Final = 0.5  # [m/s] rate at which this budget is refilled
ANCHORS: Final = 16  # remembered points of a path; they take 288 bytes per vehicle
VEHICLES: Final = 200_000  # largest number of vehicles that are remembered
# [ns] Added to the age of an anchor. Without it, the newest anchors would count as infinitely
# dense.
_RECENT_NS: Final = 10 * NS
# [m] Largest plausible detour between two anchors, beyond the straight line, if one was dropped
# there.
_DETOUR_M: Final = 2_000.0
_START: Final = 64  # number of vehicles for which memory is allocated at the start

Place = FloatArray | Float32Array


class PathRecord:
    """Path of one vehicle.

    Attributes:
        count: number of anchors.
        leap: rest of the budget for jumps [m].
        time: times of the anchors [ns], ascending.
        place: latitudes and longitudes of the anchors [deg].
        is_gap: 1 if an anchor after this one was dropped.
    """

    count: int
    leap: float
    time: Annotated[IntArray, ANCHORS]
    place: Annotated[Float32Array, ANCHORS, 2]
    is_gap: Annotated[NDArray[np.int8], ANCHORS]


class VehiclePaths:
    """Recent path (times and places) of each vehicle since the start of the service."""

    def __init__(self) -> None:
        self._rows: dict[int, int] = {}  # row of each vehicle in the array of paths
        self._paths = records(PathRecord, _START)

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
            self._paths = records(PathRecord, _START)
        row = np.array(
            [self._rows.setdefault(name, len(self._rows)) for name in names.tolist()], np.int64
        )
        while len(self._rows) > len(self._paths):
            self._paths = np.concatenate([self._paths, records(PathRecord, len(self._paths))])
        place = np.column_stack([latitude, longitude]).astype(np.float64)
        out = np.zeros(len(place), np.bool_)
        _find_implausible(row[inverse], np.asarray(time, np.int64), place, self._paths, out)
        return out


@refcount_free_locked
def _find_implausible(
    row: IntArray, time: IntArray, place: FloatArray, paths: RecordArray, out: BoolArray
) -> None:
    """Find the rows that are implausible for their vehicle's path, and add the plausible rows to
    the paths. This is the compiled part of `VehiclePaths.find_implausible`.

    `row` (n,) is the number of the vehicle's path, `time` (n,) in ns, `place` (n, 2) in degrees.
    The mask `out` (n,), False at first, becomes True for implausible rows.
    """
    for n in range(len(row)):
        path = paths[row[n]]
        count = path.count
        if count == 0:
            path.leap = LEAP_M
        after = count  # number of anchors that are not later
        while after > 0 and path.time[after - 1] > time[n]:
            after -= 1
        excess = _excess_at(paths, row[n], after, time[n], place[n])
        if after == count and count > 0:
            refilled = LEAP_M_PER_S * (time[n] - path.time[count - 1]) / NS
            path.leap = min(LEAP_M, path.leap + refilled)
        if excess > path.leap:
            out[n] = True
            continue
        path.leap -= excess
        if count == ANCHORS:
            dropped = _least_needed(path.time)
            _drop_anchor(paths, row[n], dropped)
            after -= after > dropped
        _insert_anchor(paths, row[n], after, time[n], place[n])


@refcount_free_locked
def _excess_at(paths: RecordArray, row: int, after: int, time: int, place: FloatArray) -> float:
    """Return by how much the place (2,) [deg] at `time` [ns] is too far [m] from the neighbouring
    anchors of a path, of which `after` anchors are earlier. The result is 0 for a plausible place,
    and infinite for a place far from the line between two anchors with a gap.
    """
    path = paths[row]
    excess = 0.0
    if after > 0:
        excess = _excess_distance(time - path.time[after - 1], path.place[after - 1], place)
    if after < path.count:
        excess = max(excess, _excess_distance(path.time[after] - time, path.place[after], place))
    if 0 < after < path.count and path.is_gap[after - 1]:
        start = path.place[after - 1]
        end = path.place[after]
        detour = _distance_m(start, place) + _distance_m(place, end) - _distance_m(start, end)
        if detour > _DETOUR_M:
            return np.inf
    return excess


@refcount_free_locked
def _drop_anchor(paths: RecordArray, row: int, dropped: int) -> None:
    """Remove one anchor of a path, which is neither the first nor the last."""
    path = paths[row]
    path.is_gap[dropped - 1] = 1
    path.count -= 1
    for k in range(dropped, path.count):
        _copy_anchor(paths, row, k + 1, k)


@refcount_free_locked
def _insert_anchor(paths: RecordArray, row: int, after: int, time: int, place: FloatArray) -> None:
    """Insert an anchor with the given time [ns] and place (2,) [deg] into a path, behind its first
    `after` anchors.
    """
    path = paths[row]
    for k in range(path.count, after, -1):
        _copy_anchor(paths, row, k - 1, k)
    path.time[after] = time
    path.place[after, 0] = place[0]
    path.place[after, 1] = place[1]
    path.is_gap[after] = path.is_gap[after - 1] if 0 < after < path.count else 0
    path.count += 1


@refcount_free_locked
def _copy_anchor(paths: RecordArray, row: int, source: int, to: int) -> None:
    path = paths[row]
    path.time[to] = path.time[source]
    path.place[to, 0] = path.place[source, 0]
    path.place[to, 1] = path.place[source, 1]
    path.is_gap[to] = path.is_gap[source]


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
def _excess_distance(elapsed_ns: int, start: Place, end: Place) -> float:
    """Return the distance between two places (2,) [deg] minus the distance that a vehicle covers at
    the speed FASTEST in the time `elapsed_ns` [ns]. The result is in metres, at least 0.
    """
    return max(_distance_m(start, end) - FASTEST * elapsed_ns / NS, 0.0)


@refcount_free_locked
def _distance_m(start: Place, end: Place) -> float:
    """Return the distance [m] between two places (2,) [deg], the shorter way around the earth."""
    north = end[0] - start[0]
    east = (end[1] - start[1] + 180.0) % 360.0 - 180.0
    return float(np.hypot(north, east * np.cos(np.radians(end[0])))) * METRES_PER_DEGREE
