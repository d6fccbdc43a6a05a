"""Roads of the page: lines and place names from a GeoJSON file, or lines derived from the cells
that vehicles visited.

The page draws one ribbon (coloured band of friction) per direction along each line. Lines of a file
have names. Derived lines follow the centres of neighbouring cells with the same heading, smoothed.
Pure except for reading the file.
"""

from __future__ import annotations

import json
from collections.abc import Iterable
from pathlib import Path
from typing import Any, Final, NamedTuple

import numpy as np

from schemas import grid
from schemas.errors import InputError
from schemas.numeric import FloatArray, IntArray

# Largest gap in cells without a report, along a line or between cells of one lane.
AHEAD: Final = 3
# Cells of the moving average. Without it, lanes and position errors would make the line zigzag.
SMOOTHED: Final = 5
LONGITUDES: Final = 180.0  # [deg] largest size of a longitude
LATITUDES: Final = 90.0  # [deg] largest size of a latitude
LEAST_CELLS: Final = 3  # fewer cells give no line, because they have no direction
MOST_LINES: Final = 50_000
# column and row of the next cell, by heading sector: east, north, west, south
_STEP: Final = ((1, 0), (0, -1), (-1, 0), (0, 1))


class Line(NamedTuple):
    """Line of a road, and the directions in which it is driven.

    Attributes:
        name: name of the road; empty if unknown.
        points: longitude and latitude [deg] along the line.
        directions: 1 for forward, 2 for backward, 3 for both.
    """

    name: str
    points: list[list[float]]
    directions: int


class RoadMap(NamedTuple):
    """Lines of roads, and names of places with longitude and latitude [deg]."""

    lines: list[Line]
    places: list[tuple[str, float, float]]

    def as_json(self) -> dict[str, Any]:
        """Return the road map in a form for JSON."""
        lines = [
            {"name": line.name, "points": line.points, "directions": line.directions}
            for line in self.lines
        ]
        return {"lines": lines, "places": [list(place) for place in self.places]}


def read_roads(path: Path) -> RoadMap:
    """Return the lines and named points of a GeoJSON file. The properties `name` and `oneway` are
    used.

    Raises:
        InputError: the file cannot be read, or contains no line.
    """
    fix = "give GeoJSON of LineString features in degrees"
    try:
        document = json.loads(path.read_bytes())
    except (OSError, ValueError) as error:
        raise InputError("roads", f"{path} cannot be read ({str(error)[:80]})", fix) from error
    if not isinstance(document, dict) or not isinstance(document.get("features"), list):
        raise InputError("roads", f"{path} is no GeoJSON FeatureCollection", fix)
    found = RoadMap([], [])
    for index, feature in enumerate(document["features"]):
        try:
            _add_feature(found, feature["geometry"], feature.get("properties") or {})
        except (AttributeError, ValueError, KeyError, TypeError, IndexError) as error:
            problem = f"{path}: feature {index} has no usable geometry"
            raise InputError("roads", problem, fix) from error
    if not found.lines or len(found.lines) > MOST_LINES:
        raise InputError(
            "roads", f"{path} contains {len(found.lines)} lines", f"give 1 to {MOST_LINES}"
        )
    return found


def _directions_of(oneway: str) -> int:
    """Return the driving directions of a line as bits: 1 along its points, 2 against them."""
    if oneway in ("yes", "true", "1", "forward"):
        return 1
    if oneway in ("-1", "backward"):
        return 2
    return 3


def _add_feature(found: RoadMap, geometry: dict[str, Any], about: dict[str, Any]) -> None:
    kind = geometry["type"]
    points = geometry["coordinates"]
    name = str(about.get("name") or "")
    if kind == "Point" and name:
        found.places.append((name, float(points[0]), float(points[1])))
    lines = []
    if kind == "LineString":
        lines = [points]
    elif kind == "MultiLineString":
        lines = points
    directions = _directions_of(str(about.get("oneway") or "").lower())
    for line in lines:
        kept = [[round(float(x), 7), round(float(y), 7)] for x, y, *_ in line]
        if not all(abs(x) <= LONGITUDES and abs(y) <= LATITUDES for x, y in kept):
            raise ValueError("not in degrees")
        if len(kept) > 1:
            found.lines.append(Line(name, kept, directions))


