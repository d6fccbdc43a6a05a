"""Low friction along road links as costs for route planners: cost factors for Valhalla, a custom
model for GraphHopper. Pure (no I/O).

The factor is computed from the lower bound of friction. Only cells that were measured, or estimated
from neighbours ("borrowed"), count. In other cells the lower bound is low because no vehicle has
tested the grip, which does not mean that the road is slippery. A factor is a cost, not a time.
Valhalla also multiplies the reported travel time by the factor, so the time of a chosen route must
be queried again without factors.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from typing import Any, Final, NamedTuple

import numpy as np
import pyarrow as pa

from schemas import grid
from schemas.numeric import FloatArray, IntArray
from schemas.thresholds import METRES_PER_DEGREE

STEP_M: Final = 5.0  # [m] step along a link
# The cost factor of a road is (GOOD_GRIP/μ)^POWER, because braking distance grows with 1/μ. With
# the square, a detour may be a fifth longer than a road of μ = .45, and ten times as long as one of
# μ = .16.
GOOD_GRIP: Final = 0.5  # lower bound of μ on a wet road, with factor 1
POWER: Final = 2.0
# Largest cost factor. Valhalla refuses larger ones, and then finds no route to a destination on
# ice.
MOST: Final = 20.0
# Cost factors are rounded to these classes. Neighbouring parts of one class become one line.
STEPS: Final = (1.0, 1.5, 2.5, 5.0, 10.0, MOST)
SHORTEST_M: Final = 15.0  # [m] shortest line that can be placed on a link
# A cell is excluded as ice if its upper bound of μ and its P(slippery) pass these limits.
ICE_LOWER = 0.3
ICE_SURE = 0.9
HALF_WIDTH_M: Final = 8.0  # [m] half width of the polygon around a road


class RoadLine(NamedTuple):
    """Directed polyline of a road: latitude and longitude [deg] in the order of travel."""

    latitude: FloatArray
    longitude: FloatArray


class CostLine(NamedTuple):
    """Part of a road with one cost factor for route planners; points are (longitude, latitude)
    [deg].
    """

    factor: float
    points: list[tuple[float, float]]


def cost_factors(mu_lower: FloatArray) -> FloatArray:
    """Return the cost factor for each lower bound of friction (n,). The factor is 1 if the lower
    bound is GOOD_GRIP or more, and never above MOST.
    """
    ratio = GOOD_GRIP / np.maximum(mu_lower, 1e-3)
    exact = np.clip(ratio**POWER, 1.0, MOST)
    steps = np.array(STEPS)
    return np.asarray(steps[np.searchsorted(steps, exact - 1e-9)], np.float64)


def cost_lines(table: pa.Table, roads: Iterable[RoadLine]) -> list[CostLine]:
    """Return the parts of roads that route planners should avoid, with a cost factor above 1.

    Args:
        table: cells of the map, as a query returns them.
        roads: directed links of the road network.
    """
    key, factor = _sorted_factors(table)
    out: list[CostLine] = []
    for road in roads:
        latitude, longitude, yaw = _sample_road(road)
        if not len(latitude):
            continue
        place = grid.SECTORS * grid.cell_of(latitude, longitude) + grid.sector_of(yaw)
        found = np.searchsorted(key, place)
        found[found == len(key)] = 0
        cost = (
            np.where(key[found] == place, factor[found], 1.0) if len(key) else np.ones(len(place))
        )
        out += _find_cost_runs(cost, latitude, longitude)
    return out


def explain_no_line(table: pa.Table, roads: str) -> str:
    """Return the reason why no road has a cost, for a user. `table` contains the cells of the map,
    and `roads` is the file of the road network.
    """
    _, factor = _sorted_factors(table)
    low = int(np.sum(factor > 1.0))
    if not table.num_rows:
        return "the map has no cells there, so nothing is known about the roads"
    if not low:
        return f"no cell of {table.num_rows} is known to have low grip, so nothing is avoided"
    west = _float_column(table, "west").min()
    south = _float_column(table, "south").min()
    east = _float_column(table, "east").max()
    north = _float_column(table, "north").max()
    return (
        f"{low} cells have low grip, but none is on a road of {roads}; the map covers "
        f"{west:.3f},{south:.3f},{east:.3f},{north:.3f} (longitude first)"
    )


def ice_cells(table: pa.Table) -> list[list[tuple[float, float]]]:
    """Return the outlines (rings of (longitude, latitude) [deg]) of the cells that are almost
    certainly icy.
    """
    upper, slippery = (
        np.nan_to_num(_float_column(table, name), nan=1.0) for name in ("mu_upper", "p_slippery")
    )
    ice = (upper < ICE_LOWER) & (slippery >= ICE_SURE) & _has_evidence(table)
    cells = np.unique(np.asarray(table["cell"].to_numpy(), np.int64)[ice])
    west, south, east, north = grid.bounds(cells)
    corners = zip(west.tolist(), south.tolist(), east.tolist(), north.tolist(), strict=True)
    return [[(w, s), (e, s), (e, n), (w, n), (w, s)] for w, s, e, n in corners]


def valhalla_request(
    lines: Sequence[CostLine], rings: Sequence[list[tuple[float, float]]] = ()
) -> dict[str, Any]:
    """Return the fields (edge costs and areas to avoid) that must be merged into a route request to
    Valhalla.
    """
    features = [
        {
            "type": "Feature",
            "properties": {"factor": line.factor},
            "geometry": {"type": "LineString", "coordinates": line.points},
        }
        for line in lines
    ]
    found: dict[str, Any] = {"linear_cost_factors": features}
    if rings:
        found["exclude_polygons"] = list(rings)
    return found


def graphhopper_model(lines: Sequence[CostLine]) -> dict[str, Any]:
    """Return a custom model for GraphHopper: one area for each cost factor, and the priority of
    roads in it.
    """
    areas = []
    priority = []
    for number, factor in enumerate(STEPS[1:], 1):
        rings = [[_ring_around(line.points)] for line in lines if line.factor == factor]
        if not rings:
            continue
        name = f"low_grip_{number}"
        shape = {"type": "MultiPolygon", "coordinates": rings}
        areas.append({"type": "Feature", "id": name, "properties": {}, "geometry": shape})
        priority.append({"if": f"in_{name}", "multiply_by": f"{1.0 / factor:.3f}"})
    return {"priority": priority, "areas": {"type": "FeatureCollection", "features": areas}}


def _float_column(table: pa.Table, name: str) -> FloatArray:
    return np.asarray(table[name].to_numpy(), np.float64)


def _has_evidence(table: pa.Table) -> np.ndarray[Any, np.dtype[np.bool_]]:
    return np.array(
        [basis in ("measured", "borrowed") for basis in table["basis"].to_pylist()], np.bool_
    )


def _sorted_factors(table: pa.Table) -> tuple[IntArray, FloatArray]:
    """Return two arrays (n,): the keys (cell · 4 + sector) of the map's cells in ascending order,
    and the cost factor of each.
    """
    counts = _has_evidence(table)
    cell, sector = (
        np.asarray(table[name].to_numpy(), np.int64)[counts] for name in ("cell", "sector")
    )
    factor = cost_factors(_float_column(table, "mu_lower")[counts])
    key = grid.SECTORS * cell + sector
    order = np.argsort(key)
    return key[order], factor[order]


def _sample_road(road: RoadLine) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Return latitude, longitude [deg] and yaw [rad] (n,) of points every STEP_M along a road;
    empty arrays for a road without length.
    """
    east = METRES_PER_DEGREE * np.cos(np.radians(float(np.mean(road.latitude))))
    dx = np.diff(road.longitude) * east
    dy = np.diff(road.latitude) * METRES_PER_DEGREE
    steps = np.hypot(dx, dy)
    keep = np.r_[True, steps > 0.0]
    run = np.r_[0.0, np.cumsum(steps)][keep]
    if len(run) < 2:
        return np.empty(0), np.empty(0), np.empty(0)
    at = np.linspace(0.0, run[-1], max(2, int(np.ceil(run[-1] / STEP_M)) + 1))
    piece = np.minimum(np.searchsorted(run, at, side="right") - 1, len(run) - 2)
    yaw = np.arctan2(dy, dx)[steps > 0.0][piece]
    return np.interp(at, run, road.latitude[keep]), np.interp(at, run, road.longitude[keep]), yaw


