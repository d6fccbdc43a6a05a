"""HTML file that shows the demo's map next to a map of the true friction. A browser can open it
offline. It shows the friction interval of each cell.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from deploy.demo.compare import MapComparison
from fleet_service.analytics.page import GRIP_SCALE, DrawnCells, render_page
from schemas import grid
from schemas.runtime.figures import Figure, format_row

NAMES = (
    "truth",
    "mu",
    "5 %",
    "95 %",
    "basis",
    "P(slippery)",
    "vehicles",
    "observations",
    "heading",
    "latitude",
    "longitude",
)


def write_page(comparison: MapComparison, figures: list[Figure], path: Path) -> None:
    """Write an HTML file with two maps (friction according to the fleet's map, and true friction)
    and a table of the demo's figures. The file loads nothing from the network.
    """
    cells = comparison.cells
    boxes = np.stack(
        [cells[side].to_numpy() for side in ("west", "south", "east", "north")], axis=1
    )
    sector: Any = cells["sector"].to_pylist()
    truth = comparison.truth.round(4).tolist()
    found = comparison.values.round(4).tolist()
    panels = {"truth": truth, "map": [mu if np.isfinite(mu) else None for mu in found]}
    lines = [_table_row(one, true) for one, true in zip(cells.to_pylist(), truth, strict=True)]
    drawn = DrawnCells(boxes.round(7).tolist(), sector, panels, NAMES, lines)
    several = int(comparison.has_several_vehicles.sum())
    about = (
        f"{cells.num_rows} cells and directions with a known true friction; {several} of them were "
        "visited by two or more vehicles, and the figures below cover only these."
    )
    table = [["figure", "value", "bar", ""], *(format_row(figure) for figure in figures)]
    path.write_text(
        render_page(
            "GripMap: the map next to the truth", drawn, GRIP_SCALE, about=about, table=table
        )
    )


def _table_row(cell: dict[str, Any], truth: float) -> list[str]:
    mu = "not measured" if cell["mu"] is None else f"{cell['mu']:.2f}"
    return [
        f"{truth:.2f}",
        mu,
        f"{cell['mu_lower']:.2f}",
        f"{cell['mu_upper']:.2f}",
        cell["basis"],
        f"{cell['p_slippery']:.2f}",
        str(cell["vehicles"]),
        str(cell["observations"]),
        grid.HEADINGS[cell["sector"]],
        f"{cell['latitude']:.5f}",
        f"{cell['longitude']:.5f}",
    ]
