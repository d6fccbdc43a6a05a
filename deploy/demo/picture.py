"""The map beside the truth as a picture (PNG): each heading sector of a cell is a quarter of its square."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from matplotlib.figure import Figure

from deploy.demo.compare import MapComparison
from fleet_service.analytics.plots import MU, cell_shapes, paint
from schemas.runtime.palette import SURFACES, UNKNOWN


def draw(comparison: MapComparison, path: Path) -> None:
    """Three panels: the truth, the map (median), and how wide the map's interval is."""
    cells = comparison.cells
    shapes = cell_shapes(cells["cell"].to_numpy(), cells["sector"].to_numpy().astype(np.int64))
    lower, upper = (cells[name].to_numpy() for name in ("mu_lower", "mu_upper"))
    figure = Figure(figsize=(17, 5.4), layout="constrained")
    truth, found, width = figure.subplots(1, 3, sharex=True, sharey=True)
    paint(truth, shapes, comparison.truth)
    colours = paint(found, shapes, comparison.values)
    wide = paint(width, shapes, upper - lower, (0.0, 1.1))
    truth.set_title("truth")
    found.set_title(f"map: median (hatched: {UNKNOWN})")
    width.set_title("map: width of the 90 % interval")
    bar = figure.colorbar(colours, ax=found, label=f"{MU}, the darker the more slippery", shrink=0.8)
    bar.set_ticks(list(SURFACES.values()), labels=[f"{mu:g} {name}" for name, mu in SURFACES.items()])
    figure.colorbar(wide, ax=width, label="width [1]", shrink=0.8)
    figure.suptitle(
        f"{cells.num_rows} cells and directions; truth inside the interval in {comparison.covered.mean():.0%}, "
        f"{comparison.several.sum()} of them seen by two or more vehicles"
    )
    figure.savefig(path, dpi=130)
