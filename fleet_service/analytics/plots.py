"""Plots of the answers, one kind of plot per question: PNG for the screen, SVG and PDF for
print.
"""

from __future__ import annotations

from collections.abc import Callable
from datetime import UTC
from pathlib import Path
from typing import Any, Final

import numpy as np
import pyarrow as pa
from matplotlib.axes import Axes
from matplotlib.collections import PolyCollection
from matplotlib.colors import LinearSegmentedColormap, Normalize
from matplotlib.figure import Figure

from schemas import grid
from schemas.numeric import FloatArray, IntArray
from schemas.runtime.palette import GRIP, GRIP_RANGE, HATCH, UNKNOWN
from schemas.thresholds import METRES_PER_DEGREE, SLIPPERY_MU, Z_95

GRIP_MAP: Final = LinearSegmentedColormap.from_list("grip", GRIP)
MU: Final = "peak adhesion μ [1]"
MOST_ROWS: Final = 40  # rows (spells or vehicles) for which a plot is still readable
MOST_PANELS: Final = 6
# [points] Width of the line around each cell: a road of 10 m is still visible on a map of 10 km.
EDGE: Final = 1.2
DAY_S: Final = 86_400.0  # matplotlib counts days since 1970
PUBLISHED: Final = 0.9  # nominal probability of a published interval
ARROWS: Final = "→↑←↓"  # one arrow per heading
_DARK = GRIP[2]
_LIGHT = GRIP[8]
_MARK = "#d0006f"


def draw_answer(table: pa.Table, name: str, about: str, path: Path) -> None:
    """Draw the answer to a question as a plot, and write it in the format of the path's ending
    (png, svg, pdf). The plot's title consists of `name` and `about`, the question's name and
    description.
    """
    figure = Figure(figsize=(8.0, 4.8), layout="constrained")
    if table.num_rows:
        _DRAWN.get(name, _first_two)(figure, table)
    else:
        figure.text(0.5, 0.5, "the answer has no rows", ha="center")
    figure.suptitle(f"{name}: {about}", fontsize=11)
    figure.savefig(path, dpi=150)


def cell_shapes(cell: IntArray, sector: IntArray | None = None) -> FloatArray:
    """Return the corners of map cells [m], with the south-west corner of all cells as the origin.
    Without `sector`, the shapes are squares, (n, 4, 2). With `sector`, they are triangles, (n, 3,
    2): the quarter of the cell that belongs to this heading sector.
    """
    west, south, *_ = grid.bounds(cell)
    scale = METRES_PER_DEGREE * np.cos(np.radians(south.mean())) if len(cell) else 1.0
    x, y = grid.outline(cell, sector)
    return np.stack(
        [(x - west.min(initial=180.0)) * scale, (y - south.min(initial=90.0)) * METRES_PER_DEGREE],
        axis=-1,
    )


def paint_cells(
    axes: Axes, shapes: FloatArray, values: FloatArray, limits: tuple[float, float] = GRIP_RANGE
) -> PolyCollection:
    """Draw shapes of map cells in colours that show their friction. Shapes without a value are
    hatched and have no colour.
    """
    known = np.isfinite(values)
    if not known.all():
        axes.add_collection(
            PolyCollection(
                list(shapes[~known]),
                facecolors="white",
                edgecolors="0.55",
                hatch=HATCH,
                linewidths=0.2,
                label=UNKNOWN,
            )
        )
    patches = PolyCollection(
        list(shapes[known]), array=values[known], cmap=GRIP_MAP, norm=Normalize(*limits)
    )
    patches.set(edgecolor="face", linewidth=EDGE)
    axes.add_collection(patches)
    axes.autoscale()
    axes.set_aspect("equal")
    axes.set(xlabel="east [m]", ylabel="north [m]")
    return patches


