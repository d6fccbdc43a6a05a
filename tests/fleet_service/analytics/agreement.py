"""Comparison of the answers of two query engines. The answers must have the same rows, and
floating-point numbers that agree within RELATIVE and ABSOLUTE.
"""

from __future__ import annotations

from typing import Literal, TypeAlias

import numpy as np
import pyarrow as pa

from fleet_service.analytics.output import order_rows
from fleet_service.analytics.questions import Question
from fleet_service.analytics.roads.join import join_roads
from fleet_service.analytics.roads.network import DirectedLink, RoadNetwork
from schemas import grid
from schemas.numeric import IntArray

# Tolerances. The two engines add sums in different orders. Percentiles, counts and times are exact
# in both.
RELATIVE = 1e-9
ABSOLUTE = 1e-9
Order: TypeAlias = list[tuple[str, Literal["ascending", "descending"]]]


def differs(one: pa.Table, other: pa.Table, question: Question) -> str | None:
    """Compare two answers to the same question (predefined query), one from DuckDB and one from
    Spark. Return a description of their first difference, or None if they agree.
    """
    if one.schema.names != other.schema.names or one.num_rows != other.num_rows:
        return (
            f"{one.num_rows} rows of {one.schema.names}, {other.num_rows} of {other.schema.names}"
        )
    keys = [
        "day",
        "cell",
        "sector",
        "onset",
        "vehicle",
        "period",
        "basis",
        "age_h",
        "temperature",
        "frame",
    ]
    by: list[tuple[str, Literal["ascending", "descending"]]] = [
        (name, "ascending") for name in keys if name in one.schema.names
    ]
    one, other = (order_rows(table, question) for table in (one, other))
    if by:
        one = one.sort_by(by)
        other = other.sort_by(by)
    for name in one.schema.names:
        a = one[name].to_pylist()
        b = other[name].to_pylist()
        if pa.types.is_floating(one[name].type):
            x, y = (
                np.array([np.nan if v is None else float(v) for v in column]) for column in (a, b)
            )
            if not np.allclose(x, y, RELATIVE, ABSOLUTE, equal_nan=True):
                return f"{name}: by up to {np.nanmax(np.abs(x - y)):.3g}"
        elif a != b:
            return f"{name}: {next((x, y) for x, y in zip(a, b, strict=True) if x != y)}"
    return None


def roads_along(cells: IntArray) -> pa.Table:
    """Return a road network as a table with the columns that `fleet-service roads` writes. Its
    links follow the rows of the given cells, forty cells per link. One more link lies where no
    vehicle drove.
    """
    x, y = grid.deinterleave(cells)
    found = []
    for line in np.unique(y):
        on = np.sort(np.unique(x[y == line]))
        for k in range(0, len(on) - 1, 40):
            ends = grid.interleave(on[[k, min(k + 40, len(on) - 1)]], np.full(2, line))
            latitude, longitude = grid.centre(ends)
            found.append(
                DirectedLink(
                    f"{line}-{k}", "forward", f"road {line}", "primary", latitude, longitude
                )
            )
            found.append(
                DirectedLink(
                    f"{line}-{k}",
                    "backward",
                    f"road {line}",
                    "primary",
                    latitude[::-1],
                    longitude[::-1],
                )
            )
    found.append(
        DirectedLink("nobody", "forward", "", "", np.array([10.0, 10.0]), np.array([10.0, 10.01]))
    )
    return join_roads(RoadNetwork(found, {}))
