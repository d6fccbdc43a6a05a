"""The map beside the truth as a picture (PNG): each heading sector of a cell is a quarter of its square."""

from __future__ import annotations

from pathlib import Path

import matplotlib as mpl
import numpy as np
from matplotlib.axes import Axes
from matplotlib.collections import PolyCollection
from matplotlib.figure import Figure

from deploy.demo.compare import MapComparison
from schemas.numeric import FloatArray
from schemas.thresholds import METRES_PER_DEGREE

COLOURS = "RdYlGn"  # red is slippery, green is dry
SURFACES = {0.18: "ice", 0.35: "snow", 0.60: "wet", 0.90: "dry"}


def quarters(comparison: MapComparison) -> FloatArray:
    """The triangle of each row's heading sector in its cell, (n, 3, 2) [m from the south-west corner of all]."""
    west, south, east, north = (
        comparison.cells[side].to_numpy() for side in ("west", "south", "east", "north")
    )  # fmt: skip
    scale = METRES_PER_DEGREE * np.cos(np.radians(south.mean()))
    x0, x1 = (west - west.min()) * scale, (east - west.min()) * scale
    y0, y1 = (south - south.min()) * METRES_PER_DEGREE, (north - south.min()) * METRES_PER_DEGREE
    corners = np.stack(
        [np.stack([x0, y0], -1), np.stack([x1, y0], -1), np.stack([x1, y1], -1), np.stack([x0, y1], -1)], 1
    )
    middle = corners.mean(axis=1)
    sector = comparison.cells["sector"].to_numpy()
    first, second = np.array([1, 2, 3, 0])[sector], np.array([2, 3, 0, 1])[sector]  # east, north, west, south
    row = np.arange(len(sector))
    return np.stack([middle, corners[row, first], corners[row, second]], axis=1)


def draw(comparison: MapComparison, path: Path) -> None:
    """Three panels: the truth, the map (median), and how wide the map's interval is."""
    shapes = quarters(comparison)
    lower, mu, upper = (comparison.cells[name].to_numpy() for name in ("mu_lower", "mu", "mu_upper"))
    figure = Figure(figsize=(17, 5.4), layout="constrained")
    panels = figure.subplots(1, 3, sharex=True, sharey=True)
    bound = ~comparison.measured
    _panel(panels[0], shapes, comparison.truth, "truth", COLOURS, (0.1, 1.0))
    _panel(panels[1], shapes, np.where(bound, np.nan, mu), "map: median (grey: lower bounds only)", COLOURS, (0.1, 1.0))
    _panel(panels[2], shapes, upper - lower, "map: width of the 90 % interval", "viridis_r", (0.0, 1.1))
    for index, label in ((1, "peak adhesion μ"), (2, "width")):
        figure.colorbar(panels[index].collections[0], ax=panels[index], label=label, shrink=0.8)
    figure.suptitle(
        f"{len(mu)} cells and directions; truth inside the interval in {comparison.covered.mean():.0%}, "
        f"{comparison.several.mean():.0%} seen by two or more vehicles"
    )
    figure.savefig(path, dpi=130)


def _panel(
    axes: Axes, shapes: FloatArray, values: FloatArray, title: str, colours: str, limits: tuple[float, float]
) -> None:
    shade = mpl.colormaps[colours].with_extremes(bad="0.8")
    patches = PolyCollection(list(shapes), array=np.ma.masked_invalid(values), cmap=shade, edgecolors="none")
    patches.set_clim(*limits)
    axes.add_collection(patches)
    axes.autoscale()
    axes.set_aspect("equal")
    axes.set(title=title, xlabel="east [m]", ylabel="north [m]")