def _draw_grip(figure: Figure, table: pa.Table) -> None:
    days = np.array([str(day) for day in table["day"].to_pylist()])
    middle = _float_column(table, "mu_p50")
    axes = figure.subplots()
    names = np.unique(days)
    for k, day in enumerate(names):
        own = middle[(days == day) & np.isfinite(middle)]
        bounded = int(((days == day) & ~np.isfinite(middle)).sum())
        if len(own):
            _draw_band(
                axes,
                k,
                np.quantile(own, (0.1, 0.5, 0.9)),
                "10 %, 50 % and 90 % quantiles of the cells" if not k else None,
            )
        axes.annotate(f"{len(own)} measured\n{bounded} bounded", (k, 0.02), ha="center", fontsize=8)
    axes.axhline(SLIPPERY_MU, color=_MARK, linewidth=1, label=f"slippery below {SLIPPERY_MU}")
    axes.set_xticks(range(len(names)), names, rotation=30 if len(names) > 5 else 0)
    axes.set(ylabel=f"median {MU} of a cell", ylim=(0.0, 1.2), xlim=(-0.6, len(names) - 0.4))
    axes.legend(fontsize=8)


def _draw_band(axes: Axes, at: float, three: FloatArray, label: str | None = None) -> None:
    low, middle, high = three
    axes.errorbar(
        [at],
        [middle],
        [[middle - low], [high - middle]],
        fmt="o",
        capsize=5,
        color=_DARK,
        label=label,
    )


def _draw_worst(figure: Figure, table: pa.Table) -> None:
    rows: list[Any] = table.slice(0, MOST_PANELS).to_pylist()
    panels = _make_panels(figure, len(rows))
    for k, (axes, one) in enumerate(zip(panels, rows, strict=False), 1):
        cells = np.array(one["members"], np.int64)
        # Paint whole squares, because all cells of a stretch have the same heading.
        patches = paint_cells(axes, cell_shapes(cells), np.full(len(cells), one["mu"]))
        axes.set_title(
            f"{k}: {one['length_m']:.0f} m heading {grid.HEADINGS[one['sector']]} "
            f"{ARROWS[one['sector']]}\n"
            f"{one['share_slippery']:.0%} slippery (≥ {one['share_lower']:.0%})\n{one['values']} "
            "values",
            fontsize=9,
        )
        axes.margins(0.1)
    figure.colorbar(patches, ax=panels, label=f"mean {MU} where slippery", shrink=0.8)


