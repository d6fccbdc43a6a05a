"""Tests that plots of answers show everything a reader needs: roads, days, times, names, and a line
at the contracted friction.
"""

from __future__ import annotations

import numpy as np
import pyarrow as pa
import pytest
from matplotlib.axes import Axes
from matplotlib.collections import PolyCollection
from matplotlib.figure import Figure

from fleet_service.analytics import plots
from schemas import grid
from tests.fleet_service.examples import CELL

BENT = grid.interleave(
    np.array([0, 1, 2, 2, 2]) + 1_118_000, np.array([0, 0, 0, 1, 2]) + 630_000
).tolist()
NOON_US = 1_769_515_200_000_000  # 27 January 2026, noon, in microseconds


def draw_figure(name: str, table: pa.Table) -> Figure:
    figure = Figure()
    plots._DRAWN[name](figure, table)
    return figure


def shapes(axes: Axes) -> int:
    return sum(len(one.get_paths()) for one in axes.collections if isinstance(one, PolyCollection))


def list_names(axes: Axes) -> list[str]:
    legend = axes.get_legend()
    return [text.get_text() for text in legend.get_texts()] if legend else []


def test_worst_draws_cells_of_each_stretch_without_connecting_lines() -> None:
    one = {
        "sector": 1,
        "mu": 0.2,
        "length_m": 50.0,
        "share_slippery": 0.9,
        "share_lower": 0.7,
        "values": 12,
    }
    figure = draw_figure(
        "worst", pa.Table.from_pylist([{**one, "members": BENT}, {**one, "members": BENT[:2]}])
    )
    first, second = (axes for axes in figure.axes if axes.get_xlabel() == "east [m]")
    assert [shapes(first), shapes(second)] == [5, 2]
    assert not first.lines
    assert first.get_title().startswith("1: 50 m heading north ↑")


def test_grip_of_a_day_shows_that_day_and_cells_with_bounds_only() -> None:
    table = pa.table({"day": ["2026-01-27"] * 3, "mu_p50": [0.3, 0.8, None]})
    (axes,) = draw_figure("grip", table).axes
    assert [label.get_text() for label in axes.get_xticklabels()] == ["2026-01-27"]
    assert np.ptp(axes.get_xlim()) < 2.0
    assert "2 measured\n1 bounded" in [text.get_text() for text in axes.texts]
    assert len(list_names(axes)) == 2


def test_replay_has_one_map_per_moment_with_unmeasured_cells_hatched() -> None:
    frames = pa.array([NOON_US, NOON_US, NOON_US + 10_000_000], pa.timestamp("us", tz="UTC"))
    table = pa.table(
        {
            "frame": frames,
            "cell": [CELL, CELL + 1, CELL],
            "sector": [0, 0, 0],
            "mu": [0.3, None, 0.4],
        }
    )
    maps = [axes for axes in draw_figure("replay", table).axes if axes.get_xlabel() == "east [m]"]
    assert [axes.get_title() for axes in maps] == [
        "2026-01-27T12:00:00 UTC",
        "2026-01-27T12:00:10 UTC",
    ]
    assert [shapes(axes) for axes in maps] == [2, 1]
    hatched = [
        one for one in maps[0].collections if isinstance(one, PolyCollection) and one.get_hatch()
    ]
    assert [len(one.get_paths()) for one in hatched] == [1]


def test_replay_omits_another_town_and_reports_it() -> None:
    """A drive in another country must not shrink the town to a dot."""
    cells = [CELL, CELL + 1, int(grid.cell_of(37.7, -122.4))]
    frames = pa.array([NOON_US] * 3, pa.timestamp("us", tz="UTC"))
    table = pa.table({"frame": frames, "cell": cells, "sector": [0] * 3, "mu": [0.3, 0.4, 0.9]})
    figure = draw_figure("replay", table)
    assert shapes(figure.axes[0]) == 2
    assert [text.get_text() for text in figure.texts] == [
        "1 rows far away left out; choose with --bbox"
    ]


def test_change_rates_show_each_class_with_its_interval() -> None:
    one = {"by": "road temperature", "rate_per_hour": 0.2, "assumed_per_hour": 0.3}
    rows = [
        {**one, "class": "above 5", "rate_lower": 0.1, "rate_upper": 0.4},
        {**one, "class": "below 0", "rate_lower": None, "rate_upper": None},
    ]
    (axes,) = draw_figure("change-rates", pa.Table.from_pylist(rows)).axes
    names = ["road temperature: above 5", "road temperature: below 0"]
    assert [label.get_text() for label in axes.get_yticklabels()] == names
    assert len(list_names(axes)) == 2


def test_contract_shows_the_breach_and_the_verdict_of_each_link() -> None:
    row: dict[str, object] = {"link": "7", "direction": "forward", "name": None}
    row |= {"verdict": "broken", "breach_s": 7200, "least_s": 3600, "most_s": 10800}
    (axes,) = draw_figure("contract", pa.Table.from_pylist([row])).axes
    assert [label.get_text() for label in axes.get_yticklabels()] == ["7, forward: broken"]
    assert np.asarray(axes.lines[0].get_xdata()).tolist() == [2.0]


def test_calibration_plot_labels_and_draws_the_published_values() -> None:
    rows = [("measured", 0, 0.86, 0.97), ("measured", 1, 0.84, 0.96), ("bound", 0, 0.9, 0.98)]
    table = pa.Table.from_pylist(
        [dict(zip(("basis", "age_h", "held", "compatible"), row, strict=True)) for row in rows]
    )
    (axes,) = draw_figure("calibration", table).axes
    assert set(list_names(axes)) == {
        "measured: held",
        "measured: compatible",
        "bound: held",
        "bound: compatible",
        "published: 90%",
    }
    published = next(line for line in axes.lines if line.get_label() == "published: 90%")
    assert np.asarray(published.get_ydata()).tolist() == [0.9, 0.9]


@pytest.mark.parametrize("lasts", [True, False])
def test_lasting_and_ended_spells_are_distinguished(lasts: bool) -> None:
    table = pa.table({"onset": [NOON_US * 1e-6], "duration_s": [600.0], "lasts": [lasts]})
    (axes,) = draw_figure("spells", table).axes
    arrows = [
        line
        for line in axes.lines
        if line.get_marker() == ">" and len(np.asarray(line.get_xdata()))
    ]
    assert len(arrows) == lasts
    assert list_names(axes) == ["ended", "lasts at the end of the data"]
