"""Roads of the page: lines and place names of a GeoJSON file, or lines learned from the cells that
vehicles visited.

The page draws one ribbon per direction along each line. Lines of a file have names; learned lines
follow the centres of neighbouring cells of one heading, smoothed. Pure but for reading the file.
"""

from __future__ import annotations

import json
import math
from collections.abc import Iterable
from pathlib import Path
from typing import Any, Final, NamedTuple

import numpy as np

from schemas import grid
from schemas.errors import InputError
from schemas.numeric import FloatArray, IntArray

# cells to the next one of a learned line: what nobody reported in between is bridged
AHEAD: Final = 3
SMOOTHED: Final = 5  # cells, centred: two lanes and a receiver's error make the raw line zigzag
LEAST_CELLS: Final = 3  # of a learned line; fewer have no direction
MOST_LINES: Final = 50_000
_STEP: Final = (
    (1, 0),
    (0, -1),
    (-1, 0),
    (0, 1),
)  # column and row of the next cell, by sector: east, north, …


class Line(NamedTuple):
    """Line of a road.

    Attributes:
        name: empty if unknown.
        points: longitude and latitude [deg] along it.
        directions: 1 for forward, 2 for backward, 3 for both.
    """

    name: str
    points: list[list[float]]
    directions: int


class RoadMap(NamedTuple):
    """Lines, and names of places with longitude and latitude [deg]."""

    lines: list[Line]
    places: list[tuple[str, float, float]]

    def as_json(self) -> dict[str, Any]:
        """Return the road map for the page."""
        lines = [
            {"name": line.name, "points": line.points, "directions": line.directions}
            for line in self.lines
        ]
        return {"lines": lines, "places": [list(place) for place in self.places]}


def read_roads(path: Path) -> RoadMap:
    """Return the lines and named points of a GeoJSON file; `name` and `oneway` are properties.

    Raises:
        InputError: it cannot be read, or holds no line.
    """
    try:
        features = json.loads(path.read_bytes())["features"]
        found = RoadMap([], [])
        for feature in features:
            _add_feature(found, feature["geometry"], feature.get("properties") or {})
    except (OSError, ValueError, KeyError, TypeError, IndexError) as error:
        problem = f"{path} cannot be read ({str(error)[:80]})"
        raise InputError(
            "roads", problem, "give GeoJSON of LineString features in degrees"
        ) from error
    if not found.lines or len(found.lines) > MOST_LINES:
        raise InputError(
            "roads", f"{path} contains {len(found.lines)} lines", f"give 1 to {MOST_LINES}"
        )
    return found


def _add_feature(found: RoadMap, geometry: dict[str, Any], about: dict[str, Any]) -> None:
    kind = geometry["type"]
    points = geometry["coordinates"]
    name = str(about.get("name") or "")
    if kind == "Point" and name:
        found.places.append((name, float(points[0]), float(points[1])))
    lines = [points] if kind == "LineString" else points if kind == "MultiLineString" else []
    oneway = str(about.get("oneway") or "").lower()
    directions = (
        1 if oneway in ("yes", "true", "1", "forward") else 2 if oneway in ("-1", "backward") else 3
    )
    for line in lines:
        kept = [[round(float(x), 7), round(float(y), 7)] for x, y, *_ in line]
        if len(kept) > 1:
            found.lines.append(Line(name, kept, directions))


def learned_lines(cell: IntArray, sector: IntArray) -> list[Line]:
    """Return one line per chain of neighbouring cells of a heading.

    Args:
        cell: (n,) z21 quadints.
        sector: (n,) headings, 0 east to 3 south.
    """
    found: list[Line] = []
    for heading in range(grid.SECTORS):
        own = np.unique(cell[sector == heading])
        columns, rows = (part.astype(np.int64).tolist() for part in grid.deinterleave(own))
        chains = _chain_cells(list(zip(columns, rows, strict=True)), heading)
        found.extend(Line("", _smooth_chain(np.array(chain, np.float64)), 1) for chain in chains)
    return found[:MOST_LINES]


def _chain_cells(cells: list[tuple[int, int]], heading: int) -> Iterable[list[tuple[int, int]]]:
    """Yield chains of cells in the order of travel: each cell goes on to the nearest one ahead
    that has no other.
    """
    here = set(cells)
    dx, dy = _STEP[heading]
    offsets = sorted(
        (
            (along, side)
            for along in range(AHEAD + 1)
            for side in range(-AHEAD, AHEAD + 1)
            if (along, side) != (0, 0)
        ),
        key=lambda one: (math.hypot(*one), abs(one[1])),
    )
    offsets = [(along, side) for along, side in offsets if along >= abs(side)]
    following: dict[tuple[int, int], tuple[int, int]] = {}
    before: dict[tuple[int, int], tuple[int, int]] = {}
    for x, y in sorted(here, key=lambda one: one[0] * dx + one[1] * dy):
        for along, side in offsets:
            ahead = (x + along * dx + side * dy, y + along * dy + side * dx)
            if ahead in here and ahead not in before:
                following[x, y], before[ahead] = ahead, (x, y)
                break
    for start in sorted(here - set(before)):
        chain = [start]
        while chain[-1] in following:
            chain.append(following[chain[-1]])
        if len(chain) >= LEAST_CELLS:
            yield chain


def _smooth_chain(chain: FloatArray) -> list[list[float]]:
    """Return longitude and latitude [deg] of a chain of cells (n, 2), each the mean of its
    neighbours.
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
