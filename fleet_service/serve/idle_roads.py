"""Limit on alerts that two vehicles raise alone, on roads without other vehicles. Pure (no I/O).

Two enrolled vehicles that collude could report ice anywhere along plausible paths. On a road with
other traffic, other vehicles contradict them; on an idle road, which no third vehicle has reported,
nobody does. Therefore each vehicle may support such alerts in at most MOST_AREAS areas of AREA_M
within AREA_NS. Beyond this limit a third vehicle is needed; until then the map shows the ice, but
no alert is raised.
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
    """Record of the areas in which each vehicle has recently supported alerts on idle roads (roads
    that no third vehicle has reported).
    """

    def __init__(self) -> None:
        self._areas: dict[int, list[tuple[int, FloatArray]]] = {}

    def admit(self, cell: int, witnesses: Sequence[int], time: int, needed: int) -> bool:
        """Return True if an alert on an idle road may be raised; in this case, record the area for
        its supporting vehicles.

        Args:
            cell: cell of the alert.
            witnesses: numbers of the vehicles that support the alert.
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
