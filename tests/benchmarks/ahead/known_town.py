"""Map of a scenario's roads as a fleet that visited every place would know it, computed from the
true friction.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from edge_agent.ahead.local_map import MEASURED, LocalMap, ReceivedCells, belief_of
from edge_agent.lab.simulation.roads import LanePoint
from edge_agent.lab.simulation.scenarios import Scenario
from schemas import grid, mugrid
from schemas.numeric import FloatArray, IntArray
from schemas.thresholds import SLIPPERY_MU, Z_95

VEHICLES = 4
SPREAD = 0.06  # standard deviation that the map states for a cell, and that of its actual error


class KnownPlaces(NamedTuple):
    """Friction of the map places on the lanes of a scenario. A map place is a map cell with one of
    four heading sectors. No place occurs twice.

    Attributes:
        key: (n,) cell·4 + heading sector of each place.
        mu: (n,) smallest true friction in each place.
    """

    key: IntArray
    mu: FloatArray


def places_of(scenario: Scenario, t: float) -> KnownPlaces:
    """Return the friction at t [s] in the map places on a scenario's lanes. A map place is a map
    cell with one of four heading sectors.
    """
    points = scenario.network.points
    x = points[:, LanePoint.X]
    y = points[:, LanePoint.Y]
    yaw = np.arctan2(points[:, LanePoint.SIN], points[:, LanePoint.COS])
    key = grid.cell_of(*scenario.to_latlon(x, y)) * grid.SECTORS + grid.sector_of(yaw)
    mu = scenario.friction(t, x, y)
    order = np.lexsort((mu, key))
    first = np.append(True, np.diff(key[order]) > 0)
    return KnownPlaces(key[order][first], mu[order][first])


def map_of_places(
    places: KnownPlaces, now: int, rng: np.random.Generator | None = None
) -> LocalMap:
    """Return the map of a car that has received all `places` from the service at the time `now`
    [ns]. A place is a map cell with one of four heading sectors.

    The friction in the map is the true one. If a random generator `rng` is given, errors of
    standard deviation SPREAD are added.
    """
    off = np.zeros(len(places.key)) if rng is None else rng.normal(0.0, SPREAD, len(places.key))
    mu = np.clip(places.mu + off, mugrid.LOWER + 0.02, mugrid.UPPER - 0.02)
    lower = np.maximum(mu - Z_95 * SPREAD, mugrid.LOWER)
    upper = np.minimum(mu + Z_95 * SPREAD, mugrid.UPPER)
    slippery = np.clip(0.5 + (SLIPPERY_MU - mu) / (3.0 * SPREAD), 0.0, 1.0)
    belief = belief_of(lower, mu, upper, slippery)
    cache = LocalMap(most_cells=1 << 20)
    n = len(places.key)
    cells = ReceivedCells(
        places.key, belief, *(np.full(n, value) for value in (MEASURED, VEHICLES, now, now))
    )
    tiles = grid.tile_of(places.key // grid.SECTORS)
    for tile in np.unique(tiles).tolist():
        cache.store_cells(tile, ReceivedCells._make(column[tiles == tile] for column in cells), now)
    return cache
