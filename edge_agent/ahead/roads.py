"""Roads visible in the map: sequences of places (cell and sector) that vehicles visited one after
the other.

Place B follows place A on two conditions: B lies within about two cells in front of A, and the
sector of B is a possible heading for a vehicle that comes from A. At a fork all roads are followed,
the straightest first. The straightest road is extended straight on beyond its last known place,
because the car requests the map only along its paths.
"""

from __future__ import annotations

import math
from typing import Final

import numpy as np

from edge_agent.ahead.path import CORRIDOR_M, NONE, Path, Pose, path_along, to_plane
from schemas import grid
from schemas.numeric import IntArray

# [cell sides] largest distance between successive places of a road. The next place is the next cell
# or a diagonal neighbour, or one cell is skipped because no position fell into it.
LINK_CELLS: Final = 2.3
BEGIN_CELLS: Final = 1.6  # [cell sides] largest distance from the car to the first place
# [rad] largest angle between two successive links: the right angle of a junction within one cell.
TURN: Final = math.radians(95.0)
# [rad] largest angle between a link and the heading sector to which it leads. It is half a sector
# (45 degrees), and the error from using cell centres.
LEAN: Final = math.radians(70.0)
# [rad] links whose directions differ by more lead to different roads
FORK: Final = math.radians(50.0)
MOST_WAYS: Final = 3
LEAST_OWN: Final = 2  # number of places that a road must not share with the other roads
MOST_STEPS: Final = 120
STEP_M: Final = 10.0  # [m] about one cell


def ways_on(pose: Pose, keys: IntArray, length: float) -> list[Path]:
    """Return the possible paths ahead along the places in the map (one per cell and heading
    sector), given by their keys `keys` (n,). Each path is at most `length` [m] long.

    The list is empty if the map contains no place close ahead of the car.
    """
    latitude, longitude = grid.centre(keys // grid.SECTORS)
    x, y = to_plane(latitude, longitude, pose)
    near = np.hypot(x, y) <= length
    places = dict(
        zip(keys[near].tolist(), zip(x[near].tolist(), y[near].tolist(), strict=True), strict=True)
    )
    west, _, east, _ = (
        float(side) for side in grid.bounds(grid.cell_of(pose.latitude, pose.longitude))
    )
    side = (east - west) * math.cos(math.radians(pose.latitude)) * 111e3
    by_cell: dict[tuple[int, int], list[int]] = {}
    for key, (px, py) in places.items():
        by_cell.setdefault((math.floor(px / side), math.floor(py / side)), []).append(key)
    graph = _Neighbours(places, by_cell, side)
    begin = graph.next_places((0.0, 0.0), pose.yaw, BEGIN_CELLS)
    if not begin:
        return []
    ways = [[begin[0]]]
    done: list[list[int]] = []
    while ways and len(done) < MOST_WAYS:
        done.append(_follow_way(graph, ways.pop(0), pose, length, ways))
    _remove_joining_ways(done)
    return [_as_path(way, places, pose, length, beyond=k == 0) for k, way in enumerate(done)]


def _remove_joining_ways(ways: list[list[int]]) -> None:
    """Remove ways that have almost no places of their own, in place, the last ones first: they join
    another way, or end where another way bends. A single way stays.
    """
    if len(ways) == 1:
        return
    for way in reversed(ways.copy()):
        other_ways = [other for other in ways if other is not way]
        if len(set(way).difference(*other_ways)) < LEAST_OWN:
            ways.remove(way)


class _Neighbours:
    def __init__(
        self,
        places: dict[int, tuple[float, float]],
        by_cell: dict[tuple[int, int], list[int]],
        side: float,
    ) -> None:
        self.places = places
        self._by_cell = by_cell
        self.side = side

    def next_places(self, here: tuple[float, float], heading: float, cells: float) -> list[int]:
        """Return the map places that may follow the position `here` [m] on a road, the most likely
        first. At a fork, one place per road is returned.

        A place is a map cell together with one of four sectors of the driving direction; its key is
        cell·4 + sector. The vehicle's heading is `heading` [rad]. The places lie at most `cells`
        cell widths away.
        """
        reach = cells * self.side
        found = []
        column = math.floor(here[0] / self.side)
        row = math.floor(here[1] / self.side)
        wide = math.ceil(cells)
        for i in range(column - wide, column + wide + 1):
            for j in range(row - wide, row + wide + 1):
                for key in self._by_cell.get((i, j), ()):
                    dx = self.places[key][0] - here[0]
                    dy = self.places[key][1] - here[1]
                    distance = math.hypot(dx, dy)
                    if not 0.3 * self.side < distance <= reach:
                        continue
                    link = math.atan2(dy, dx)
                    turn = _angle_between(link, heading)
                    turned = _angle_between(link, (key % grid.SECTORS) * math.pi / 2.0)
                    if turn <= TURN and turned <= LEAN:
                        found.append((distance * (1.0 + 2.0 * turn + 0.5 * turned), key, link))
        chosen: list[tuple[int, float]] = []
        for _, key, link in sorted(found):
            if all(_angle_between(link, other) > FORK for _, other in chosen):
                chosen.append((key, link))
        return [key for key, _ in chosen]


def _follow_way(
    graph: _Neighbours, way: list[int], pose: Pose, length: float, forks: list[list[int]]
) -> list[int]:
    """Follow a road that begins with the places in `way` (keys: cell·4 + sector) over at most
    `length` [m]; append the other branches at forks to `forks`.

    Return the keys of the places along the road.
    """
    run = 0.0
    passed = set(way)
    for _ in range(MOST_STEPS):
        here = graph.places[way[-1]]
        heading = _heading_of_way(way, graph.places, pose)
        onward = [key for key in graph.next_places(here, heading, LINK_CELLS) if key not in passed]
        if not onward or run >= length:
            break
        if len(forks) < MOST_WAYS:
            forks += [[*way, key] for key in onward[1:]]
        run += math.dist(here, graph.places[onward[0]])
        way = [*way, onward[0]]
        passed.add(onward[0])
    return way


def _heading_of_way(way: list[int], places: dict[int, tuple[float, float]], pose: Pose) -> float:
    """Return the mean heading [rad] over the last three steps from place to place on a road. A
    single step would mislead, because the cell centres along an oblique road zigzag.
    """
    last = [(0.0, 0.0), *(places[key] for key in way)][-4:]
    dx = last[-1][0] - last[0][0]
    dy = last[-1][1] - last[0][1]
    return math.atan2(dy, dx) if math.hypot(dx, dy) > 1.0 else pose.yaw


def _as_path(
    way: list[int],
    places: dict[int, tuple[float, float]],
    pose: Pose,
    length: float,
    *,
    beyond: bool,
) -> Path:
    line = np.array([(0.0, 0.0), *(places[key] for key in way)])
    smooth = line.copy()
    smooth[1:-1] = (line[:-2] + line[1:-1] + line[2:]) / 3.0
    known = np.array([way[0], *way])
    if beyond:
        heading = _heading_of_way(way, places, pose)
        metres = np.arange(STEP_M, CORRIDOR_M + 1.0, STEP_M)
        straight = smooth[-1] + metres[:, None] * [math.cos(heading), math.sin(heading)]
        smooth = np.concatenate([smooth, straight])
        known = np.concatenate([known, np.full(len(straight), NONE)])
    return path_along("road", smooth, pose, length, known)


def _angle_between(a: float, b: float) -> float:
    return abs((a - b + math.pi) % (2.0 * math.pi) - math.pi)
