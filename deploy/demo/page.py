"""The map beside the truth as one HTML file that opens offline: point at a cell and read its interval."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np

from deploy.demo.compare import MapComparison
from deploy.demo.picture import quarters

TEMPLATE = Path(__file__).with_name("page.html")
COLUMNS = ("mu", "mu_lower", "mu_upper", "p_slippery", "basis", "vehicles", "observations", "latitude", "longitude")


def write(comparison: MapComparison, table: str, path: Path) -> None:
    """Fill the template with the cells and the figures table (text); nothing is loaded from elsewhere."""
    rows = comparison.cells.select(COLUMNS).to_pylist()
    for row, truth, shape in zip(rows, comparison.truth, np.round(quarters(comparison), 2).tolist(), strict=True):
        row |= {"truth": float(truth), "shape": shape}
    data = json.dumps({"cells": rows, "table": table}).replace("<", "\\u003c")  # no value can end or open a tag
    path.write_text(TEMPLATE.read_text().replace("/*DATA*/null", data))
