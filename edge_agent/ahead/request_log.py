"""Choice of the map areas that a car requests, so that a day of driving needs megabytes and not
gigabytes. The module is pure (no I/O).

Each second, the fleet service publishes every changed map tile completely: about 50 kB in a busy
town. A car needs only the part along its path, and not every second, but it needs alerts
immediately. Therefore the car requests narrow boxes along its path, and subscribes to the alerts of
the tiles there.
"""

from __future__ import annotations

from collections import deque
from typing import Final, NamedTuple

import numpy as np

from edge_agent.ahead.path import Path, Pose, to_degrees
from schemas import grid
from schemas.numeric import BoolArray, IntArray
from schemas.thresholds import NS

# [m] margin of a box around the path: about one cell, so that it contains neighbouring lanes,
# position errors and coarse routes.
BESIDE_M: Final = 12.0
# [m^2] largest area of a box. Every answer has 3.2 kB of schema, and a cell has 130 bytes.
AREA_M2: Final = 7000.0
LONGEST_M: Final = 300.0  # [m] maximum length of the path in one box
# [m] distance beyond the horizon that is requested together with it. Without this reserve, the car
# would request ten new metres every second.
FURTHER_M: Final = 300.0
# [s] time after which the map ahead is requested again. Sudden changes arrive as alerts.
REFRESH_S: Final = 300.0
STEP: Final = 4  # [m] distance between the checked points of a path
MOST_BOXES: Final = 128  # maximum number of remembered boxes
MOST_TILES: Final = 6  # largest number of tiles to whose alerts a car subscribes
# [s] time for which the subscription to a tile continues after the tile is no longer ahead. A car
# near a border may cross it repeatedly.
LEAVE_S: Final = 20.0


class Box(NamedTuple):
    """Rectangle of the map: latitudes of its south and north side, longitudes of its west and east
    side [deg].
    """

    west: float
    south: float
    east: float
    north: float


class RequestLog:
    """Log of the last MOST_BOXES boxes (rectangles of the map) that were requested, with the time
    of each request.
    """

    def __init__(self) -> None:
        self._boxes: deque[tuple[Box, int]] = deque(maxlen=MOST_BOXES)

    def request_again(self) -> None:
        """Clear the log of requested boxes, so that everything is requested again after a session
        has been reopened.
        """
        self._boxes.clear()

    def missing_boxes(self, path: Path, pose: Pose, within: float) -> list[Box]:
        """Return the boxes to request now along a path, and record them as requested.

        The result is empty while boxes requested in the last REFRESH_S seconds cover the first
        `within` metres of the path. Otherwise the boxes cover all parts of the path that no
        recently requested box covers.
        """
        latitude, longitude = to_degrees(path.x[::STEP], path.y[::STEP], pose)
        open_ = np.ones(len(latitude), np.bool_)
        for box, at in self._boxes:
            if pose.time - at < REFRESH_S * NS:
                inside = (latitude >= box.south) & (latitude <= box.north)
                open_ &= ~(inside & (longitude >= box.west) & (longitude <= box.east))
        if not open_[: max(int(within / STEP), 1)].any():
            return []
        found = [_box_around(path, first, last, pose) for first, last in _split_path(path, open_)]
        self._boxes.extend((box, pose.time) for box in found)
        return found


class Tiles:
    """Set of map tiles to whose alerts the vehicle subscribes: the tiles on the paths ahead, and
    those that lay ahead less than LEAVE_S seconds ago.
    """

    def __init__(self) -> None:
        self._last_ahead: dict[int, int] = {}  # tile -> last time at which it was ahead [ns UTC]

    @property
    def subscribed_tiles(self) -> list[int]:
        """Return the map tiles to whose alerts the vehicle subscribes."""
        return list(self._last_ahead)

    def update_subscriptions(self, paths: list[Path], pose: Pose) -> tuple[list[int], list[int]]:
        """Update the set of map tiles whose alerts the vehicle needs on the possible paths ahead.
        Return two lists: the tiles to which it must subscribe now, and those from which it must
        unsubscribe.
        """
        here = int(grid.tile_of(grid.cell_of(pose.latitude, pose.longitude)))
        ahead: list[int] = [here]
        for path in paths:
            ahead += _in_order(
                grid.tile_of(grid.cell_of(*to_degrees(path.x[::STEP], path.y[::STEP], pose)))
            )
        needed = list(dict.fromkeys(ahead))[:MOST_TILES]
        fresh = [tile for tile in needed if tile not in self._last_ahead]
        self._last_ahead |= dict.fromkeys(needed, pose.time)
        late = [tile for tile, at in self._last_ahead.items() if pose.time - at > LEAVE_S * NS]
        by_age = sorted(
            (at, tile)
            for tile, at in self._last_ahead.items()
            if tile not in late and tile not in needed
        )
        surplus = len(self._last_ahead) - len(late) - MOST_TILES
        dropped = late + [tile for _, tile in by_age[: max(surplus, 0)]]
        for tile in dropped:
            del self._last_ahead[tile]
        return fresh, dropped


def split_at_antimeridian(box: Box) -> list[Box]:
    """Return the parts of a box on both sides of the 180° meridian, with longitudes from -180° to
    180°; a box that does not cross it is its only part. The map accepts only such boxes.
    """
    shift = 360.0 * np.floor((box.west + 180.0) / 360.0)
    west = float(box.west - shift)
    east = float(box.east - shift)
    if east <= 180.0:
        return [box._replace(west=west, east=east)]
    return [box._replace(west=west, east=180.0), box._replace(west=-180.0, east=east - 360.0)]


def keys_of(box: Box) -> list[int]:
    """Return the regions (zoom-10 grid squares, by number) that a box (rectangle of the map)
    overlaps, each once. The box lies between the longitudes -180° and 180°.
    """
    east = np.nextafter(box.east, box.west)  # a region that begins at 180° is another one
    corners = grid.cell_of(
        np.array([box.south, box.south, box.north, box.north]),
        np.array([box.west, east, box.west, east]),
    )
    return _in_order(grid.region_of(corners))


def _in_order(tiles: IntArray) -> list[int]:
    return list(dict.fromkeys(tiles.tolist()))


def _split_path(path: Path, needed: BoolArray) -> list[tuple[int, int]]:
    """Split a path ahead into parts with small bounding boxes. Return a pair (first metre, last
    metre) per part. Together the parts contain all points where the mask `needed` is True.
    """
    found: list[tuple[int, int]] = []
    first = -1
    last = -1
    for k in (np.flatnonzero(needed) * STEP).tolist():
        if first >= 0 and _fits_box(path, first, k):
            last = k
            continue
        if first >= 0:
            found.append((first, last))
        first = k
        last = k
    return [*found, (first, last)] if first >= 0 else found


def _fits_box(path: Path, first: int, last: int) -> bool:
    wide = float(np.ptp(path.x[first : last + 1])) + 2.0 * BESIDE_M
    high = float(np.ptp(path.y[first : last + 1])) + 2.0 * BESIDE_M
    return last - first <= LONGEST_M and wide * high <= AREA_M2


def _box_around(path: Path, first: int, last: int, pose: Pose) -> Box:
    x = path.x[first : last + 1]
    y = path.y[first : last + 1]
    east = np.array([x.min() - BESIDE_M, x.max() + BESIDE_M])
    north = np.array([y.min() - BESIDE_M, y.max() + BESIDE_M])
    latitude, longitude = to_degrees(east, north, pose)
    return Box(float(longitude[0]), float(latitude[0]), float(longitude[1]), float(latitude[1]))
