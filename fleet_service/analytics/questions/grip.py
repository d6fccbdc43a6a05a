"""`grip`: percentiles of mu per cell and day. It also reports the daily coverage: the shares of
cells with values, with only lower bounds, and without visits (passages of cells).
"""

from __future__ import annotations

from typing import Final

import ibis
import numpy as np
import pyarrow as pa

from fleet_service.analytics.engines import QueryEngine, Table, has_value
from fleet_service.analytics.options import Options

PERCENTILES: Final = {"mu_p10": 0.1, "mu_p50": 0.5, "mu_p90": 0.9}


def expression(t: Table) -> Table:
    """Return a table with one row per day, map cell and heading sector. A row without a value of mu
    has no percentiles. Then it is only known that mu is at least `utilised_max`, the largest
    friction coefficient that a vehicle used.
    """
    reported = ibis.ifelse(has_value(t), t.mu.cast("float64"), ibis.null("float64"))
    t = t.select(
        "day",
        "cell",
        "sector",
        "vehicle",
        reported=reported,
        used=t.mu_utilised.nullif(float("nan")),
    )
    found = t.group_by(["day", "cell", "sector"]).aggregate(
        observations=t.count(),
        values=t.reported.count(),
        vehicles=t.vehicle.nunique(),
        utilised_max=t.used.max(),
        # One query for all percentiles is a third faster than one query for each.
        all=t.reported.quantile(list(PERCENTILES.values())),
    )
    return found.mutate(**{name: found["all"][k] for k, name in enumerate(PERCENTILES)}).drop("all")


def ask(engine: QueryEngine, options: Options) -> pa.Table:
    """Return a table of percentiles of mu per day, map cell and heading sector. The docstring of
    `expression` explains the columns. Also report the daily coverage of the network, which is the
    set of all cells and heading sectors visited in the selected time.
    """
    found = engine.answer(expression(engine.observations()))
    for line in coverage_lines(found):
        options.report(line)
    return found


def coverage_lines(found: pa.Table) -> list[str]:
    """Return one line of text per day about the coverage of the road network on this day. The
    network is the set of all cells and heading sectors that `found` contains on any day.

    Each line states three shares of the network:
    measured       vehicles reported a value of the friction
    only bounded   vehicles reported only lower bounds of the friction
    not visited    no vehicle drove there
    """
    key = found["cell"].to_numpy() * 4 + found["sector"].to_numpy()
    network = len(np.unique(key))
    days = found["day"].cast(pa.date32()).cast(pa.int32()).to_numpy()
    known = found["values"].to_numpy() > 0
    lines = []
    for day in np.unique(days):
        here = days == day
        reported = int((here & known).sum())
        visited = int(here.sum())
        shares = (reported / network, (visited - reported) / network, 1.0 - visited / network)
        lines.append(
            "{}: {:.0%} of {} cells measured, {:.0%} only bounded, {:.0%} not visited".format(
                np.datetime64(int(day), "D"), shares[0], network, *shares[1:]
            )
        )
    return lines
