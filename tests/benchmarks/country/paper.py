"""Extrapolation from the simulated country to ten times as many vehicles: the country's measured
costs, multiplied by the expected numbers of observations and cells.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Final

from fleet_service.app.sizing import COSTS, remembered_pairs
from schemas.runtime.figures import Figure
from tests.benchmarks.country.replayed import ROWS

VEHICLES: Final = 1_000_000
# Ratio of this country's vehicles, messages and cells to those of the measured country.
FACTOR: Final = 10
USED: Final = 0.6  # largest used share of a core; the rest lets a service catch up after an outage
DAY_S: Final = 86_400.0


def estimate_million(found: Mapping[str, float]) -> list[Figure]:
    """Return estimated figures (memory, processor time) of a service for a million vehicles, each
    of which reports as often as a vehicle of the simulated country.

    Args:
        found: figures that were measured in the simulated country, by name.
    """
    rate = FACTOR * found["country.rate"]
    cells = FACTOR * found["country.cells"]
    cores = rate * found["country.service_us"] * 1e-6
    pairs = remembered_pairs(rate, COSTS.values)
    per_day = rate * DAY_S * found["country.archive_bytes"] / 1e9
    return [
        Figure("country.million.per_s", rate, f"observations/s of {VEHICLES} vehicles"),
        Figure("country.million.cores", cores, "cores of all services"),
        Figure(
            "country.million.services",
            math.ceil(cores / USED),
            f"services, {USED:.0%} of a core each",
        ),
        Figure(
            "country.million.router_cores",
            rate / ROWS * found["country.router_us"] * 1e-6,
            "cores of routers",
        ),
        Figure("country.million.cells", cells, "pairs of cell and sector"),
        Figure(
            "country.million.cells_gb",
            cells * found["country.cell_bytes"] / 1e9,
            "GB of memory for cells and sectors",
        ),
        Figure(
            "country.million.vehicles_gb",
            VEHICLES * found["country.vehicle_bytes"] / 1e9,
            "GB of memory for vehicles",
        ),
        Figure(
            "country.million.pairs_gb",
            pairs * found["country.pair_bytes"] / 1e9,
            "GB of memory for recent visits of each vehicle",
        ),
        Figure("country.million.gb_per_day", per_day, "GB of archive per day"),
    ]
