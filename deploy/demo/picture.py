"""Image (PNG) of the demo's map next to a map of the true friction. The square of each cell is
divided into four parts, one per heading sector (quarter of the compass in which a vehicle drives).
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from deploy.demo.compare import LostGrip, MapComparison
from fleet_service.analytics.plots import MU, cell_shapes, paint_cells
from schemas.numeric import IntArray
from schemas.runtime.palette import SURFACES, UNKNOWN


def draw_maps(comparison: MapComparison, path: Path, grip: LostGrip | None = None) -> None:
    """Draw an image with three panels: the true friction, the map's median friction, and the width
    of the map's friction interval.

    The first panel also shows where warned and unwarned drivers lost or kept their grip on the new
    ice.
    """
    cells = comparison.cells
    shapes = cell_shapes(cells["cell"].to_numpy(), cells["sector"].to_numpy().astype(np.int64))
    lower = cells["mu_lower"].to_numpy()
    upper = cells["mu_upper"].to_numpy()
    figure = Figure(figsize=(17, 5.4), layout="constrained")
    truth, found, width = figure.subplots(1, 3, sharex=True, sharey=True)
    paint_cells(truth, shapes, comparison.truth)
    colours = paint_cells(found, shapes, comparison.values)
    wide = paint_cells(width, shapes, upper - lower, (0.0, 1.1))
    truth.set_title("truth")
    if grip is not None and len(grip.cell):
        _mark_passes(truth, grip, cells["cell"].to_numpy())
    found.set_title(f"map: median\n(hatched: {UNKNOWN})", fontsize="medium")
    width.set_title("map: width of the 90 % interval")
    bar = figure.colorbar(
        colours, ax=found, label=f"{MU}, the darker the more slippery", shrink=0.8
    )
    bar.set_ticks(
        list(SURFACES.values()), labels=[f"{mu:g} {name}" for name, mu in SURFACES.items()]
    )
    figure.colorbar(wide, ax=width, label="width [1]", shrink=0.8)
    figure.suptitle(
        f"{cells.num_rows} cells and directions; truth inside the interval in "
        f"{comparison.is_covered.mean():.0%}, {comparison.has_several_vehicles.sum()} of them "
        "visited by two or more vehicles"
    )
    figure.savefig(path, dpi=130)


def _mark_passes(axes: Axes, grip: LostGrip, drawn: IntArray) -> None:
    """Draw a mark for each pass of a car over the new ice. The mark is a circle if the driver was
    warned, else a square. It is black if a wheel lost grip, else white.
    """
    # Shapes of the passes, in the coordinates of the picture.
    shapes = cell_shapes(np.concatenate([drawn, grip.cell]))[len(drawn) :]
    x, y = shapes.mean(axis=1).T
    side = np.ptp(shapes[0, :, 0])
    for warned, name, mark, x_offset in (
        (True, "warned", "o", -0.25),
        (False, "not warned", "s", 0.25),
    ):
        for lost, word, fill in ((True, "lost grip", "black"), (False, "kept it", "white")):
            rows = (grip.warned == warned) & (grip.lost == lost)
            label = f"{name}, {word}: {int(rows.sum())}"
            where = x[rows] + x_offset * side, y[rows]
            axes.scatter(*where, marker=mark, s=30, facecolor=fill, edgecolor="black", label=label)
    axes.legend(loc="lower right", fontsize=7)
