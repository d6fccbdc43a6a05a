"""Limits per vehicle, in addition to the limit on its bytes per second: number of new cells, and
number of streams (batches of one vehicle, start, kind and region). Pure except for the counts.

A row beyond its vehicle's limit is archived and acknowledged like any other, but does not reach the
map. So no data are lost and nothing is sent again, but a single car cannot fill the service's
memory.
"""

from __future__ import annotations

from typing import Final

import numpy as np

from schemas.numeric import BoolArray, IntArray

# New cells (visited by no other vehicle) that a vehicle may report. A car on new roads passes 3
# cells of 10 m per second; 14,000 per hour allow for that. A cell takes 1 kB of memory.
NEW_CELLS_PER_HOUR: Final = 14_000.0
# An hour on such roads: after an outage of the service, a backlog of an hour still reaches the map.
NEW_CELLS_AT_ONCE: Final = 11_000.0
# Such cells are stored for a week. The limit allows 1,000 km of new roads per week, which take 100
# MB.
NEW_CELLS_PER_WEEK: Final = 100_000
# A vehicle opens two streams per region, one of each kind, and enters a region per quarter of an
# hour. The rest is for restarts of the agent after an outage.
STREAMS_PER_HOUR: Final = 60.0
STREAMS_AT_ONCE: Final = 120.0
VEHICLES: Final = 200_000  # largest number of vehicles that are remembered
HOUR: Final = 3600.0
WEEK_HOURS: Final = 168.0


class TokenBuckets:
    """Token buckets, one per vehicle. A vehicle may use the amount in its bucket at once; the
    bucket is refilled at a constant rate per hour.
    """

    def __init__(self, at_once: float, per_hour: float) -> None:
        self._at_once = at_once
        self._rate = per_hour / HOUR
        self._left: dict[int, tuple[float, float]] = {}

    def take(self, vehicle: int, requested: int, now: float) -> int:
        """Take up to `requested` units of a vehicle's remaining allowance at time `now` [s]; return
        the number of units taken.
        """
        remaining, since = self._left.get(vehicle, (self._at_once, now))
        remaining = min(self._at_once, remaining + max(now - since, 0.0) * self._rate)
        granted = min(requested, int(remaining))
        if len(self._left) >= VEHICLES:
            self._left.clear()
        self._left[vehicle] = (remaining - granted, now)
        return granted


class NewCells:
    """Limit per vehicle on reports about new cells, that is, cells that no vehicle has reported
    before.
    """

    def __init__(self, at_once: float = NEW_CELLS_AT_ONCE) -> None:
        self._budgets = TokenBuckets(at_once, NEW_CELLS_PER_HOUR)
        self._week = TokenBuckets(NEW_CELLS_PER_WEEK, NEW_CELLS_PER_WEEK / WEEK_HOURS)

    def find_excess(self, vehicle: IntArray, cell: IntArray, now: float) -> BoolArray:
        """Return a mask of rows (n,): True if the row is beyond its vehicle's limit on new cells at
        the time `now` [s]. All given rows must be in new cells, that is, cells that no vehicle has
        visited before. Each new cell within the limit reduces the vehicle's remaining allowance.
        """
        out = np.zeros(len(vehicle), bool)
        order = np.lexsort((cell, vehicle))
        who = vehicle[order]
        where = cell[order]
        starts = np.flatnonzero(np.diff(who, prepend=who[:1] - 1))
        counts = np.diff(starts, append=len(who))
        place = np.cumsum(np.diff(where, prepend=where[:1]) != 0)
        place -= np.repeat(place[starts], counts)  # number of the row's cell within its vehicle
        new_cells = place[starts + counts - 1] + 1
        for name, start, count, cells in np.column_stack(
            [who[starts], starts, counts, new_cells]
        ).tolist():
            granted = self._week.take(name, self._budgets.take(name, cells, now), now)
            if granted < cells:
                out[order[start : start + count]] = place[start : start + count] >= granted
        return out
