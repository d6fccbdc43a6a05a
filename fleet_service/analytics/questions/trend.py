"""`trend`: friction month by month, and the difference to the previous month in the same cells.

Different cells are measured in different months, so the percentiles of months cannot be compared
directly. The difference uses only cells with values in both months. Its interval is computed as in
the question `before-after`.
"""

from __future__ import annotations

from datetime import UTC, date, datetime
from typing import Any, Final

import pyarrow as pa

from fleet_service.analytics.engines import QueryEngine, Table, has_value
from fleet_service.analytics.options import Options
from fleet_service.analytics.questions import before_after
from schemas.thresholds import SLIPPERY_MU

TYPES: Final[dict[str, pa.DataType]] = {
    "month": pa.date32(),
    "values": pa.int64(),
    "vehicles": pa.int64(),
    "mu_p50": pa.float64(),
    "share_slippery": pa.float64(),
    "difference": pa.float64(),
    "lower": pa.float64(),
    "upper": pa.float64(),
    "cells": pa.int64(),
}


def expression(t: Table) -> Table:
    """Return a table with one row per month that has values of mu: number of values, number of
    vehicles, median of mu, and share of slippery values.
    """
    t = t.filter(has_value(t)).select(
        "cell", "sector", "vehicle", month=t.day.truncate("M"), y=t.mu.cast("float64")
    )
    return t.group_by("month").aggregate(
        values=t.count(),
        vehicles=t.vehicle.nunique(),
        mu_p50=t.y.quantile(0.5),
        share_slippery=(t.y < SLIPPERY_MU).mean(),
    )


def ask(engine: QueryEngine, options: Options) -> pa.Table:  # noqa: ARG001 as for all questions
    """Return a table with one row per month: its friction, and the difference from the previous
    month. The difference is null if no cell has values of two vehicles in both months.
    """
    t = engine.observations()
    months = sorted(engine.answer(expression(t)).to_pylist(), key=lambda row: row["month"])
    empty = dict.fromkeys(("difference", "lower", "upper", "cells"))
    found: list[dict[str, Any]] = [{**row, **empty} for row in months]
    for row, earlier in zip(found[1:], found, strict=False):
        month = t.day.truncate("M")
        both = t.filter((month == _as_date(row["month"])) | (month == _as_date(earlier["month"])))
        begin = datetime.combine(_as_date(row["month"]), datetime.min.time(), UTC)
        compared = before_after.expression(both, int(begin.timestamp()))
        row.update(before_after.find_difference(engine.answer(compared).to_pylist()[0]))
    return pa.Table.from_pylist(
        [{**row, "month": _as_date(row["month"])} for row in found], schema=pa.schema(TYPES)
    )


def _as_date(month: date) -> date:
    """Convert a month's first day to a date, because one query engine returns a date, the other a
    date with time.
    """
    return month.date() if isinstance(month, datetime) else month
