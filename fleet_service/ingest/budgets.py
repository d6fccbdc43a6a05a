"""What one valid vehicle may cost beyond its bytes: places that nobody knows yet, and streams. Pure but for the counts.

A row beyond its vehicle's budget, or where the vehicle cannot be, is archived and acknowledged as any other, and does
not reach the map: so nothing is lost, nothing is sent again, and no car fills the memory or is in two towns at once.
"""

from __future__ import annotations

from typing import Final

import numpy as np

from schemas.numeric import BoolArray, FloatArray, IntArray
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
HOUR: Final = 3600.0


class Bucket:
    """Budgets by vehicle: so much at once, and so much an hour."""

    def __init__(self, at_once: float, per_hour: float) -> None:
        self._at_once, self._rate = at_once, per_hour / HOUR
        self._left: dict[int, tuple[float, float]] = {}

    def take(self, vehicle: int, wanted: int, now: float) -> int:
        """How much of what is wanted there is; it is taken. now [s]."""
        left, since = self._left.get(vehicle, (self._at_once, now))
        left = min(self._at_once, left + max(now - since, 0.0) * self._rate)
        given = min(wanted, int(left))
        if len(self._left) >= VEHICLES:
            self._left.clear()
        self._left[vehicle] = (left - given, now)
        return given


class Tracks:
    """Where each vehicle was last, and whether it can be where it says next."""

    def __init__(self) -> None:
        self._last: dict[int, tuple[int, float, float]] = {}

    def impossible(self, vehicle: IntArray, time: IntArray, latitude: FloatArray, longitude: FloatArray) -> BoolArray:
        """Rows (n,) too far from where their vehicle was by the row before, in the order of the rows; time [ns]."""
        out = np.zeros(len(vehicle), bool)
        if not len(vehicle):
            return out
        starts = np.flatnonzero(np.r_[True, np.diff(vehicle) != 0])
        before = np.arange(len(vehicle)) - 1
        far = _too_far(time, latitude, longitude, before)
        for start, stop in zip(starts.tolist(), [*starts[1:].tolist(), len(vehicle)], strict=True):
            name = int(vehicle[start])
            last = self._last.get(name)
            if not far[start + 1 : stop].any():  # as most often: one run, held against the row before it
                wrong = last is not None and _leap(last, time[start], latitude[start], longitude[start])
                out[start:stop] = wrong
            else:
                for row in range(start, stop):
                    here = (int(time[row]), float(latitude[row]), float(longitude[row]))
                    out[row] = last is not None and _leap(last, *here)
                    last = last if out[row] else here
            good = start + np.flatnonzero(~out[start:stop])
            if len(good):
                row = int(good[np.argmax(time[good])])
                if last is None or time[row] >= last[0] or name not in self._last:
                    if len(self._last) >= VEHICLES:
                        self._last.clear()
                    self._last[name] = (int(time[row]), float(latitude[row]), float(longitude[row]))
        return out


def _too_far(time: IntArray, latitude: FloatArray, longitude: FloatArray, before: IntArray) -> BoolArray:
    metres = _metres(latitude - latitude[before], longitude - longitude[before], latitude)
    return np.asarray(metres > LEAP_M + FASTEST * np.abs(time - time[before]) / NS)


def _leap(last: tuple[int, float, float], time: int, latitude: float, longitude: float) -> bool:
    metres = _metres(np.asarray(latitude - last[1]), np.asarray(longitude - last[2]), np.asarray(latitude))
    return bool(metres > LEAP_M + FASTEST * abs(int(time) - last[0]) / NS)


def _metres(north: FloatArray, east: FloatArray, latitude: FloatArray) -> FloatArray:
    """Distance of two places by their differences in degrees [m]; around the date line the short way."""
    east = np.mod(east + 180.0, 360.0) - 180.0
    return np.asarray(np.hypot(north, east * np.cos(np.radians(latitude))) * METRES_PER_DEGREE)
