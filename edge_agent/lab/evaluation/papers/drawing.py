"""Drawing of the plots of a reproduction with matplotlib, as PNG and SVG files."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

from edge_agent.lab.evaluation.papers.outcome import Curve, Heat, PaperPlot, PlotPanel
from schemas.runtime.palette import ESTIMATORS, TRUTH

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

FORMATS: Final = ("png", "svg")
DPI: Final = 110
PANEL_INCHES: Final = (5.2, 2.5)
WIDE_INCHES: Final = 9.0  # width of a figure with one column
KINDS: Final = {
    "truth": {"color": TRUTH.colour, "linestyle": "-", "lw": 1.8},
    "improved": {"color": "#0072b2", "linestyle": "-", "lw": 1.1},
    "comparator": {"color": "#d55e00", "linestyle": "--", "lw": 1.0},
}
# different line styles, so that coinciding curves remain visible
DASHES: Final = ("-", "--", "-.", ":")
OTHERS: Final = [style.colour for style in ESTIMATORS.values() if style.colour != "#f0e442"]


def draw_plot(plot: PaperPlot) -> Figure:
    """Return a plot of a reproduction as a matplotlib figure."""
    from edge_agent.lab.evaluation.papers.notebook_figure import NotebookFigure

    rows = -(-len(plot.panels) // plot.columns)
    width = WIDE_INCHES if plot.columns == 1 else PANEL_INCHES[0] * plot.columns
    figure = NotebookFigure(figsize=(width, PANEL_INCHES[1] * rows + 0.4), layout="constrained")
    axes = figure.subplots(rows, plot.columns, squeeze=False)
    for axis, panel in zip(axes.flat, plot.panels, strict=False):
        if isinstance(panel, Heat):
            _draw_heat(figure, axis, panel)
        else:
            _draw_panel(axis, panel)
    for axis in list(axes.flat)[len(plot.panels) :]:
        axis.set_axis_off()
    figure.suptitle(plot.title, fontsize="medium")
    return figure


def write_plots(plots: Sequence[PaperPlot], folder: Path) -> list[Path]:
    """Write every plot as a PNG and an SVG file into the folder; return the paths of the files."""
    import matplotlib as mpl

    written = []
    with mpl.rc_context({"svg.hashsalt": "gripmap", "svg.fonttype": "none"}):
        for plot in plots:
            figure = draw_plot(plot)
            for kind in FORMATS:
                path = folder / f"{plot.name}.{kind}"
                metadata: dict[str, Any] = {"Date": None} if kind == "svg" else {}
                figure.savefig(path, dpi=DPI, metadata=metadata)
                written.append(path)
    return written


def _style(curve: Curve, place: int) -> dict[str, Any]:
    if curve.kind in KINDS:
        return KINDS[curve.kind]
    dashes = DASHES[place % len(DASHES)]
    return {"color": OTHERS[place % len(OTHERS)], "linestyle": dashes, "lw": 1.2}


def _draw_panel(axis: Axes, panel: PlotPanel) -> None:
    for place, curve in enumerate(panel.curves):
        marker = "o" if len(curve.x) < 20 else ""
        axis.plot(
            curve.x, curve.y, **_style(curve, place), marker=marker, ms=3, label=curve.name or None
        )
    axis.set(xlabel=panel.x, ylabel=panel.y)
    axis.set_title(panel.title, fontsize="small")
    axis.grid(alpha=0.25)
    if panel.limits is not None:
        axis.set_ylim(*panel.limits)
    if panel.log:
        axis.set_yscale("log")
    if any(curve.name for curve in panel.curves):
        axis.legend(fontsize="x-small", ncols=2)


def _draw_heat(figure: Figure, axis: Axes, heat: Heat) -> None:
    image = axis.imshow(
        heat.values, aspect="auto", cmap="viridis", origin="lower", interpolation="nearest"
    )
    axis.set(xlabel=heat.x, ylabel=heat.y)
    axis.set_title(heat.title, fontsize="small")
    axis.set_yticks(range(len(heat.ticks)), heat.ticks, fontsize="xx-small")
    figure.colorbar(image, ax=axis, label=heat.label)
