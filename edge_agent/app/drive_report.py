"""Report of a drive: the estimates of one or more estimators as an HTML page or an image.

Speed, sideslip, friction with its 90 % interval, grip in use, health and the track share one time
axis. The HTML page is one file that needs no network. With the pointer on a plot, it shows all
values at that time.
"""

from __future__ import annotations

import html
import json
import math
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

import numpy as np
import pyarrow as pa

from edge_agent.inputs.signal_log import SignalLog
from schemas.errors import InputError
from schemas.numeric import FloatArray
from schemas.runtime.durable import open_durably, write_durably
from schemas.runtime.installing import install_command
from schemas.runtime.palette import GRIP_RANGE, line_of, shade
from schemas.signals import Health, S
from schemas.thresholds import METRES_PER_DEGREE, SLIPPERY_MU, Z_95

PAGE = ".html"
IMAGES = (".png", ".svg", ".pdf")
ENDINGS: Final = (PAGE, *IMAGES)
# Largest number of points of a curve on the page. Longer curves are thinned, but the extremes of
# the interval remain.
MOST_POINTS: Final = 1500
HEIGHT = 150
LEFT = 56
_TEMPLATE: Final = Path(__file__).with_name("drive.html")
_DEGREES: Final = 180.0 / math.pi


@dataclass(frozen=True)
class Panel:
    """Plot of one quantity of the estimates over time.

    Attributes:
        name, unit: name of the quantity, and unit in which it is plotted.
        column: name of the column in the table of estimates that contains the quantity.
        scale: factor from the column's unit to the displayed unit.
        band: names of two columns (lower and upper end of the interval), or of one column (standard
            deviation); empty for a quantity without interval.
        fixed: smallest and largest value on the axis; None to fit the axis to the values.
    """

    name: str
    unit: str
    column: str
    scale: float = 1.0
    band: tuple[str, ...] = ()
    fixed: tuple[float, float] | None = None


PANELS: Final = (
    Panel("speed", "m/s", "vx", band=("vx_std",)),
    Panel("sideslip", "deg", "sideslip", _DEGREES, ("sideslip_std",)),
    Panel("yaw rate", "deg/s", "yaw_rate", _DEGREES, ("yaw_rate_std",)),
    Panel("friction μ, 90 % interval", "1", "mu", band=("mu_lower", "mu_upper"), fixed=(0.0, 1.25)),
    Panel("grip in use", "1", "mu_utilised", fixed=(0.0, 1.25)),
)


@dataclass(frozen=True)
class RecordedDrive:
    """Recorded drive: its signal log, the table of estimates of each estimator by name, and the
    headline `title` of the report.
    """

    log: SignalLog
    estimates: Mapping[str, pa.Table]
    title: str


def write_report(drive: RecordedDrive, path: Path) -> None:
    """Write the report of a drive in the format given by the path's suffix.

    Raises:
        InputError: the suffix is unknown, or a required package is missing.
    """
    if path.suffix == PAGE:
        write_durably(path, page_of(drive))
    elif path.suffix in IMAGES:
        with open_durably(path) as file:
            figure_of(drive).savefig(file, format=path.suffix[1:], dpi=120)
    else:
        raise InputError(
            "out", f"{path.name} has no known ending", f"use one of {', '.join(ENDINGS)}"
        )


def curve_of(
    table: pa.Table, panel: Panel
) -> tuple[FloatArray, FloatArray, FloatArray, FloatArray]:
    """Return the curve of one estimated quantity as four arrays (n,): times [s], values, lower and
    upper ends of the interval, in the plot's unit. Both ends are NaN for a quantity without
    interval.
    """
    t = table["t"].to_numpy().astype(np.float64)
    value = table[panel.column].to_numpy().astype(np.float64)
    if len(panel.band) == 2:
        low, high = (table[name].to_numpy().astype(np.float64) for name in panel.band)
    elif panel.band:
        spread = Z_95 * table[panel.band[0]].to_numpy().astype(np.float64)
        low = value - spread
        high = value + spread
    else:
        low = np.full_like(value, np.nan)
        high = np.full_like(value, np.nan)
    return t, value * panel.scale, low * panel.scale, high * panel.scale


def thin_parts(count: int) -> list[slice]:
    """Divide the `count` samples of a curve into consecutive slices, at most MOST_POINTS, and
    return the slices. The plot shows one point per slice.
    """
    step = max(1, math.ceil(count / MOST_POINTS))
    return [slice(k, min(k + step, count)) for k in range(0, count, step)]


def page_of(drive: RecordedDrive) -> str:
    """Return the report of a recorded drive as an HTML page."""
    plots = [_plot_of(drive, panel) for panel in PANELS]
    data: dict[str, Any] = {
        "title": drive.title,
        "plots": plots,
        "health": _health_spans(drive),
        "track": _track_of(drive),
        "height": HEIGHT,
        "left": LEFT,
        "slippery": SLIPPERY_MU,
        "estimators": [{"name": name, "colour": line_of(name).colour} for name in drive.estimates],
    }
    # Escape "<", so that no value can open or close an HTML tag.
    text = json.dumps(data, allow_nan=False).replace("<", "\\u003c")
    found = _TEMPLATE.read_text(encoding="utf-8")
    return found.replace("<!--TITLE-->", html.escape(drive.title)).replace("/*DATA*/null", text)


