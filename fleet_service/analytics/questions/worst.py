"""`worst`: slippery cells, merged with their neighbours into stretches, with length, traffic and
statistical confidence.
"""

from __future__ import annotations

from typing import Any, Final

import ibis
import numpy as np
import pyarrow as pa
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components

from fleet_service.analytics.engines import QueryEngine, Table, has_value
from fleet_service.analytics.options import Options
from schemas import grid
from schemas.numeric import FloatArray, IntArray
from schemas.thresholds import METRES_PER_DEGREE, SLIPPERY_MU, Z_95

# Least share of slippery values in a cell: for example, a road that freezes in one night of ten.
SHARE: Final = 0.1


def expression(t: Table, least_vehicles: int) -> Table:
    """Return a table of the cells and heading sectors in which at least the share SHARE of the
    values is slippery, and at least `least_vehicles` vehicles reported slippery values.
    """
    reported = has_value(t)
    cells = t.group_by(["cell", "sector"]).aggregate(
        observations=t.count(),
        values=reported.sum(),
        slippery=(reported & (t.mu < SLIPPERY_MU)).sum(),
        mu_sum=ibis.ifelse(reported & (t.mu < SLIPPERY_MU), t.mu.cast("float64"), 0.0).sum(),
        witnesses=ibis.ifelse(
            reported & (t.mu < SLIPPERY_MU), t.vehicle, ibis.null("string")
        ).nunique(),
    )
    return cells.filter(
        cells.slippery >= SHARE * cells["values"],
        cells.slippery > 0,
        cells.witnesses >= least_vehicles,
    )


def ask(engine: QueryEngine, options: Options) -> pa.Table:
    """Return a table of slippery stretches of road, the worst first. The stretches are sorted by
    their length times the lower confidence bound of their share of slippery values.
    """
    cells = engine.answer(expression(engine.observations(), options.least_vehicles))
    return join_stretches(cells)


def join_stretches(cells: pa.Table) -> pa.Table:
    """Return a table with one row per slippery stretch: a stretch is a group of touching cells of
    the same heading sector. `members` are its cells, and its box encloses them.
    """
    column = {name: cells[name].to_numpy() for name in cells.schema.names}
    label = _label_components(column["cell"], column["sector"].astype(np.int64))
    count = int(label.max(initial=-1)) + 1

    def sum_by_stretch(values: Any) -> FloatArray:  # noqa: ANN401 columns of several types
        return np.asarray(np.bincount(label, values, minlength=count), np.float64)

    west, south, east, north = _bounding_boxes(column["cell"], label, count)
    metres = np.cos(np.radians((south + north) / 2)) * METRES_PER_DEGREE
    length = np.hypot((east - west) * metres, (north - south) * METRES_PER_DEGREE)
    values = sum_by_stretch(column["values"])
    slippery = sum_by_stretch(column["slippery"])
    lower = wilson_lower(slippery, values)
    first = np.full(count, np.iinfo(np.int64).max)
    np.minimum.at(first, label, column["cell"])
    sector = np.zeros(count, np.int8)
    sector[label] = column["sector"]
    found = {
        "cell": first,
        "sector": sector,
        "cells": np.bincount(label, minlength=count),
        "length_m": length,
        "exposure": sum_by_stretch(column["observations"]).astype(np.int64),
        "values": values.astype(np.int64),
        "share_slippery": slippery / np.maximum(values, 1),
        "share_lower": lower,
        "mu": sum_by_stretch(column["mu_sum"]) / np.maximum(slippery, 1),
        "score": lower * length,
        "west": west,
        "south": south,
        "east": east,
        "north": north,
        "members": _stretch_cells(column["cell"], label, count),
    }
    return pa.table(found).sort_by([("score", "descending"), ("cell", "ascending")])


def wilson_lower(hits: FloatArray, of: FloatArray) -> FloatArray:
    """Return the lower 95 % confidence bound (Wilson 1927) of the share `hits` / `of`, (n,) each.
    `of` is a number of observations, and `hits` the number of those with some property, for example
    slippery.
    """
    n = np.maximum(of, 1.0)
    p = hits / n
    spread = Z_95 * np.sqrt(p * (1 - p) / n + Z_95**2 / (4 * n * n))
    return np.asarray((p + Z_95**2 / (2 * n) - spread) / (1 + Z_95**2 / n))


def _label_components(cell: IntArray, sector: IntArray) -> IntArray:
    """Return the number of the group to which each cell belongs, (n,). Cells belong to the same
    group if a chain of touching cells of the same heading sector connects them.
    """
    key = cell * grid.SECTORS + sector
    order = np.argsort(key)
    neighbour_key = grid.neighbours(cell) * grid.SECTORS + sector[:, None]
    place = np.searchsorted(key[order], neighbour_key)
    neighbour_row = order[np.minimum(place, len(key) - 1)] if len(key) else place
    touches = (
        key[neighbour_row] == neighbour_key if len(key) else np.zeros_like(neighbour_key, bool)
    )
    own_row = np.broadcast_to(np.arange(len(key))[:, None], neighbour_key.shape)
    edges = coo_array(
        (np.ones(int(touches.sum()), bool), (own_row[touches], neighbour_row[touches])),
        shape=(len(key), len(key)),
    )
    return np.asarray(connected_components(edges, directed=False)[1], np.int64)


def _stretch_cells(cell: IntArray, label: IntArray, count: int) -> pa.Array[Any]:
    """Return, for each slippery stretch, the list of its cells. With these cells a bent road can be
    drawn in its true shape instead of its bounding box.
    """
    order = np.lexsort((cell, label))
    ends = np.concatenate([[0], np.cumsum(np.bincount(label, minlength=count))])
    return pa.LargeListArray.from_arrays(
        pa.array(ends, pa.int64()), pa.array(cell[order], pa.int64())
    )


def _bounding_boxes(cell: IntArray, label: IntArray, count: int) -> tuple[FloatArray, ...]:
    """Return west, south, east and north edges [deg] of the stretches, (count,) each. The east of a
    stretch over the 180° meridian is above 180°.
    """
    west, south, east, north = grid.bounds(cell)
    furthest_east = np.full(count, -np.inf)
    np.maximum.at(furthest_east, label, east)
    shift = np.where(furthest_east[label] - east > 180.0, 360.0, 0.0)
    out = []
    sides = (west + shift, south, east + shift, north)
    for side, least in zip(sides, (True, True, False, False), strict=True):
        extreme = np.full(count, np.inf if least else -np.inf)
        choose = np.minimum if least else np.maximum
        choose.at(extreme, label, side)
        out.append(extreme)
    return tuple(out)
