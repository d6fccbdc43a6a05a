"""Answers: which cells a query asks for, and the three forms of a tile. Pure."""

from __future__ import annotations

import json
from collections.abc import Callable, Iterator, Mapping
from typing import Any, Final

import numpy as np
import pyarrow as pa
from numpy.typing import NDArray

from fleet_service.serve.map_state import MapState, arrow_stream, cell_table
from fleet_service.serve.neighbour_fill import borrowed
from fleet_service.serve.tile_cache import Shown, Tiles, filtered
from schemas import grid
from schemas.errors import InputError
from schemas.numeric import BoolArray, IntArray
from schemas.query import Format, MapQuery
from schemas.thresholds import METRES_PER_DEGREE

ROUTE_STEP_M: Final = 4.0  # less than half a cell at 60° of latitude: no cell on the way is missed
ROUTE_MOST_M: Final = 500_000.0


def answer(
    tiles: Tiles, query: MapQuery, wanted: Callable[[int], bool], now: int, only: int | None = None
) -> Iterator[tuple[int, bytes]]:
    """Tile and payload of every reply, each made when it is taken.

    Args:
        tiles: of the map.
        query: what is asked.
        wanted: whether a tile's key matches the query's.
        now: for ages and forgetting [ns].
        only: the one tile that can be wanted, where the query's key names it.

    Raises:
        InputError: the route is too long.
    """
    route = along(query) if query.route else None
    for tile in _near(_visited(tiles, route, only), query):
        if wanted(tile):
            if route is None and query.basis is None:
                payload = _shown(tiles.shown(tile, now), query, tile)
            else:
                with tiles.guard:
                    cells = _selected(tiles.state, tile, query, route, now)
                payload = _rendered(cells, _asked(filtered(cells), query), query, tile)
            if payload is not None:
                yield tile, payload


def _visited(tiles: Tiles, route: tuple[IntArray, IntArray] | None, only: int | None) -> list[int]:
    """The tiles that may have something."""
    if route is not None:
        return [int(tile) for tile in np.unique(grid.tile_of(route[0]))]
    if only is not None:
        return [only]
    with tiles.guard:
        return tiles.state.tiles()


def _near(tiles: list[int], query: MapQuery) -> list[int]:
    """Those that the box touches."""
    if query.bbox is None or len(tiles) < 2:  # of one its cells are asked
        return tiles
    found = np.array(tiles)
    west, south, east, north = grid.bounds(found, grid.TILE_ZOOM)
    box = query.bbox
    inside = (east > box[0]) & (north > box[1]) & (west < box[2]) & (south < box[3])
    return [int(tile) for tile in found[inside]]


def _shown(shown: Shown, query: MapQuery, tile: int) -> bytes | None:
    """What a query asks for of a tile as it is shown: most often all of it, as it lies there, or a run of its lines.

    Every step that lets go of the interpreter may wait for it again behind whoever is busy, ten times as long as it
    takes; so cells are compared one by one only where it must be.
    """
    begin, end = _lines(shown, query)
    if begin >= end:
        return None
    if not _all(shown, query):
        part = {name: column[begin:end] for name, column in shown.columns.items()}
        return _rendered(shown.cells.slice(begin, end - begin), _asked(part, query), query, tile)
    if end - begin == len(shown.cells) and query.format is Format.ARROW:
        return shown.payload
    return render(shown.cells.slice(begin, end - begin), query.format, grid.quadkey(tile, grid.TILE_ZOOM))


def _lines(shown: Shown, query: MapQuery) -> tuple[int, int]:
    """First and last of the cells whose lines touch the box."""
    if query.bbox is None:
        return 0, len(shown.cells)
    _, south, _, north = query.bbox
    columns = shown.columns
    return int(columns["north"].searchsorted(south, "right")), int(columns["south"].searchsorted(north, "left"))


def _all(shown: Shown, query: MapQuery) -> bool:
    """Whether a query wants all cells of the lines that touch its box."""
    vehicles, east, west = shown.common
    touched = query.bbox is None or (east > query.bbox[0] and west < query.bbox[2])
    return touched and query.min_vehicles <= vehicles


def _rendered(cells: pa.RecordBatch, keep: BoolArray, query: MapQuery, tile: int) -> bytes | None:
    found = cells.filter(pa.array(keep))
    return render(found, query.format, grid.quadkey(tile, grid.TILE_ZOOM)) if found.num_rows else None