def _make_panels(figure: Figure, count: int) -> list[Axes]:
    """Return `count` axes (panels for plots) of a matplotlib figure, three per row."""
    columns = min(count, 3) or 1
    rows = -(-count // 3) or 1
    if count > 1:
        figure.set_size_inches(4.2 * columns, 3.8 * rows)
    panels: list[Axes] = (
        np.atleast_1d(figure.subplots(rows, columns, squeeze=False)).ravel().tolist()
    )
    for axes in panels[count:]:
        axes.set_visible(False)
    return panels


def _draw_spells(figure: Figure, table: pa.Table) -> None:
    order = np.argsort(-_float_column(table, "duration_s"), kind="stable")[:MOST_ROWS]
    rows = sorted(table.take(order).to_pylist(), key=lambda one: one["onset"])
    axes = figure.subplots()
    for k, one in enumerate(rows):
        begin, end = ((one["onset"] + extra) / DAY_S for extra in (0.0, one["duration_s"]))
        axes.plot(
            [begin, end],
            [k, k],
            color=_MARK if one["lasts"] else _DARK,
            linewidth=3,
            solid_capstyle="butt",
        )
        if one["lasts"]:
            axes.plot([end], [k], marker=">", color=_MARK)
    axes.xaxis_date(UTC)
    axes.plot([], [], color=_DARK, linewidth=3, label="ended")
    axes.plot([], [], color=_MARK, marker=">", linewidth=3, label="lasts at the end of the data")
    axes.set(
        xlabel="time, UTC",
        ylabel="spell, by its onset",
        title=f"the {len(rows)} longest of {table.num_rows}",
    )
    axes.tick_params(axis="x", labelrotation=25)
    axes.legend(fontsize=8)


def _before_after(figure: Figure, table: pa.Table) -> None:
    rows = {row["period"]: row for row in table.to_pylist()}
    before = rows["before"]
    after = rows["after"]
    left, right = figure.subplots(1, 2, width_ratios=[2, 1])
    left.plot(
        [0, 1], [before["mu"], after["mu"]], "o-", color=_DARK, label="mean of the same cells"
    )
    left.set_xticks([0, 1], ["before", "after"])
    left.set(ylabel=MU, ylim=(0.0, 1.2), xlim=(-0.5, 1.5))
    _draw_band(
        right,
        0,
        np.array([after[name] for name in ("lower", "difference", "upper")]),
        "difference, 90 % interval",
    )
    right.axhline(0.0, color=_MARK, linewidth=1, label="no change")
    right.set_xticks([0], ["after - before"])
    right.set(ylabel="change of μ [1]")
    left.set_title(
        f"{after['cells']} cells, {after['vehicles']} vehicles, {after['values']} values",
        fontsize=10,
    )
    right.set_title(
        f"{after['difference']:+.3f} [{after['lower']:+.3f}, {after['upper']:+.3f}]", fontsize=10
    )
    for axes in (left, right):
        axes.legend(fontsize=8)


def _draw_vehicles(figure: Figure, table: pa.Table) -> None:
    z = _float_column(table, "z")
    order = np.argsort(-np.nan_to_num(z, nan=-1.0), kind="stable")[:MOST_ROWS]
    rows = [row for row in table.take(order).to_pylist() if row["bias"] is not None]
    axes = figure.subplots()
    bias = np.array([row["bias"] for row in rows])
    spread = np.array([Z_95 * (row["bias_std"] or 0.0) for row in rows])
    names = [str(row["vehicle"])[:8] for row in rows]
    _draw_ranges(axes, names, bias, bias - spread, bias + spread, "bias against others, 95 %")
    axes.axvline(0.0, color=_MARK, linewidth=1)
    axes.set(
        xlabel="bias of μ [1]",
        ylabel="vehicle",
        title=f"the {len(rows)} most certain of {table.num_rows}",
    )
    axes.legend(fontsize=8)


def _draw_ranges(
    axes: Axes, names: list[str], middle: FloatArray, low: FloatArray, high: FloatArray, label: str
) -> None:
    """Draw one horizontal interval with its middle per name, the first name on top."""
    at = np.arange(len(names))
    axes.errorbar(
        middle,
        at,
        xerr=np.maximum([middle - low, high - middle], 0.0),
        fmt="o",
        markersize=3,
        capsize=2,
        color=_DARK,
        label=label,
    )
    axes.set_yticks(at, names, fontsize=6)
    axes.invert_yaxis()


def _draw_change_rates(figure: Figure, table: pa.Table) -> None:
    axes = figure.subplots()
    rate, low, high, assumed = (
        _float_column(table, name)
        for name in ("rate_per_hour", "rate_lower", "rate_upper", "assumed_per_hour")
    )
    names = [f"{row['by']}: {row['class']}" for row in table.to_pylist()]
    _draw_ranges(axes, names, rate, low, high, "measured, 90 % interval over days")
    axes.plot(assumed, np.arange(len(names)), "|", color=_MARK, label="assumed by the fusion")
    axes.set(xlabel="rate at which roads become slippery or recover [1/h]", xlim=(0.0, None))
    axes.legend(fontsize=8)


def _draw_contract(figure: Figure, table: pa.Table) -> None:
    shown = table.slice(0, MOST_ROWS)
    axes = figure.subplots()
    mean = 24.0 * _float_column(shown, "breach_s") / DAY_S
    least = 24.0 * _float_column(shown, "least_s") / DAY_S
    most = 24.0 * _float_column(shown, "most_s") / DAY_S
    names = [
        f"{row['name'] or row['link']}, {row['direction']}: {row['verdict']}"
        for row in shown.to_pylist()
    ]
    _draw_ranges(axes, names, mean, least, most, "by the mean; from certainly to possibly")
    axes.set(
        xlabel="longest time below the agreed friction [h]",
        title=f"{shown.num_rows} of {table.num_rows} links",
    )
    axes.legend(fontsize=8)


def _draw_calibration(figure: Figure, table: pa.Table) -> None:
    axes = figure.subplots()
    basis = np.array(table["basis"].to_pylist(), str)
    for name, marker, colour in (
        ("measured", "o", _DARK),
        ("bound", "s", _LIGHT),
        ("borrowed", "^", _MARK),
    ):
        own = table.filter(pa.array(basis == name)).sort_by("age_h")
        if own.num_rows:
            for column, line in (("held", "-"), ("compatible", ":")):
                axes.plot(
                    _float_column(own, "age_h"),
                    _float_column(own, column),
                    line,
                    marker=marker,
                    color=colour,
                    label=f"{name}: {column}",
                )
    axes.axhline(PUBLISHED, color="0.4", linewidth=1, label=f"published: {PUBLISHED:.0%}")
    axes.set(
        xlabel="hours between map and value",
        ylabel="share of later values inside",
        ylim=(0.0, 1.05),
    )
    axes.legend(fontsize=8)


def _draw_weather(figure: Figure, table: pa.Table) -> None:
    table = table.sort_by("temperature")
    left, right = figure.subplots(1, 2)
    t = _float_column(table, "temperature")
    p10 = _float_column(table, "mu_p10")
    p50 = _float_column(table, "mu_p50")
    left.plot(t, p50, "o-", color=_DARK, label="median")
    left.plot(t, p10, "s:", color=_LIGHT, label="worst tenth")
    left.axvline(0.0, color="0.6", linewidth=1)
    left.set(xlabel="temperature of the nearest station [°C]", ylabel=MU, ylim=(0.0, 1.2))
    left.legend(fontsize=8)
    right.bar(t, _float_column(table, "share_slippery"), width=1.6, color=_DARK)
    right.set(
        xlabel="temperature [°C]", ylabel=f"share of values below {SLIPPERY_MU}", ylim=(0.0, 1.0)
    )


def _draw_replay(figure: Figure, table: pa.Table) -> None:
    frame = table["frame"].cast(pa.int64()).to_numpy()
    times = np.unique(frame)
    times = times[
        np.unique(np.linspace(0, len(times) - 1, min(len(times), MOST_PANELS)).astype(int))
    ]
    panels = _make_panels(figure, len(times))
    cell = table["cell"].to_numpy()
    west, south, *_ = grid.bounds(cell)
    middle = np.argsort(west)[len(west) // 2]
    # Another town would shrink this one to a dot, so show one degree around the middle cell.
    near = np.hypot(west - west[middle], south - south[middle]) < 1.0
    if not near.all():
        figure.text(0.01, 0.01, f"{np.sum(~near)} rows far away left out; choose with --bbox")
        table = table.filter(pa.array(near))
        frame = frame[near]
    shapes = cell_shapes(cell[near], table["sector"].to_numpy().astype(np.int64))
    for axes, time in zip(panels, times.tolist(), strict=False):
        patches = paint_cells(
            axes, shapes[frame == time], _float_column(table, "mu")[frame == time]
        )
        axes.set_title(f"{np.datetime64(time, 'us').astype('datetime64[s]')} UTC", fontsize=9)
    figure.colorbar(patches, ax=panels, label=f"{MU}; hatched: {UNKNOWN}", shrink=0.8)


def _first_two(figure: Figure, table: pa.Table) -> None:
    """Plot the first two numeric columns of an answer against each other. This is for questions
    that plug-ins (installed extensions) add, because they have no plot of their own.
    """
    numbers = [
        f.name for f in table.schema if pa.types.is_floating(f.type) or pa.types.is_integer(f.type)
    ][:2]
    axes = figure.subplots()
    axes.plot(*(_float_column(table, name) for name in numbers), "o", color=_DARK)
    axes.set(xlabel=numbers[0], ylabel=numbers[-1])


def _draw_trend(figure: Figure, table: pa.Table) -> None:
    months = [f"{month:%Y-%m}" for month in table["month"].to_pylist()]
    axes = figure.subplots()
    axes.plot(months, _float_column(table, "mu_p50"), "o-", color=_DARK, label="median of μ")
    share = _float_column(table, "share_slippery")
    axes.plot(months, share, "s--", color=_MARK, label="share of slippery values")
    axes.set(ylabel=MU, ylim=(0.0, 1.2))
    axes.legend(fontsize=8)


_DRAWN: Final[dict[str, Callable[[Figure, pa.Table], None]]] = {
    "grip": _draw_grip,
    "worst": _draw_worst,
    "spells": _draw_spells,
    "before-after": _before_after,
    "trend": _draw_trend,
    "vehicles": _draw_vehicles,
    "calibration": _draw_calibration,
    "change-rates": _draw_change_rates,
    "contract": _draw_contract,
    "weather": _draw_weather,
    "replay": _draw_replay,
}


def _float_column(table: pa.Table, name: str) -> FloatArray:
    values: list[Any] = table[name].to_pylist()
    return np.array([np.nan if value is None else float(value) for value in values])
