"""Region expressions (Zenoh key patterns that select regions), the regions along a route, and the
areas for which no fleet service answers. The module is pure (no I/O).

A region expression has three chunks, of 4, 3 and 3 quadkey digits; `*` matches any chunk.
"""

from __future__ import annotations

from collections.abc import Collection, Iterator, Sequence
from typing import Final, NamedTuple

import numpy as np

from schemas import grid, keys
from schemas.errors import InputError
from schemas.numeric import FloatArray, IntArray
from schemas.query import MapQuery
from schemas.thresholds import METRES_PER_DEGREE

# Distance between sampled points of a route. It is less than half a cell at 60° of latitude, so
# that no cell on the route is missed.
ROUTE_STEP_M: Final = 4.0
ROUTE_MOST_M: Final = 500_000.0
# Zoom of the region that an expression of one, two or three chunks denotes.
_ZOOMS: Final = (4, 7, grid.REGION_ZOOM)

Box = tuple[float, float, float, float]


def overlap(one: str, other: str) -> bool:
    """Return True if at least one region matches both region expressions (key patterns that select
    regions).
    """
    return all(
        a == b or "*" in (a, b) for a, b in zip(one.split("/"), other.split("/"), strict=True)
    )


def covers(wide: str, narrow: str) -> bool:
    """Return True if the region expression `wide` (key pattern that selects regions) contains all
    regions of the expression `narrow`.
    """
    return all(a in (b, "*") for a, b in zip(wide.split("/"), narrow.split("/"), strict=True))


def region_of(tile: int) -> str:
    """Return the region expression (part of a key) that matches exactly the region in which a tile
    lies.
    """
    return keys.chunks(int(grid.parent(tile, grid.REGION_ZOOM, grid.TILE_ZOOM)), grid.REGION_ZOOM)


def unserved_expressions(query: MapQuery, served: Collection[str]) -> list[str]:
    """Return region expressions (key patterns that select regions), as few as possible, that cover
    the part of the queried area for which no service answers. `query` is the query, and `served`
    are the region expressions of all services. A query without route and box asks for the whole
    earth.

    Raises:
        InputError: the route in the query is too long.
    """
    if query.route is not None:
        ahead = grid.region_of(keys_along(query.route) // grid.SECTORS)
        found = dict.fromkeys(keys.chunks(int(region), grid.REGION_ZOOM) for region in ahead)
        return [region for region in found if not any(covers(wide, region) for wide in served)]
    return list(_regions_without(query.bbox, served, (), 0))


def _regions_without(
    box: Box | None, served: Collection[str], above: tuple[str, ...], parent: int
) -> Iterator[str]:
    depth = len(above)
    digits = _ZOOMS[depth] - (_ZOOMS[depth - 1] if depth else 0)
    inside = np.arange(1 << 2 * digits) + (parent << 2 * digits)
    if box is not None:
        inside = inside[grid.touches(box, grid.bounds(inside, _ZOOMS[depth]))]
    for one in inside.tolist():
        chunks = (*above, grid.quadkey(one, _ZOOMS[depth])[-digits:])
        region = "/".join((*chunks, *["*"] * (2 - depth)))
        near = [wide for wide in served if overlap(wide, region)]
        if not near:
            yield region
        elif not any(covers(wide, region) for wide in near):
            yield from _regions_without(box, near, chunks, one)


class Rank:
    """Sort order of places (one per cell and heading sector) along a route. Places that are not on
    the route come last.
    """

    def __init__(self, route: Sequence[tuple[float, float]]) -> None:
        self._place = {key: place for place, key in enumerate(keys_along(route).tolist())}

    def of(self, cell: int, sector: int) -> int:
        """Return the rank of a place (one cell and heading sector): the index of the place in the
        sequence of places along the route. Places off the route get the highest rank.
        """
        return self._place.get(cell * grid.SECTORS + sector, len(self._place))

    def order(self, cells: IntArray, sectors: IntArray) -> IntArray:
        """Return the indices (n,) that sort the given cells and sectors (n,) in their order along
        the route.
        """
        ranks = [
            self.of(cell, sector)
            for cell, sector in zip(cells.tolist(), sectors.tolist(), strict=True)
        ]
        return np.argsort(np.array(ranks, np.int64), kind="stable")


class RouteSamples(NamedTuple):
    """Points along a route in driving order, at most ROUTE_STEP_M apart; each attribute is (n,).

    Attributes:
        longitude, latitude: position [deg]; beyond the 180° meridian, the longitude exceeds 180°.
        along: distance from the start [m].
        sector: heading sector.
    """

    longitude: FloatArray
    latitude: FloatArray
    along: FloatArray
    sector: IntArray

    @property
    def keys(self) -> IntArray:
        """Return the key (cell · 4 + sector) of the place of each point."""
        return grid.cell_of(self.latitude, self.longitude) * grid.SECTORS + self.sector


def sample_route(
    route: Sequence[tuple[float, float]], most_m: float = ROUTE_MOST_M
) -> RouteSamples:
    """Return points along a route. The corners of the route are (longitude, latitude) [deg].

    Raises:
        InputError: the route is longer than `most_m` [m].
    """
    corners = np.array(route)
    corners[:, 0] = np.unwrap(corners[:, 0], period=360.0)  # the short way over the 180° meridian
    scale = METRES_PER_DEGREE * np.cos(np.radians(corners[:, 1].mean()))
    steps = np.diff(corners, axis=0)
    legs = steps * [scale, METRES_PER_DEGREE]
    lengths = np.hypot(*legs.T)
    if not lengths.sum() <= most_m:
        raise InputError(
            "route",
            f"is {lengths.sum() / 1e3:.0f} km long",
            f"give at most {most_m / 1e3:.0f} km",
        )
    counts = np.maximum(np.ceil(lengths / ROUTE_STEP_M), 1).astype(np.int64)
    leg = np.repeat(np.arange(len(counts)), counts)
    share = (np.arange(len(leg)) - np.repeat(np.cumsum(counts) - counts, counts)) / counts[leg]
    places = np.append(corners[leg] + share[:, None] * steps[leg], corners[-1:], axis=0)
    along = np.append((np.cumsum(lengths) - lengths)[leg] + share * lengths[leg], lengths.sum())
    sector = grid.sector_of(np.arctan2(legs[:, 1], legs[:, 0]))[np.append(leg, leg[-1])]
    return RouteSamples(places[:, 0], places[:, 1], along, sector.astype(np.int64))


def keys_along(route: Sequence[tuple[float, float]]) -> IntArray:
    """Return the keys (cell · 4 + sector) of the places on a route, in order and without
    repetitions. The corners of the route are (longitude, latitude) [deg].

    Raises:
        InputError: the route is longer than ROUTE_MOST_M.
    """
    keys = sample_route(route).keys
    _, first = np.unique(keys, return_index=True)
    return np.asarray(keys[np.sort(first)])
