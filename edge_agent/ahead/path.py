"""Path ahead in steps of one metre, with the map places of each metre. The module is pure.

Legend
    s        distance ahead of the car [m], (M,): 1, 2, 3 …
    place    a map cell together with one of four sectors of the driving direction
    key      number of a place, cell·4 + sector, int64
    places   (M, C) keys of the places whose map data apply to a metre, the likeliest first;
             NONE fills unused columns

The map's reports come from cars that may have driven in the next lane, with a position error of 1.5
m. Therefore each metre also covers places a little to the left and right. If the heading is near
the border of two sectors, the metre covers both sectors.
"""

from __future__ import annotations

from typing import Final, NamedTuple

import numpy as np

from schemas import grid
from schemas.numeric import FloatArray, IntArray
from schemas.thresholds import METRES_PER_DEGREE
from schemas.wire.ahead import Way

NONE: Final = -1
# [m] lateral offset of the places that also count: a lane's width and a receiver's error. The other
# carriageway of the same direction is further away.
BESIDE_M: Final = 4.0
# [m] length over which a corner of a given route is rounded: at a right angle this gives a radius
# of 9.5 m.
SMOOTH_M: Final = 15
# [m] largest distance from the line of a route: error of the receiver, width of the road and a
# coarsely drawn route.
OFF_ROUTE_M: Final = 20.0
BACK_M: Final = 20.0  # [m] distance by which a position may jump back along the route
# [rad] a car whose heading differs by more from the route is on another road
ASTRAY: Final = np.radians(60.0)
# [m] The heading may differ by more than ASTRAY if the route turns into it within this distance.
# Drivers cut corners or turn late.
# The same holds this close to the start of the route. Navigation systems leave out the part already
# driven, so the direction into the start is unknown.
CORNER_M: Final = 20.0
# [m] length of a straight path if no road is known. Beyond this length, the direction of the road
# is unknown.
CORRIDOR_M: Final = 150.0
# [m/m] growth of the corridor's half width. After 100 m it covers a bend with a radius of a
# kilometre.
CORRIDOR_WIDENS: Final = 0.05


class Pose(NamedTuple):
    """Pose of a car: latitude and longitude [deg], yaw [rad from east], speed [m/s], time
    [ns UTC].
    """

    latitude: float
    longitude: float
    yaw: float
    speed: float
    time: int


class Path(NamedTuple):
    """One possible path ahead of the car.

    Attributes:
        kind: "route" (given by the user), "road" (visible in the map) or "corridor" (straight on).
        distance: (M,) distance from the car along the path [m].
        places: (M, C) keys of the map places of each metre.
        curvature: (M,) [1/m], positive to the left; NaN where unknown.
        x, y: (M,) coordinates [m], east and north of the car.
    """

    kind: Way
    distance: FloatArray
    places: IntArray
    curvature: FloatArray
    x: FloatArray
    y: FloatArray

    def first_metres(self, length: float) -> Path:
        """Return the first part of this path ahead of the car, `length` metres long."""
        n = max(int(length), 1)
        return Path(
            self.kind,
            self.distance[:n],
            self.places[:n],
            self.curvature[:n],
            self.x[:n],
            self.y[:n],
        )


def to_plane(
    latitude: FloatArray, longitude: FloatArray, pose: Pose
) -> tuple[FloatArray, FloatArray]:
    """Convert latitude and longitude [deg] to east and north coordinates [m] relative to the car,
    in the same shape. Within a kilometre of the car the error is below a centimetre.
    """
    east = METRES_PER_DEGREE * np.cos(np.radians(pose.latitude))
    eastward = np.asarray(longitude) - pose.longitude
    eastward -= 360.0 * np.floor(eastward / 360.0 + 0.5)  # at the antimeridian
    return eastward * east, (np.asarray(latitude) - pose.latitude) * METRES_PER_DEGREE


def to_degrees(x: FloatArray, y: FloatArray, pose: Pose) -> tuple[FloatArray, FloatArray]:
    """Return latitude and longitude [deg] of points given by east and north coordinates [m]
    relative to the car; all arrays have the same shape.
    """
    east = METRES_PER_DEGREE * np.cos(np.radians(pose.latitude))
    return pose.latitude + y / METRES_PER_DEGREE, pose.longitude + x / east


