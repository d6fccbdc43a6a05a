"""Encoding of map cells (a `CellView`) as Arrow, GeoJSON or JSON. Pure (no I/O)."""

from __future__ import annotations

import json
from collections.abc import Iterable
from typing import Any, Final

import numpy as np
import pyarrow as pa

from fleet_service.fusion import Fusion
from fleet_service.fusion.belief import quantiles
from fleet_service.serve.view import LOWER, UPPER, CellView, is_measured, view_cells
from schemas import grid, mugrid, tables
from schemas.numeric import IntArray
from schemas.query import Format
from schemas.thresholds import GRAVITY

_BASES: Final = pa.array(["bound", "measured", "borrowed"])
_BOUND = 0
_BORROWED = 2
_SCHEMA: Final = tables.MAP_SCHEMA.serialize().to_pybytes()
# A message of this form (continuation marker, metadata length 0) ends an Arrow stream.
_END: Final = b"\xff\xff\xff\xff\x00\x00\x00\x00"


def batch_of(cells: CellView, now: int) -> pa.RecordBatch:
    """Return cells of the map as an Arrow record batch with the columns of the published map, with
    their age at `now` [ns]. `mu` is null for a cell with only a lower bound.
    """
    latitude, longitude = grid.centre(cells.cell)
    west, south, east, north = grid.bounds(cells.cell)
    lower, middle, upper = quantiles(cells.belief, (LOWER, 0.5, UPPER))
    slippery = cells.belief @ mugrid.SLIPPERY_SHARE
    basis = np.where(cells.imputed, _BORROWED, is_measured(lower, upper, cells.values, slippery))
    columns: dict[str, Any] = {
        "cell": cells.cell,
        "sector": cells.sector,
        "mu": pa.array(middle, mask=basis == _BOUND),
        "mu_lower": lower,
        "mu_upper": upper,
        "p_slippery": slippery,
        "basis": _BASES.take(basis.astype(np.int8)),
        "vehicles": cells.vehicles,
        "observations": cells.observations,
        "first_time": cells.first,
        "last_time": cells.last,
        "age_s": np.maximum(now - cells.last, 0) * 1e-9,
        "latitude": latitude,
        "longitude": longitude,
        "west": west,
        "south": south,
        "east": east,
        "north": north,
        "safe_deceleration": GRAVITY * lower,
    }
    found = ((columns[f.name], f.type) for f in tables.MAP_SCHEMA)
    arrays = [
        (c if isinstance(c, pa.Array) else pa.array(c)).cast(kind, safe=False) for c, kind in found
    ]
    return pa.RecordBatch.from_arrays(arrays, schema=tables.MAP_SCHEMA)


def cell_table(fusion: Fusion, slots: IntArray, now: int) -> pa.Table:
    """Return the cells of `slots` (one per cell and heading sector) as a table with the columns of
    the published map, with friction and its interval for the time `now` [ns].
    """
    return pa.Table.from_batches([batch_of(view_cells(fusion, slots, now), now)])


def encode_tile(cells: pa.RecordBatch, form: Format, tile: int) -> bytes:
    """Return the cells of a tile encoded as Arrow, GeoJSON or JSON."""
    if form is Format.ARROW:
        return arrow_stream(cells)
    rows = _json_rows(cells)
    if form is Format.JSON:
        name = grid.quadkey(tile, grid.TILE_ZOOM)
        return f'{{"tile": "{name}", "cells": [{_encode_rows(rows)}]}}'.encode()
    outlines = np.stack(
        grid.outline(cells["cell"].to_numpy(), cells["sector"].to_numpy()), axis=-1
    ).tolist()
    features = (
        {
            "type": "Feature",
            "geometry": {"type": "Polygon", "coordinates": [[*ring, ring[0]]]},
            "properties": cell,
        }
        for ring, cell in zip(outlines, rows, strict=True)
    )
    return f'{{"type": "FeatureCollection", "features": [{_encode_rows(features)}]}}'.encode()


def _encode_rows(rows: Iterable[dict[str, Any]]) -> str:
    """Return rows (cells) as JSON text. They are encoded one by one, because a single call for
    thousands of rows would hold the interpreter lock too long.
    """
    return ", ".join(json.dumps(row, allow_nan=False) for row in rows)


def arrow_stream(cells: pa.RecordBatch) -> bytes:
    """Return a record batch of map cells as the bytes of an Arrow stream."""
    return b"".join([_SCHEMA, cells.serialize(), _END])


def _json_rows(table: pa.RecordBatch) -> list[dict[str, Any]]:
    """Return rows (cells) of a table as dictionaries for JSON: times as ISO 8601 text, floats
    rounded to single precision.
    """
    columns: dict[str, list[Any]] = {}
    for f in table.schema:
        if pa.types.is_timestamp(f.type):
            ns = table[f.name].cast(pa.int64()).to_numpy()
            columns[f.name] = np.datetime_as_string(
                ns.astype("datetime64[ns]"), "ms", "UTC"
            ).tolist()
        elif f.type == pa.float32():
            numbers = table[f.name].to_numpy(zero_copy_only=False).astype(np.float64).round(6)
            columns[f.name] = [number if number == number else None for number in numbers.tolist()]
        else:
            columns[f.name] = table[f.name].to_pylist()
    return [dict(zip(columns, row, strict=True)) for row in zip(*columns.values(), strict=True)]
