"""Roads for the tests of the road ahead: straight lines of known cells near Gothenburg."""

from __future__ import annotations

import math

import numpy as np

from edge_agent.ahead import local_map, path
from edge_agent.ahead.local_map import LocalMap, ReceivedCells
from edge_agent.ahead.path import Pose
from schemas import grid
from schemas.numeric import FloatArray, IntArray
from schemas.thresholds import NS
from schemas.wire import Alert

NOW = 1_790_000_000 * NS
HOME = Pose(57.7, 11.97, 0.3, 14.0, NOW)


def line(
    length: float = 400.0, yaw: float = HOME.yaw, start: float = 0.0
) -> tuple[FloatArray, FloatArray]:
    """Return latitude and longitude [deg] of the points (n,) of a straight road through the car's
    position, one point per metre.

    Args:
        length: distance of the last point from the car [m].
        yaw: direction of the road [rad].
        start: distance of the first point from the car [m].
    """
    s = np.arange(start, length)
    return path.to_degrees(s * math.cos(yaw), s * math.sin(yaw), HOME)


def keys_on(length: float = 400.0, yaw: float = HOME.yaw, start: float = 0.0) -> IntArray:
    """Return the keys (n,) of the cells along the road that `line` returns. A key is 4 · cell
    number + heading sector. Each key occurs once; the keys are in driving order.
    """
    key = grid.cell_of(*line(length, yaw, start)) * grid.SECTORS + int(grid.sector_of(yaw))
    return key[np.sort(np.unique(key, return_index=True)[1])]


def cells(
    key: IntArray, mu: float, *, width: float = 0.1, basis: int = local_map.MEASURED, at: int = NOW
) -> ReceivedCells:
    """Return cells with the keys `key` in the form in which a car receives them. All have the
    friction `mu`, an interval of ± `width`, and the kind of evidence `basis`, such as MEASURED.
    """
    median = np.full(len(key), mu)
    is_below = [mu - width <= 0.4, mu + width < 0.4]
    p_slippery = np.full(len(key), np.mean(is_below))
    belief = local_map.belief_of(median - width, median, median + width, p_slippery)
    return ReceivedCells(
        key,
        belief,
        np.full(len(key), basis),
        np.full(len(key), 3),
        np.full(len(key), at),
        np.full(len(key), at),
    )


def make_local_map(parts: list[ReceivedCells]) -> LocalMap:
    """Return a car's local map that contains the given cells."""
    cache = LocalMap()
    for part in parts:
        for tile in np.unique(grid.tile_of(part.key // grid.SECTORS)).tolist():
            inside = grid.tile_of(part.key // grid.SECTORS) == tile
            cache.store_cells(tile, ReceivedCells._make(column[inside] for column in part), NOW)
    return cache


def alert(key: int, *, raised: bool = True, time: int = NOW) -> Alert:
    """Return an alert of ice for the cell and heading sector of `key` (cell · 4 + heading
    sector).
    """
    cell, sector = divmod(int(key), grid.SECTORS)
    latitude, longitude = grid.centre(cell)
    return Alert(
        cell,
        sector,
        raised,
        time,
        0.15,
        0.1,
        0.22,
        0.98,
        3,
        float(latitude),
        float(longitude),
        "P(mu < 0.4)",
    )
