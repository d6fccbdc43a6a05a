"""Answers: which cells a query asks for, and the three forms of a tile. Pure."""

from __future__ import annotations

import json
from collections.abc import Callable, Iterator
from typing import Any, Final

import numpy as np
import pyarrow as pa

from fleet_service.borrow import borrowed
from fleet_service.map_state import MapState, arrow_stream, cell_table
from schemas import grid
from schemas.errors import InputError
from schemas.numeric import BoolArray, IntArray
from schemas.query import Format, MapQuery

ROUTE_STEP_M: Final = 4.0  # less than half a cell at 60° of latitude: no cell on the way is missed
ROUTE_MOST_M: Final = 500_000.0
_METRES_PER_DEGREE: Final = 111_195.0  # of a great circle on the mean earth


def answer(state: MapState, query: MapQuery, wanted: Callable[[int], bool], now: int) -> Iterator[tuple[int, bytes]]:
    """Tile and payload of every reply.

    Args:
        state: the map.
        query: what is asked.
        wanted: whether a tile's key matches the query's.
        now: for ages and forgetting [ns].

    Raises:
        InputError: the route is too long.
    """
    route = along(query) if query.route else None
    for tile in state.tiles() if route is None else np.unique(grid.tile_of(route[0])).tolist():
        if wanted(tile) and _near(tile, query):
            table = select(state, tile, query, route, now)
            if table.num_rows:
                yield tile, render(table, query.format, grid.quadkey(tile, grid.TILE_ZOOM))


def select(state: MapState, tile: int, query: MapQuery, route: tuple[IntArray, IntArray] | None, now: int) -> pa.Table:
    """The cells of one tile that a query asks for; along a route in its order."""
    if route is None:
        slots = state.slots(tile)
    else:
        ahead = grid.tile_of(route[0]) == tile
        slots = state.fusion.slots_of(route[0][ahead], route[1][ahead])
        slots = slots[slots >= 0]
    table = cell_table(state.fusion, slots, now)
    if query.basis == "borrowed":
        table = pa.concat_tables([table, borrowed(state.fusion, tile, state.slots(tile), route, now)])
    return table.filter(pa.array(_asked(table, query)))


def _asked(table: pa.Table, query: MapQuery) -> BoolArray:
    """Rows with enough vehicles that touch the box, (k,)."""
    keep = table["vehicles"].to_numpy() >= query.min_vehicles
    if query.bbox is not None:
        west, south, east, north = query.bbox
        keep &= (table["east"].to_numpy() > west) & (table["west"].to_numpy() < east)
        keep &= (table["north"].to_numpy() > south) & (table["south"].to_numpy() < north)
    return np.asarray(keep)


def along(query: MapQuery) -> tuple[IntArray, IntArray]:
    """Cell and sector of everything a route passes, in its order, each once.

    Raises:
        InputError: longer than ROUTE_MOST_M.
    """
    points = np.array(query.route)
    scale = np.cos(np.radians(points[:-1, 1].mean()))
    steps = np.diff(points, axis=0) * [_METRES_PER_DEGREE * scale, _METRES_PER_DEGREE]
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


def _near(tile: int, query: MapQuery) -> bool:
    if query.bbox is None:
        return True
    west, south, east, north = (float(v) for v in grid.bounds(tile, grid.TILE_ZOOM))
    return bool(east > query.bbox[0] and north > query.bbox[1] and west < query.bbox[2] and south < query.bbox[3])


def render(table: pa.Table, form: Format, tile: str) -> bytes:
    """A tile in one of the three forms."""
    if form is Format.ARROW:
        return arrow_stream(table)
    cells = _plain(table)
    if form is Format.JSON:
        return json.dumps({"tile": tile, "cells": cells}, allow_nan=False).encode()
    features = [{"type": "Feature", "geometry": _polygon(cell), "properties": cell} for cell in cells]
    return json.dumps({"type": "FeatureCollection", "features": features}, allow_nan=False).encode()


def _plain(table: pa.Table) -> list[dict[str, Any]]:
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
