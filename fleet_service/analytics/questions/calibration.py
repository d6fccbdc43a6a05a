"""`calibration`: how often later values lay within the interval that the map had published.

Each value is compared with the map snapshots of the preceding HORIZON_S. The share `held` counts
values that lie inside the published interval. The value's own error is part of this figure, so a
calibrated 90 % map stays slightly below 0.9. The share `compatible` counts values whose own
interval overlaps the published interval.
"""

from __future__ import annotations

from typing import Final

import pyarrow as pa

from fleet_service.analytics.engines import QueryEngine, Table, has_value
from fleet_service.analytics.options import Options

HORIZON_S: Final = 6 * 3600
_HOUR_S: Final = 3600


def expression(t: Table, maps: Table) -> Table:
    """Return a table with one row for each basis of the map's interval (measured, estimated from
    neighbouring cells, or only a lower bound) and each number of hours between snapshot and value.
    `held` is the share of the values that lie inside the map's interval. `compatible` is the share
    of the values whose own interval overlaps it.
    """
    t = t.filter(has_value(t)).select(
        "cell",
        "sector",
        "time",
        "vehicle",
        y=t.mu.cast("float64"),
        low=t.mu_lower.cast("float64"),
        high=t.mu_upper.cast("float64"),
    )
    joined = t.inner_join(maps, ["cell", "sector"])
    joined = joined.filter(
        joined.time > joined.snapshot, joined.time <= joined.snapshot + HORIZON_S
    )
    inside = (joined.y >= joined.mu_lower) & (joined.y <= joined.mu_upper)
    touches = (joined.high >= joined.mu_lower) & (joined.low <= joined.mu_upper)
    age = ((joined.time - joined.snapshot) / _HOUR_S).floor().cast("int64")
    joined = joined.mutate(
        age_h=age, inside=inside.cast("float64"), touches=touches.cast("float64")
    )
    width = (joined.mu_upper - joined.mu_lower).cast("float64")
    return joined.group_by(["basis", "age_h"]).aggregate(
        values=joined.count(),
        by=joined.vehicle.nunique(),
        held=joined.inside.mean(),
        compatible=joined.touches.mean(),
        error=(joined.y - joined.mu.cast("float64")).mean(),
        width=width.mean(),
    )


def ask(engine: QueryEngine, _: Options) -> pa.Table:
    """Answer the question for the selected part of the archive. Return a table that states how
    often later friction values lay within the map's intervals; `expression` describes its rows.
    """
    return engine.answer(expression(engine.observations(), engine.maps()))
