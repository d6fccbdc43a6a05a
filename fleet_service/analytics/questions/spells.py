"""`spells`: begin and duration of slippery spells, and the time until a second vehicle reported
each spell.

A spell is a sequence of values below SLIPPERY_MU in one cell and heading sector, in order of time.
It ends with the first value that is not slippery. Only spells that at least `least_vehicles`
vehicles reported are listed. The alert time is that of the first value of a second vehicle, as in
the service.
"""

from __future__ import annotations

import ibis
import pyarrow as pa

from fleet_service.analytics.engines import QueryEngine, Table, has_value
from fleet_service.analytics.options import Options
from schemas.thresholds import SLIPPERY_MU


def expression(t: Table, least_vehicles: int) -> Table:
    """Return a table with one row per slippery spell: its place, begin, end, duration and vehicles.
    If a spell has not ended (`lasts`), `end` is null and `duration_s` is a minimum.
    """
    t = t.filter(has_value(t)).select(
        "cell", "sector", "time", "vehicle", "boot", "seq", "row", "mu"
    )
    place = ["cell", "sector"]
    order = ["time", "vehicle", "boot", "seq", "row"]
    t = t.mutate(slippery=(t.mu < SLIPPERY_MU).cast("int64"))
    w = ibis.window(group_by=place, order_by=order)
    before = t.slippery.lag().over(w)
    t = t.mutate(
        new=(before.isnull() | (before != t.slippery)).cast("int64"),
        following=t.time.lead().over(w),
    )
    t = t.mutate(
        run=t.new.sum().over(
            ibis.window(group_by=place, order_by=order, preceding=None, following=0)
        )
    )
    t = t.filter(t.slippery == 1)
    spell = ibis.window(group_by=[*place, "run"], order_by=order, preceding=None, following=None)
    t = t.mutate(first=t.vehicle.first().over(spell))
    spells = t.group_by([*place, "run"]).aggregate(
        onset=t.time.min(),
        last=t.time.max(),
        end=t.following.max(),
        open=t.following.isnull().any(),
        values=t.count(),
        vehicles=t.vehicle.nunique(),
        mu=t.mu.cast("float64").mean(),
        alert=ibis.ifelse(t.vehicle != t["first"], t.time, ibis.null("int64")).min(),
    )
    spells = spells.filter(spells.vehicles >= least_vehicles)
    end = ibis.ifelse(spells.open, ibis.null("int64"), spells.end)
    return spells.select(
        *place,
        "onset",
        "last",
        "values",
        "vehicles",
        "mu",
        end=end,
        lasts=spells.open,
        duration_s=ibis.ifelse(spells.open, spells["last"], spells.end) - spells.onset,
        to_alert_s=spells.alert - spells.onset,
    )


def ask(engine: QueryEngine, options: Options) -> pa.Table:
    """Return a table with one row per slippery spell (time during which a cell was slippery) in the
    selected part of the archive. The docstring of `expression` explains the columns.
    """
    return engine.answer(expression(engine.observations(), options.least_vehicles))