def _plot_of(drive: RecordedDrive, panel: Panel) -> dict[str, Any]:
    curves = []
    low_end = math.inf
    high_end = -math.inf
    for name, table in drive.estimates.items():
        t, value, low, high = curve_of(table, panel)
        parts = thin_parts(len(t))
        points = {
            "t": _plain_list(np.array([t[part].mean() for part in parts])),
            "value": _plain_list(np.array([_mean_known(value[part]) for part in parts])),
            "low": _plain_list(np.array([_least_known(low[part]) for part in parts])),
            "high": _plain_list(np.array([-_least_known(-high[part]) for part in parts])),
        }
        known = value[np.isfinite(value)]
        if len(known):
            low_end = min(low_end, float(known.min()))
            high_end = max(high_end, float(known.max()))
        curves.append({"estimator": name, "colour": line_of(name).colour, **points})
    margin = 0.08 * max(high_end - low_end, 1e-3)
    ends = panel.fixed or (low_end - margin, high_end + margin)
    if not all(map(math.isfinite, ends)):
        ends = (0.0, 1.0)
    return {"name": panel.name, "unit": panel.unit, "curves": curves, "ends": list(ends)}


def _health_spans(drive: RecordedDrive) -> list[dict[str, Any]]:
    """Return, for each health flag that the first estimator reported, a dictionary with the flag's
    name and the time spans [s].
    """
    table = next(iter(drive.estimates.values()))
    t = table["t"].to_numpy()
    flags = table["health"].to_numpy()
    found = []
    for flag in Health:
        on = (flags & flag.value) > 0 if flag.value else np.zeros(len(flags), np.bool_)
        edges = np.flatnonzero(np.diff(np.concatenate([[0], on.astype(np.int8), [0]])))
        spans = [[float(t[a]), float(t[min(b, len(t) - 1)])] for a, b in edges.reshape(-1, 2)]
        if spans:
            found.append({"name": str(flag.name).lower().replace("_", " "), "spans": spans[:400]})
    return found


def _track_of(drive: RecordedDrive) -> dict[str, Any] | None:
    """Return the track of a recorded drive: x and y [m from the mean position], time [s], and the
    colour of the first estimator's friction. The colour is None where the estimate is too
    uncertain.

    Return None if the log has fewer than two positions.
    """
    position = drive.log.signals[:, [S.LATITUDE, S.LONGITUDE]].reshape(-1, 2)
    known = np.flatnonzero(np.isfinite(position).all(axis=1))
    if len(known) < 2:
        return None
    rows = known[:: max(1, len(known) // MOST_POINTS)]
    latitude, longitude = position[rows].T
    eastward = np.unwrap(longitude, period=360.0)  # continuous over the 180° meridian
    x = (
        (eastward - eastward.mean())
        * math.cos(math.radians(float(latitude.mean())))
        * METRES_PER_DEGREE
    )
    y = (latitude - latitude.mean()) * METRES_PER_DEGREE
    table = next(iter(drive.estimates.values()))
    t = drive.log.t[rows]
    at = np.clip(np.searchsorted(table["t"].to_numpy(), t), 0, table.num_rows - 1)
    mu = table["mu"].to_numpy()[at]
    lower = table["mu_lower"].to_numpy()[at]
    upper = table["mu_upper"].to_numpy()[at]
    sure = (upper - lower < 0.5) | (upper < SLIPPERY_MU)
    colours = [
        shade(float(m), *GRIP_RANGE) if ok and m == m else None
        for m, ok in zip(mu, sure, strict=True)
    ]
    return {"x": _plain_list(x), "y": _plain_list(y), "t": _plain_list(t), "colour": colours}


def _plain_list(values: FloatArray) -> list[float | None]:
    return [round(float(v), 5) if math.isfinite(v) else None for v in values]


def _mean_known(values: FloatArray) -> float:
    known = values[np.isfinite(values)]
    return float(known.mean()) if len(known) else math.nan


def _least_known(values: FloatArray) -> float:
    known = values[np.isfinite(values)]
    return float(known.min()) if len(known) else math.nan


# return type: a figure of matplotlib, which is optional
def figure_of(drive: RecordedDrive) -> Any:  # noqa: ANN401
    """Return the report of a recorded drive as a figure of matplotlib.

    Raises:
        InputError: matplotlib is not installed.
    """
    try:
        from matplotlib.figure import Figure
    except ImportError as error:
        raise InputError(
            "out", "matplotlib is not installed", install_command("analytics")
        ) from error
    drawn = Figure(figsize=(11, 10), layout="constrained")
    grid = drawn.add_gridspec(len(PANELS), 3)
    first = None
    for row, panel in enumerate(PANELS):
        axes = drawn.add_subplot(grid[row, :2], sharex=first)
        first = first or axes
        for name, table in drive.estimates.items():
            t, value, low, high = curve_of(table, panel)
            style = line_of(name)
            axes.plot(t, value, color=style.colour, linestyle=style.dash, label=name, linewidth=1.2)
            axes.fill_between(t, low, high, color=style.colour, alpha=0.18, linewidth=0)
        axes.set_ylabel(f"{panel.name}\n[{panel.unit}]", fontsize=8)
        axes.grid(alpha=0.3)
        if panel.fixed:
            axes.set_ylim(*panel.fixed)
        if panel.column == "mu":
            axes.axhspan(0.0, SLIPPERY_MU, color="#a3195b", alpha=0.12, linewidth=0)
    assert first is not None
    first.legend(fontsize=8)
    axes.set_xlabel("t [s]")
    track = _track_of(drive)
    place = drawn.add_subplot(grid[:3, 2])
    place.set_title("track, coloured by μ where known", fontsize=9)
    if track is not None:
        place.plot(track["x"], track["y"], color="#cccccc", linewidth=4)
        rows = [k for k, colour in enumerate(track["colour"]) if colour]
        colours = [track["colour"][k] for k in rows]
        place.scatter([track["x"][k] for k in rows], [track["y"][k] for k in rows], c=colours, s=8)
        place.set_aspect("equal", adjustable="datalim")
        place.set(xlabel="east [m]", ylabel="north [m]")
    drawn.suptitle(drive.title)
    return drawn