def path_along(
    kind: Way, line: FloatArray, pose: Pose, length: float, first: IntArray | None = None
) -> Path:
    """Return the path, at most `length` [m] long, along a line that begins at the car. The line has
    n points (n, 2) [m], east and north of the car.

    `first` (n,) are the keys of map places (cell·4 + sector) at the line's points, if the caller
    knows them. The path then lists them before the keys computed from the positions.
    """
    run = _distance_along(line)
    count = max(int(min(run[-1], length)), 1)
    s = np.arange(1.0, count + 1.0)
    x = np.interp(s, run, line[:, 0])
    y = np.interp(s, run, line[:, 1])
    yaw = (
        np.unwrap(np.arctan2(np.gradient(y), np.gradient(x))) if count > 1 else np.full(1, pose.yaw)
    )
    smooth = _moving_average(yaw, SMOOTH_M)
    curvature = np.gradient(smooth) if kind == "route" and count > 1 else np.full(count, np.nan)
    widen = BESIDE_M + (CORRIDOR_WIDENS * s if kind == "corridor" else 0.0)
    places = _places_along(x, y, smooth, widen, pose)
    if first is not None:
        nearest = np.abs(run[None, :] - s[:, None]).argmin(axis=1)
        places = np.concatenate([first[nearest][:, None], places], axis=1)
    return Path(kind, s, places, curvature, x, y)


def straight_path(pose: Pose, length: float) -> Path:
    """Return a straight path of `length` metres in the direction of the car's heading."""
    reach = min(length, CORRIDOR_M)
    end = [reach * np.cos(pose.yaw), reach * np.sin(pose.yaw)]
    return path_along("corridor", np.array([[0.0, 0.0], end]), pose, length)


class GivenRoute:
    """Route given by the user, and the car's progress on it.

    Args:
        latitude: (n,) latitudes of the route's points [deg], at least two points.
        longitude: (n,) longitudes of the route's points [deg].
    """

    def __init__(self, latitude: FloatArray, longitude: FloatArray) -> None:
        self._latitude = latitude
        self._longitude = longitude
        self._metre = 0.0

    def ahead(self, pose: Pose, length: float) -> Path | None:
        """Return the next `length` metres of the route as a path ahead of the car. Return None if
        the car has left the route or reached its end.
        """
        x, y = to_plane(self._latitude, self._longitude, pose)
        line = np.column_stack([x, y])
        run = _distance_along(line)
        place = self._match_position(line, run, pose)
        if place is None:
            return None
        self._metre = place
        rest = run > place
        here = [np.interp(place, run, x), np.interp(place, run, y)]
        ahead = np.concatenate([[here], line[rest]])
        return path_along("route", ahead, pose, length) if len(ahead) > 1 else None

    def _match_position(self, line: FloatArray, run: FloatArray, pose: Pose) -> float | None:
        """Return the distance [m] from the start of the route to the route point that best fits the
        car's position and heading. Points shortly after the previously matched point are preferred.

        `line` (n, 2) are the route's points relative to the car, `run` (n,) their distances along
        it [m]. Return None if no point fits.
        """
        step = np.diff(line, axis=0)
        start = line[:-1]
        size = np.maximum(np.hypot(step[:, 0], step[:, 1]), 1e-9)
        share = np.clip(-(start * step).sum(axis=1) / size**2, 0.0, 1.0)
        off = np.hypot(*(start + share[:, None] * step).T)
        turned = np.abs(
            (np.arctan2(step[:, 1], step[:, 0]) - pose.yaw + np.pi) % (2 * np.pi) - np.pi
        )
        at = run[:-1] + share * size
        fits = off <= OFF_ROUTE_M
        for k in np.flatnonzero(fits & (turned > ASTRAY)).tolist():
            first, last = np.searchsorted(run, [at[k] - CORNER_M, at[k] + CORNER_M])
            fits[k] = first == 0 or turned[first - 1 : last].min() <= ASTRAY
        if not fits.any():
            return None
        onward = fits & (at >= self._metre - BACK_M)
        among = np.flatnonzero(onward if onward.any() else fits)
        # Prefer the nearest point, but penalise progress along the route. Thus the match does not
        # jump ahead where the route passes the same street twice.
        cost = off[among] + 0.1 * np.maximum(at[among] - self._metre, 0.0)
        return float(at[among[int(cost.argmin())]])


def _places_along(
    x: FloatArray, y: FloatArray, yaw: FloatArray, widen: FloatArray | float, pose: Pose
) -> IntArray:
    sectors = [np.asarray(sector, np.int64) for sector in grid.sectors_touched(yaw)]
    columns = []
    for side in (0.0, 1.0, -1.0):
        cell = grid.cell_of(
            *to_degrees(x - side * widen * np.sin(yaw), y + side * widen * np.cos(yaw), pose)
        )
        columns += [np.where(sector >= 0, cell * grid.SECTORS + sector, NONE) for sector in sectors]
    return np.column_stack(columns)


def _moving_average(values: FloatArray, width: int) -> FloatArray:
    padded = np.pad(values, width // 2, mode="edge")
    return np.convolve(padded, np.full(width, 1.0 / width), mode="valid")[: len(values)]


def _distance_along(line: FloatArray) -> FloatArray:
    return np.concatenate([[0.0], np.cumsum(np.hypot(*np.diff(line, axis=0).T))])
