"""Limit on alerts that two vehicles raise alone, on roads without other vehicles. Pure (no I/O).

Two enrolled vehicles that collude could report ice anywhere along plausible paths. On a road with
other traffic, other vehicles contradict them. A road is idle if fewer than OTHERS_NEEDED (three)
vehicles have ever reported it; no other vehicle contradicts them there.

A vehicle supports an alert if it has reported the ice. On idle roads, the support of a vehicle
counts in at most MOST_AREAS areas of radius AREA_M within AREA_NS. A vehicle that has reached this
limit supports no alert in a further area. Then the map shows the ice, but an alert needs other
vehicles.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Final

import numpy as np

from schemas import grid
from schemas.numeric import FloatArray
from schemas.thresholds import METRES_PER_DEGREE, NS

# A road that fewer distinct vehicles have ever reported is idle.
OTHERS_NEEDED: Final = 3
MOST_AREAS: Final = 2
AREA_M: Final = 1_000.0  # [m] radius of an area around its first alert
# [ns] Time for which an area counts. Roads rarely change within it (fusion.constants.CHANGE_S).
AREA_NS: Final = 3 * 3600 * NS
VEHICLES: Final = 100_000  # largest number of vehicles that are remembered


class IdleRoads:
    """Record of the areas in which each vehicle has recently supported alerts on idle roads. A
    vehicle supports an alert by reporting the ice. A road is idle if fewer than OTHERS_NEEDED
    vehicles have ever reported it.
    """

    def __init__(self) -> None:
        self._areas: dict[int, list[tuple[int, FloatArray]]] = {}

    def admit(self, cell: int, witnesses: Sequence[int], time: int, needed: int) -> bool:
        """Return True if an alert on an idle road (a road that fewer than OTHERS_NEEDED vehicles
        have ever reported) may be raised. In this case, record the area for the vehicles that
        support the alert.

        Args:
            cell: cell of the alert.
            witnesses: numbers of the vehicles that support the alert, that is, have reported the
                ice.
            time: time of the alert [ns].
            needed: minimum number of supporting vehicles that have not reached their limit.
        """
        place = np.array(grid.centre(cell), float)
        able = [vehicle for vehicle in witnesses if self._has_area(vehicle, place, time)]
        if len(able) < needed:
            return False
        if len(self._areas) > VEHICLES:
            self._areas.clear()
        for vehicle in able:
            areas = self._areas.setdefault(vehicle, [])
            if not _is_within(areas, place):
                areas.append((time, place))
        return True

    def _has_area(self, vehicle: int, place: FloatArray, time: int) -> bool:
        areas = [area for area in self._areas.get(vehicle, []) if abs(time - area[0]) < AREA_NS]
        if vehicle in self._areas:
            self._areas[vehicle] = areas
        return len(areas) < MOST_AREAS or _is_within(areas, place)


def _is_within(areas: Sequence[tuple[int, FloatArray]], place: FloatArray) -> bool:
    for _, centre in areas:
        north = place[0] - centre[0]
        east = (place[1] - centre[1] + 180.0) % 360.0 - 180.0
        if np.hypot(north, east * np.cos(np.radians(place[0]))) * METRES_PER_DEGREE <= AREA_M:
            return True
    return False
