"""`before-after`: change of friction at a given time, in the same cells, with an interval that
accounts for biased vehicles.

Legend
    y         a value of mu in cell c, period p (before, after), by vehicle v
    n_b, n_a  number of values of a cell before and after the given time
    w         weight of a cell, n_b·n_a / (n_b + n_a), zero where a period has no value
    D         difference Σ w·(mean after - mean before) / Σ w
    u_v       influence of a vehicle on D, a difference of two sums over the vehicle's values:
              Σ after the given time, w/(n_a·Σw)·(y - mean after)
              minus Σ before the given time, w/(n_b·Σw)·(y - mean before)
    sd        standard deviation of D, sqrt(V/(V-1)·Σ u_v²) for V vehicles. All values of one
              vehicle count as one (cluster-robust variance, Liang and Zeger 1986).
"""

from __future__ import annotations

from typing import Any

import ibis
import numpy as np
import pyarrow as pa

from fleet_service.analytics.engines import QueryEngine, Table, has_value
from fleet_service.analytics.options import Options
from schemas.errors import InputError
from schemas.thresholds import NS, Z_95


def expression(t: Table, at_s: int) -> Table:
    """Return a table with one row, from which the difference D and its standard deviation are
    computed. Only cells with values in both periods are used. The symbols are those of the module.

    Columns of the row
        cells, vehicles, values   numbers of cells, vehicles and values that are used
        w                         Σ w over the cells
        before, later             Σ w·mean before and Σ w·mean after, over the cells
        squares                   Σ (u_v·Σw)² over the vehicles

    `at_s` is the time that separates the periods, in seconds since 1970.
    """
    t = t.filter(has_value(t))
    t = t.select("cell", "sector", "vehicle", after=t.time >= at_s, y=t.mu.cast("float64"))
    place = ["cell", "sector"]
    cells = t.group_by(place).aggregate(
        n_a=t.after.sum(),
        n_b=(~t.after).sum(),
        s_a=ibis.ifelse(t.after, t.y, 0.0).sum(),
        s_b=ibis.ifelse(t.after, 0.0, t.y).sum(),
    )
    cells = cells.filter(cells.n_a > 0, cells.n_b > 0)
    weight = cells.n_a * cells.n_b / (cells.n_a + cells.n_b)
    cells = cells.mutate(
        w=weight.cast("float64"), mean_a=cells.s_a / cells.n_a, mean_b=cells.s_b / cells.n_b
    )
    t = t.inner_join(cells, place)
    residual = ibis.ifelse(t.after, (t.y - t.mean_a) / t.n_a, (t.mean_b - t.y) / t.n_b)
    t = t.mutate(u=t.w * residual)
    by_vehicle = t.group_by("vehicle").aggregate(u=t.u.sum(), n=t.count())
    spread = by_vehicle.aggregate(
        vehicles=by_vehicle.count(), values=by_vehicle.n.sum(), squares=(by_vehicle.u**2).sum()
    )
    total = cells.aggregate(
        cells=cells.count(),
        w=cells.w.sum(),
        before=(cells.w * cells.mean_b).sum(),
        later=(cells.w * cells.mean_a).sum(),
    )
    return total.cross_join(spread)


def find_difference(row: dict[str, Any]) -> dict[str, float]:
    """Return the change of the mean friction (`difference`) with its 90 % interval (`lower`,
    `upper`), and the number of cells (`cells`), computed from the row that `expression` defines.
    Return an empty dictionary if fewer than two vehicles measured the cells that have values in
    both periods.
    """
    if not row["cells"] or row["vehicles"] < 2:
        return {}
    difference = (row["later"] - row["before"]) / row["w"]
    std = float(np.sqrt(row["squares"] * row["vehicles"] / (row["vehicles"] - 1))) / row["w"]
    return {
        "difference": difference,
        "lower": difference - Z_95 * std,
        "upper": difference + Z_95 * std,
        "cells": row["cells"],
    }


def ask(engine: QueryEngine, options: Options) -> pa.Table:
    """Return a table with two rows, before and after the given time: mean of mu; difference between
    the periods with its 90 % interval; numbers of cells, vehicles and values used.

    Raises:
        InputError: no time is given, or no cell was measured in both periods.
    """
    if options.at is None:
        raise InputError(
            "at", "the time of the treatment is missing", "give it, e.g. --at 2026-01-31T07:00:00Z"
        )
    (row,) = engine.answer(expression(engine.observations(), options.at // NS)).to_pylist()
    change = find_difference(row)
    if not change:
        raise InputError(
            "at", "in no cell did two vehicles measure in both periods", "choose longer periods"
        )
    return pa.table(
        {
            "period": ["before", "after"],
            "mu": [row["before"] / row["w"], row["later"] / row["w"]],
            "difference": [0.0, change["difference"]],
            "lower": [0.0, change["lower"]],
            "upper": [0.0, change["upper"]],
            "cells": [row["cells"]] * 2,
            "vehicles": [row["vehicles"]] * 2,
            "values": [row["values"]] * 2,
        }
    )
