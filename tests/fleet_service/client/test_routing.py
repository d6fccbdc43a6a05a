"""Tests that an empty answer for route planners states its reason."""

from __future__ import annotations

import numpy as np
import pyarrow as pa

from fleet_service.client import routing
from schemas import grid


def make_table(mu_lower: list[float]) -> pa.Table:
    """Return measured cells of the map in a row, with these lower bounds of friction."""
    cells = grid.cell_of(np.full(len(mu_lower), 57.7), 11.97 + 0.001 * np.arange(len(mu_lower)))
    sides = zip(("west", "south", "east", "north"), grid.bounds(cells), strict=True)
    return pa.table(
        {
            "cell": cells,
            "sector": np.zeros(len(mu_lower), np.int8),
            "basis": pa.array(["measured"] * len(mu_lower), pa.string()),
            "mu_lower": np.array(mu_lower),
            **dict(sides),
        }
    )


def test_reason_of_no_stretch_is_that_of_the_map() -> None:
    assert "the map has no cells there" in routing.explain_no_line(make_table([]), "city.gpkg")
    good = routing.explain_no_line(make_table([0.8, 0.7]), "city.gpkg")
    assert good == "no cell of 2 is known to have low grip, so nothing is avoided"
    elsewhere = routing.explain_no_line(make_table([0.1, 0.7]), "city.gpkg")
    assert elsewhere.startswith("1 cells have low grip, but none is on a road of city.gpkg;")
    assert elsewhere.endswith("covers 11.970,57.700,11.971,57.700 (longitude first)")