def learned_lines(cell: IntArray, sector: IntArray) -> list[Line]:
    """Derive the lines of roads from visited cells: one line per chain of neighbouring cells with
    the same heading.

    Args:
        cell: (n,) quadints (numbers of cells, zoom 21).
        sector: (n,) headings, 0 east to 3 south.
    """
    found: list[Line] = []
    for heading in range(grid.SECTORS):
        own = np.unique(cell[sector == heading])
        columns, rows = (part.astype(np.int64).tolist() for part in grid.deinterleave(own))
        chains = _chain_cells(list(zip(columns, rows, strict=True)), heading)
        found.extend(Line("", _smooth_chain(np.array(chain, np.float64)), 1) for chain in chains)
    return found[:MOST_LINES]


def _merge_side_by_side(cells: list[tuple[int, int]], heading: int) -> dict[int, list[float]]:
    """Merge cells that lie side by side in one lane. Return a dictionary from the position along
    the heading to the positions of the lanes across the heading, both counted in cells. Parallel
    roads have several positions across.

    The error of the satellite receiver spreads one lane over neighbouring cells. Therefore cells at
    the same position along the heading are sorted across. If neighbours in this order are at most
    AHEAD cells apart, they belong to one lane, whose position is their mean.
    """
    dx, dy = _STEP[heading]
    columns: dict[int, list[int]] = {}
    for x, y in cells:
        columns.setdefault(x * dx + y * dy, []).append(x * dy + y * dx)
    found: dict[int, list[float]] = {}
    for along, sides in columns.items():
        sides.sort()
        first = 0
        for k in range(1, len(sides) + 1):
            if k == len(sides) or sides[k] - sides[k - 1] > AHEAD:
                found.setdefault(along, []).append(sum(sides[first:k]) / (k - first))
                first = k
    return found


def _chain_cells(cells: list[tuple[int, int]], heading: int) -> Iterable[list[tuple[float, float]]]:
    """Yield chains of road positions in the order of travel. After each position follows the
    nearest position ahead that is not yet in a chain.
    """
    dx, dy = _STEP[heading]
    here = _merge_side_by_side(cells, heading)
    following: dict[tuple[int, float], tuple[int, float]] = {}
    before: set[tuple[int, float]] = set()
    nodes = [(along, side) for along in sorted(here) for side in here[along]]
    for along, side in nodes:
        ahead = [
            ((step, abs(other - side)), (along + step, other))
            for step in range(1, AHEAD + 1)
            for other in here.get(along + step, ())
            if abs(other - side) <= step + 1 and (along + step, other) not in before
        ]
        if ahead:
            nearest = min(ahead)[1]
            following[along, side] = nearest
            before.add(nearest)
    for start in nodes:
        if start in before:
            continue
        chain = [start]
        while chain[-1] in following:
            chain.append(following[chain[-1]])
        if len(chain) >= LEAST_CELLS:
            yield [(along * dx + side * dy, along * dy + side * dx) for along, side in chain]


def _smooth_chain(chain: FloatArray) -> list[list[float]]:
    """Return longitude and latitude [deg] of a chain of cells (n, 2), smoothed with a moving
    average.
    """
    half = SMOOTHED // 2
    padded = (
        np.concatenate([np.repeat(chain[:1], half, 0), chain, np.repeat(chain[-1:], half, 0)]) + 0.5
    )
    mean = np.stack(
        [np.convolve(padded[:, k], np.full(SMOOTHED, 1 / SMOOTHED), "valid") for k in (0, 1)], 1
    )
    size = float(2**grid.CELL_ZOOM)
    longitude = mean[:, 0] / size * 360.0 - 180.0
    latitude = np.degrees(np.arctan(np.sinh(np.pi * (1.0 - 2.0 * mean[:, 1] / size))))
    points: list[list[float]] = np.stack([longitude, latitude], 1).round(7).tolist()
    return points
