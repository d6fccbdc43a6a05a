"""Estimates for unvisited cells from visited neighbours ("borrowed" values): they have wider
intervals and are marked as estimated. Pure (no I/O).

A neighbour may be another kind of road (a bridge, the other side of a shadow). Therefore an
estimate is a weighted mean of the neighbours' beliefs and the prior (belief before any
measurement). The prior has at least half the weight.

Along a route the order of cells is known. There a cell borrows from the nearest visited cells
before and behind it, up to REACH cells away, and the prior's weight grows with the distance. If
there is a visited cell on both sides, the result contains the beliefs of both. Two different
surfaces therefore give a wide belief, and not a belief about a surface in the middle.
"""

from __future__ import annotations

from typing import Final

import numpy as np

from fleet_service.serve.view import CellView, Readable
from schemas import grid, mugrid
from schemas.numeric import FloatArray, IntArray

PRIOR_SHARE: Final = 0.5
REACH: Final = 10  # largest distance of a neighbour in cells, some 130 m
# Factor on the neighbours' share per further cell. In the simulated towns, a surface is five to ten
# cells long.
KEPT: Final = 0.8


def impute_cells(
    source: Readable, tile: int, known: IntArray, route: IntArray | None, now: int
) -> CellView:
    """Return unvisited cells of a tile, with beliefs about their friction that are estimated from
    visited neighbours. Without a `route`, these are the cells next to the visited slots `known`
    (one per cell and heading sector), in the same sector. With a `route`, only cells along it are
    returned.

    Each estimated belief is a weighted mean of the prior and the neighbours' beliefs. The prior has
    the weight PRIOR_SHARE if a neighbour is adjacent. If the nearest neighbour along a route is
    farther away, the prior has more weight.

    The result counts as many `vehicles` as the neighbour with the fewest, so that readers never see
    an estimate whose source is hidden from them. `first` and `last` are the oldest and the newest
    time of an observation of the neighbours [ns].
    """
    live = source.live
    keys, visited, share = _adjacent_gaps(source, tile, known)
    if route is not None:
        ahead = np.isin(keys, route)
        along = _route_gaps(source, route, tile, known)
        keys, visited, share = (
            np.concatenate([a[ahead], b])
            for a, b in zip((keys, visited, share), along, strict=True)
        )
    unique_keys, group = np.unique(keys, return_inverse=True)
    belief = np.zeros((len(unique_keys), mugrid.BINS))
    weight_sum = np.zeros(len(unique_keys))
    largest_share = np.zeros(len(unique_keys))
    np.add.at(belief, group, share[:, None] * source.beliefs(visited, now))
    np.add.at(weight_sum, group, share)
    np.maximum.at(largest_share, group, share)
    vehicles = np.full(len(unique_keys), np.iinfo(np.int64).max)
    first = vehicles.copy()
    last = np.zeros(len(unique_keys), np.int64)
    np.minimum.at(vehicles, group, live.vehicles[visited])
    np.minimum.at(first, group, live.first[visited])
    np.maximum.at(last, group, live.time[visited])
    return CellView(
        cell=unique_keys // grid.SECTORS,
        sector=unique_keys % grid.SECTORS,
        belief=mugrid.PRIOR
        + largest_share[:, None] * (belief / weight_sum[:, None] - mugrid.PRIOR),
        values=np.zeros(len(unique_keys), np.float32),
        vehicles=vehicles,
        observations=np.zeros(len(unique_keys), np.int64),
        first=first,
        last=last,
        imputed=np.ones(len(unique_keys), bool),
    )


def _adjacent_gaps(
    source: Readable, tile: int, known: IntArray
) -> tuple[IntArray, IntArray, FloatArray]:
    """Return the unvisited cells of a tile next to visited cells in the same sector: keys, slots of
    the visited neighbours, and weights, (k,) each, as `_route_gaps` does. A key appears once per
    neighbour.
    """
    key = source.live.key
    slots = known[grid.tile_of(key[known] // grid.SECTORS) == tile]
    near = grid.neighbours(key[slots] // grid.SECTORS).reshape(-1)
    visited = np.repeat(slots, 8)
    sector = key[visited] % grid.SECTORS
    is_unvisited = ~np.isin(source.slots_of(np.maximum(near, 0), sector), slots)
    free = (near >= 0) & (grid.tile_of(near) == tile) & is_unvisited
    keys = (near * grid.SECTORS + sector)[free]
    return keys, visited[free], np.full(len(keys), 1.0 - PRIOR_SHARE)


def _route_gaps(
    source: Readable, route: IntArray, tile: int, known: IntArray
) -> tuple[IntArray, IntArray, FloatArray]:
    """Return the visited cells from which the unvisited cells of a route in a tile are estimated.

    The result consists of three arrays (k,). The first contains keys of unvisited cells. The second
    contains the slot of the nearest visited cell before or behind this cell on the route. The third
    contains the weight of this visited cell in the estimate, [0, 1].

    A key appears once per side (before, behind) that has a visited cell at most REACH positions
    away. A visited cell at the next position of the route is left out, because `impute_cells`
    already handles it as an adjacent cell.
    """
    slots = source.slots_of(route // grid.SECTORS, route % grid.SECTORS)
    slots = np.where(np.isin(slots, known), slots, -1)
    place = np.arange(len(route))
    before = np.maximum.accumulate(np.where(slots >= 0, place, -1))
    behind = np.minimum.accumulate(np.where(slots >= 0, place, len(route))[::-1])[::-1]
    free = (slots < 0) & (grid.tile_of(route // grid.SECTORS) == tile)
    parts = []
    for nearest, has_nearest in ((before, before >= 0), (behind, behind < len(route))):
        distance = np.abs(nearest - place)
        take = np.flatnonzero(free & has_nearest & (distance > 1) & (distance <= REACH))
        parts.append(
            (
                route[take],
                slots[nearest[take]],
                (1.0 - PRIOR_SHARE) * KEPT ** (distance[take] - 1.0),
            )
        )
    keys, visited, share = (np.concatenate(columns) for columns in zip(*parts, strict=True))
    return keys, visited, share