def _selected(
    state: MapState, tile: int, query: MapQuery, route: tuple[IntArray, IntArray] | None, now: int
) -> pa.RecordBatch:
    """The cells of one tile that may be asked for; along a route in its order."""
    if route is None:
        slots = state.slots(tile)
    else:
        ahead = grid.tile_of(route[0]) == tile
        slots = state.fusion.slots_of(route[0][ahead], route[1][ahead])
        slots = slots[slots >= 0]
    table = cell_table(state.fusion, slots, now)
    if query.basis == "borrowed":
        table = pa.concat_tables([table, borrowed(state.fusion, tile, state.slots(tile), route, now)])
    return pa.RecordBatch.from_arrays([column.combine_chunks() for column in table.columns], schema=table.schema)


def _asked(columns: Mapping[str, NDArray[Any]], query: MapQuery) -> BoolArray:
    """Rows with enough vehicles that touch the box, (k,)."""
    keep = columns["vehicles"] >= query.min_vehicles
    if query.bbox is not None:
        west, south, east, north = query.bbox
        keep &= (columns["east"] > west) & (columns["west"] < east)
        keep &= (columns["north"] > south) & (columns["south"] < north)
    return np.asarray(keep)


def along(query: MapQuery) -> tuple[IntArray, IntArray]:
    """Cell and sector of everything a route passes, in its order, each once.

    Raises:
        InputError: longer than ROUTE_MOST_M.
    """
    points = np.array(query.route)
    scale = np.cos(np.radians(points[:-1, 1].mean()))
    steps = np.diff(points, axis=0) * [METRES_PER_DEGREE * scale, METRES_PER_DEGREE]
    lengths = np.hypot(*steps.T)
    if lengths.sum() > ROUTE_MOST_M:
        raise InputError(
            "route", f"is {lengths.sum() / 1e3:.0f} km long", f"ask for {ROUTE_MOST_M / 1e3:.0f} km at most"
        )
    counts = np.maximum(np.ceil(lengths / ROUTE_STEP_M), 1).astype(np.int64)
    leg = np.repeat(np.arange(len(counts)), counts)
    share = (np.arange(len(leg)) - np.repeat(np.cumsum(counts) - counts, counts)) / counts[leg]
    longitude, latitude = (points[leg] + share[:, None] * np.diff(points, axis=0)[leg]).T
    cell = np.append(grid.cell_of(latitude, longitude), grid.cell_of(points[-1, 1], points[-1, 0]))
    sector = grid.sector_of(np.arctan2(steps[:, 1], steps[:, 0]))[np.append(leg, leg[-1])].astype(np.int64)
    _, first = np.unique(cell * grid.SECTORS + sector, return_index=True)
    order = np.sort(first)
    return cell[order], sector[order]


def render(cells: pa.RecordBatch, form: Format, tile: str) -> bytes:
    """A tile in one of the three forms."""
    if form is Format.ARROW:
        return arrow_stream(cells)
    rows = _plain(cells)
    if form is Format.JSON:
        return json.dumps({"tile": tile, "cells": rows}, allow_nan=False).encode()
    features = [{"type": "Feature", "geometry": _polygon(cell), "properties": cell} for cell in rows]
    return json.dumps({"type": "FeatureCollection", "features": features}, allow_nan=False).encode()


def _plain(table: pa.RecordBatch) -> list[dict[str, Any]]:
    """Rows with times as ISO 8601 text; single-precision numbers without the digits they do not have."""
    columns: dict[str, list[Any]] = {}
    for f in table.schema:
        if pa.types.is_timestamp(f.type):
            ns = table[f.name].cast(pa.int64()).to_numpy()
            columns[f.name] = np.datetime_as_string(ns.astype("datetime64[ns]"), "ms", "UTC").tolist()
        elif f.type == pa.float32():
            columns[f.name] = table[f.name].to_numpy().astype(np.float64).round(6).tolist()
        else:
            columns[f.name] = table[f.name].to_pylist()
    return [dict(zip(columns, row, strict=True)) for row in zip(*columns.values(), strict=True)]


def _polygon(cell: dict[str, Any]) -> dict[str, Any]:
    west, south, east, north = (cell[side] for side in ("west", "south", "east", "north"))
    return {
        "type": "Polygon",
        "coordinates": [[[west, south], [east, south], [east, north], [west, north], [west, south]]],
    }