def _find_cost_runs(
    cost: FloatArray, latitude: FloatArray, longitude: FloatArray
) -> list[CostLine]:
    """Return the parts of a road in which the cost factor (`cost`, one per point) is the same and
    above 1. A part shorter than SHORTEST_M is extended at both ends.
    """
    ends = np.flatnonzero(np.r_[True, np.diff(cost) != 0.0, True])
    out = []
    for first, last in zip(ends[:-1].tolist(), ends[1:].tolist(), strict=True):
        if cost[first] <= 1.0:
            continue
        begin = first
        end = min(last, len(cost) - 1)
        while (end - begin) * STEP_M < SHORTEST_M and (begin > 0 or end < len(cost) - 1):
            begin = max(begin - 1, 0)
            end = min(end + 1, len(cost) - 1)
        points = list(
            zip(
                longitude[begin : end + 1].tolist(), latitude[begin : end + 1].tolist(), strict=True
            )
        )
        out.append(CostLine(float(cost[first]), points))
    return out


def _ring_around(points: Sequence[tuple[float, float]]) -> list[tuple[float, float]]:
    """Return a ring (closed polygon) around a line, HALF_WIDTH_M wide on both sides."""
    longitude, latitude = np.array(points).T
    east = METRES_PER_DEGREE * np.cos(np.radians(latitude.mean()))
    dx = np.gradient(longitude) * east
    dy = np.gradient(latitude) * METRES_PER_DEGREE
    length = np.maximum(np.hypot(dx, dy), 1e-9)
    across_x = -dy / length * HALF_WIDTH_M / east
    across_y = dx / length * HALF_WIDTH_M / METRES_PER_DEGREE
    left = list(zip((longitude + across_x).tolist(), (latitude + across_y).tolist(), strict=True))
    right = list(zip((longitude - across_x).tolist(), (latitude - across_y).tolist(), strict=True))
    ring = [*left, *right[::-1]]
    return [*ring, ring[0]]
