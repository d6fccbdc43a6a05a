"""`vehicles`: for each vehicle, the deviation of its friction values from the values of other
vehicles in the same cell and hour, and the health of its sensors.
"""

from __future__ import annotations

import ibis
import pyarrow as pa

from fleet_service.analytics.engines import QueryEngine, Table, has_value
from fleet_service.analytics.options import Options

HOUR_S = 3600


def expression(t: Table) -> Table:
    """Return a table with one row per vehicle. The column `bias` is the deviation of the vehicle's
    friction values from the values of other vehicles in the same cell and hour. `bias` is null if
    there are no such values of other vehicles.

    `bias` is the mean of (own mean - mean of the other vehicles) over cells and hours. `bias_std`
    is its standard error, and `z` is |bias| / bias_std.
    """
    reported = has_value(t)
    mine = t.group_by("vehicle").aggregate(
        observations=t.count(),
        late=t.late.sum(),
        unwell=(t.health != 0).mean(),
        weight=t.weight.cast("float64").mean(),
        speed=t.speed.cast("float64").mean(),
    )
    v = t.filter(reported).select(
        "cell",
        "sector",
        "vehicle",
        hour=(t.time / HOUR_S).floor().cast("int64"),
        y=t.mu.cast("float64"),
    )
    place = ["cell", "sector", "hour"]
    each = v.group_by([*place, "vehicle"]).aggregate(n=v.count(), s=v.y.sum())
    w = ibis.window(group_by=place)
    each = each.mutate(
        others=each.n.sum().over(w) - each.n, other_sum=each.s.sum().over(w) - each.s
    )
    shared = each.filter(each.others > 0)
    shared = shared.mutate(d=shared.s / shared.n - shared.other_sum / shared.others)
    bias = shared.group_by("vehicle").aggregate(
        meetings=shared.count(), bias=shared.d.mean(), spread=shared.d.var(how="pop")
    )
    values = each.group_by("vehicle").aggregate(values=each.n.sum())
    found = (
        mine.left_join(values, "vehicle")
        .drop("vehicle_right")
        .left_join(bias, "vehicle")
        .drop("vehicle_right")
    )
    error = (found.spread / found.meetings).sqrt()
    found = found.mutate(
        values=found["values"].fill_null(0), meetings=found.meetings.fill_null(0), bias_std=error
    )
    z = ibis.ifelse(found.bias_std > 0, found.bias.abs() / found.bias_std, ibis.null("float64"))
    return found.mutate(z=z).drop("spread")


def ask(engine: QueryEngine, _: Options) -> pa.Table:
    """Return a table with one row per vehicle in the selected part of the archive. A row states how
    far the vehicle's friction values deviate from the values of other vehicles in the same cell and
    hour. The docstring of `expression` explains the columns.
    """
    return engine.answer(expression(engine.observations()))
