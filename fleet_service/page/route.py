"""Friction along a route, as a list of stretches in driving order. A stretch lies within one cell
and heading, and is measured or not.

An unmeasured part is a stretch without a value. It counts neither as dry nor as slippery, but its
length is counted.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, Final

import numpy as np
import pyarrow as pa

from schemas import grid
from schemas.errors import InputError
from schemas.regions import sample_route
from schemas.stopping import stopping_speed

MOST_M: Final = 200_000.0  # [m] longest route that can be displayed
UNKNOWN: Final = "unknown"
SIGHTS_M: Final = (50, 100)
Points = Sequence[tuple[float, float]]


def grip_profile(points: Points, table: pa.Table) -> dict[str, Any]:
    """Return the friction along a route of (longitude, latitude) [deg], from the cells that a
    service returned.

    Returns:
        a dictionary with four keys.
        length_m: length of the route.
        share: share of the length by basis of the value: "measured", "bound" (not measured, only
            bounds), "borrowed" (estimated from neighbouring cells) or "unknown".
        stretches: list of dictionaries in driving order. Each has `from_m` and `to_m` (distance
            from the start), `longitude` and `latitude` of the middle of the stretch, and `basis`.
            Unless the basis is "unknown", values of the map cell follow, such as `mu_lower`,
            `mu_upper`, `p_slippery` and `age_s` (time since the last observation). Measured
            stretches also have `mu`, and `safe_speed` (highest safe speed [m/s] for each sight
            distance [m]).
        worst: index of the measured stretch with the lowest `mu_lower`, or None.

    Raises:
        InputError: the route is too long or not valid.
    """
    if len(points) < 2:
        raise InputError("route", "needs two points", "click two or more")
    samples = sample_route(points, MOST_M)
    along = samples.along
    length = float(along[-1])
    if length == 0.0:
        raise InputError("route", "has no length", "click two different points")
    keys = samples.keys
    known = {
        int(cell) * grid.SECTORS + int(heading): row
        for row, (cell, heading) in enumerate(
            zip(table["cell"].to_numpy(), table["sector"].to_numpy(), strict=True)
        )
    }
    rows = np.array([known.get(key, -1) for key in keys.tolist()])
    runs = np.flatnonzero(
        np.append(True, (keys[1:] != keys[:-1]) & ~((rows[1:] < 0) & (rows[:-1] < 0)))
    )
    ends = np.append(runs[1:], len(keys) - 1)
    cells = table.to_pylist()
    stretches: list[dict[str, Any]] = []
    share = dict.fromkeys(("measured", "bound", "borrowed", UNKNOWN), 0.0)
    for first, last in zip(runs.tolist(), ends.tolist(), strict=True):
        if along[last] <= along[first]:
            continue
        middle = (first + last) // 2
        place = {
            "from_m": round(float(along[first]), 1),
            "to_m": round(float(along[last]), 1),
            "longitude": (float(samples.longitude[middle]) + 180.0) % 360.0 - 180.0,
            "latitude": float(samples.latitude[middle]),
        }
        stretches.append(
            place | (_describe_cell(cells[rows[first]]) if rows[first] >= 0 else {"basis": UNKNOWN})
        )
        share[stretches[-1]["basis"]] += float(along[last] - along[first]) / length
    measured = [k for k, one in enumerate(stretches) if one["basis"] == "measured"]
    worst = min(measured, key=lambda k: stretches[k]["mu_lower"], default=None)
    return {"length_m": length, "share": share, "stretches": stretches, "worst": worst}


def safe_speeds(mu_lower: float) -> dict[str, float]:
    """Return the highest speed [m/s] from which a car can stop within each sight distance [m],
    given the lower bound of mu. The keys are the distances as text.
    """
    return {str(sight): float(stopping_speed(mu_lower, sight)) for sight in SIGHTS_M}


def _describe_cell(cell: dict[str, Any]) -> dict[str, Any]:
    measured = cell["basis"] == "measured"
    names = ("cell", "sector", "basis", "mu_lower", "mu_upper", "p_slippery", "vehicles", "age_s")
    return {name: cell[name] for name in names} | {
        "mu": cell["mu"] if measured else None,
        "cell": str(cell["cell"]),
        "safe_speed": safe_speeds(cell["mu_lower"]) if measured else None,
    }
