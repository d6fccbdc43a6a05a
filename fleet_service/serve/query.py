"""Answers to map queries, one tile at a time: select cells, compute beliefs (probability of each
friction value), estimate unvisited cells, encode. Pure (no I/O).
"""

from __future__ import annotations

from bisect import bisect_left, bisect_right
from collections.abc import Callable, Iterable, Iterator
from typing import NamedTuple

import numpy as np
import pyarrow as pa

from fleet_service.serve.encode import encode_tile
from fleet_service.serve.neighbour_fill import impute_cells
from fleet_service.serve.tile_cache import ShownTile, TileCache, used_once
from fleet_service.serve.view import join_views
from schemas import grid
from schemas.numeric import BoolArray, IntArray
from schemas.query import Format, MapQuery
from schemas.regions import keys_along


def answer_query(
    cache: TileCache,
    query: MapQuery,
    is_requested: Callable[[int], bool],
    now: int,
    only: int | None = None,
) -> Iterator[tuple[int, bytes]]:
    """Yield the tile number and the payload of every reply, computed on demand.

    Args:
        cache: the tiles of the map.
        query: parameters of the query.
        is_requested: function that returns True if a tile's key matches the query's key.
        now: time [ns] for which beliefs and ages are computed.
        only: the only matching tile, if the query's key names a single tile.

    Raises:
        InputError: the route is too long.
    """
    route = keys_along(query.route) if query.route else None
    tiles = filter(is_requested, _select_tiles(cache, query, route, only))
    if route is None and query.basis is None:
        shown_tiles = _shown_in_groups(cache, tiles, now)
    else:
        shown_tiles = ((tile, _view_tile(cache, tile, query, route, now)) for tile in tiles)
    for tile, shown in shown_tiles:
        payload = _encode_tile(shown, _select_rows(shown, query), query.format, tile)
        if payload is not None:
            yield tile, payload


def _shown_in_groups(
    cache: TileCache, tiles: Iterable[int], now: int
) -> Iterator[tuple[int, ShownTile]]:
    """Yield each tile with its number. Small tiles are made in groups, when the first of a group is
    needed.
    """
    remaining = list(tiles)
    while remaining:
        group = cache.first_group(remaining)
        yield from zip(group, cache.read_tiles(group, now), strict=True)
        remaining = remaining[len(group) :]


class AnswerSize(NamedTuple):
    """Upper bounds of the size of an answer to a map query: number of cells and number of tiles."""

    cells: int
    tiles: int


def bound_answer_size(
    cache: TileCache, query: MapQuery, is_requested: Callable[[int], bool], only: int | None = None
) -> AnswerSize:
    """Return an upper bound of the size of the answer to a query: the number of the tiles that must
    be read, and the number of all their cells.

    Args:
        cache: the tiles of the map.
        query: parameters of the query.
        is_requested: function that returns True if a tile's key matches the query's key.
        only: the only matching tile, if the query's key names a single tile.
    """
    route = keys_along(query.route) if query.route else None
    tiles = [
        tile
        for tile in _select_tiles(cache, query, route, only)
        if only is not None or is_requested(tile)
    ]
    return AnswerSize(sum(cache.state.count(tile) for tile in tiles), len(tiles))


def _select_tiles(
    cache: TileCache, query: MapQuery, route: IntArray | None, only: int | None
) -> list[int]:
    """Return the numbers of the tiles that may contain cells of the answer to a query."""
    if route is not None:
        tiles = np.unique(grid.tile_of(route // grid.SECTORS))
    elif only is not None:
        return [only]
    else:
        with cache.guard:
            tiles = np.array(cache.state.tiles(), np.int64)
    if query.bbox is not None:
        tiles = tiles[grid.touches(query.bbox, grid.bounds(tiles, grid.TILE_ZOOM))]
    return [int(tile) for tile in tiles]


def _view_tile(
    cache: TileCache, tile: int, query: MapQuery, route: IntArray | None, now: int
) -> ShownTile:
    """Return the cells of one tile that may match the query, including estimated (unvisited) cells
    if the query asks for them. For a query along a route, they are in the order of the route.
    """
    with cache.guard:
        fusion = cache.state.fusion
        slots = cache.state.slots(tile)
        passed = slots
        if route is not None:
            ahead = route[grid.tile_of(route // grid.SECTORS) == tile]
            found = fusion.slots_of(ahead // grid.SECTORS, ahead % grid.SECTORS)
            passed = found[found >= 0]
        cells = cache.read_cells(cache.public_slots(passed, now), now)
        if query.basis == "borrowed":
            known = slots
            if route is not None:
                along = fusion.slots_of(route // grid.SECTORS, route % grid.SECTORS)
                known = np.union1d(slots, along[along >= 0])
            known = cache.public_slots(known, now)
            borrowed = impute_cells(cache.source, tile, known, route, now)
            cells = join_views(cells, cache.coarsen(borrowed))
    return used_once(cells, now)


def _select_rows(shown: ShownTile, query: MapQuery) -> slice | BoolArray:
    """Return the rows of those cells of the tile that touch the query's box and that enough
    vehicles have visited. The result is a slice if all rows between two positions are selected,
    else a mask.

    A slice is found with a few comparisons of numbers. The mask needs comparisons of whole arrays,
    each of which releases the interpreter lock. Waiting until the lock is free again may take ten
    times as long as the comparison.
    """
    columns = shown.columns
    run = slice(0, len(shown.cells))
    if query.bbox is not None and shown.payload:
        _, south, _, north = query.bbox
        run = slice(
            bisect_right(columns["north"], south),
            bisect_left(columns["south"], north),
        )
    if query.min_vehicles <= shown.least_vehicles and (
        query.bbox is None or grid.touches(query.bbox, shown.common)
    ):
        return run
    keep = columns["vehicles"] >= query.min_vehicles
    if query.bbox is not None:
        keep &= grid.touches(
            query.bbox, (columns["west"], columns["south"], columns["east"], columns["north"])
        )
    return np.asarray(keep)


def _encode_tile(
    shown: ShownTile, rows: slice | BoolArray, form: Format, tile: int
) -> bytes | None:
    """Return the selected cells of a tile as bytes (Arrow, JSON or GeoJSON); None if no cell is
    selected.
    """
    if isinstance(rows, slice):
        count = max(rows.stop - rows.start, 0)
        if form is Format.ARROW and shown.payload and count == len(shown.cells):
            return shown.payload if count else None
        cells = shown.cells.slice(rows.start, count)
    else:
        cells = shown.cells.filter(pa.array(rows))
    return encode_tile(cells, form, tile) if cells.num_rows else None
