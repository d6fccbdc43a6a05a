"""Tests of `edge-agent evaluate --paper`, which reproduces the papers' results: it writes tables,
plots and a page, and its exit code is 1 if a required result is missed.
"""

from __future__ import annotations

import json
import math
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from edge_agent.app.tuned_memberships import shipped_memberships
from edge_agent.cli import main
from edge_agent.estimators.paper_aco_fckf import AS_PRINTED, AT_THE_TRUTH
from edge_agent.lab.evaluation.papers import reproductions
from edge_agent.lab.evaluation.papers.conditions import IN_WHEEL, MATCHED
from edge_agent.lab.evaluation.papers.drawing import draw_plot
from edge_agent.lab.evaluation.papers.outcome import (
    NONE,
    Curve,
    Heat,
    PaperPlot,
    PaperRow,
    PaperTable,
    PlotPanel,
    Reproduction,
)
from edge_agent.lab.evaluation.papers.page import (
    limit_text,
    markdown_tables,
    report_html,
    summary_sentence,
)
from edge_agent.lab.evaluation.papers.reproduction_001 import BOTH, run_drive
from edge_agent.lab.evaluation.papers.reproduction_004 import run_noise
from edge_agent.lab.simulation.presets import PRESETS
from tests.elements_page import PAPERS as ELEMENT_LISTS
from tests.elements_page import elements_page

HELD = PaperRow("mae_vx", "MAE v_x [m/s]", 0.02, 0.01, 0.03)
MISSED = PaperRow("mae_vy", "MAE v_y [m/s]", 0.02, 0.021)
SHOWN = PaperRow("mae_mu", "MAE μ", NONE, 0.5)
PLOT = PaperPlot(
    "path",
    "Path",
    (PlotPanel("", "x", "y", (Curve("true", np.arange(3.0), np.arange(3.0), "truth"),)),),
)


def made_up(*rows: PaperRow) -> Reproduction:
    done = Reproduction("004", "a test", ELEMENT_LISTS["004"][1])
    done.tables = [PaperTable("Table 1", rows)]
    done.plots = [PLOT]
    done.notes = ["a < b"]
    return done


def test_row_compares_a_figure_with_its_printed_number() -> None:
    assert HELD.holds
    assert not MISSED.holds
    assert SHOWN.limit is None
    assert SHOWN.holds
    assert HELD.unit == "m/s"
    assert replace_bar(MISSED, 0.03).holds
    assert not PaperRow("coverage90", "coverage", NONE, 0.8, bar=0.88, better="more").holds
    assert not PaperRow("mae_vx", "MAE v_x", 0.1, math.nan).holds


def replace_bar(row: PaperRow, bar: float) -> PaperRow:
    return row._replace(bar=bar)


def test_summary_names_the_rows_that_miss() -> None:
    assert summary_sentence(made_up(HELD, SHOWN)) == "1 of 1 matched numbers meet their bar."
    assert "Missed: mae_vy" in summary_sentence(made_up(HELD, MISSED))


def test_tables_show_dashes_where_nothing_is_known() -> None:
    text = markdown_tables(made_up(HELD, MISSED).tables)
    assert "| MAE v_x [m/s] | 0.02 | 0.01 | 0.03 | – | – | ≤ 0.02 | holds |" in text
    assert "MISSED" in text
    assert limit_text(SHOWN) == ""


def test_page_has_tables_notes_elements_and_figures() -> None:
    text = report_html(made_up(HELD, MISSED), 3.0)
    assert '<td class="number held">0.01</td>' in text
    assert '<td class="number missed">0.021</td>' in text
    assert "a &lt; b" in text
    assert '<img src="path.svg"' in text
    assert "dual-motor" in text


@pytest.mark.parametrize(("rows", "code"), [((HELD, SHOWN), 0), ((HELD, MISSED), 1)])
def test_exit_code_is_one_if_a_matched_row_misses(
    rows: tuple[PaperRow, ...], code: int, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setitem(reproductions.REPRODUCTIONS, "004", lambda _seeds: made_up(*rows))
    assert main(["evaluate", "--paper", "004", "--out", str(tmp_path)]) == code
    names = [row.get("name") for row in json.loads((tmp_path / "figures.json").read_text())]
    assert "papers.004.mae_vx" in names
    assert "papers.004.own.mae_vx" in names
    assert "papers.004.elements.missing_unsaid" in names
    assert {path.suffix for path in tmp_path.glob("path.*")} == {".png", ".svg"}
    assert (tmp_path / "index.html").exists()


def test_paper_and_another_campaign_are_refused(tmp_path: Path) -> None:
    assert main(["evaluate", "--paper", "004", "--only", "worth", "--out", str(tmp_path)]) == 2


@pytest.mark.campaign
def test_paper_is_reproduced_and_written(tmp_path: Path) -> None:
    assert main(["evaluate", "--paper", "001", "--seeds", "2", "--out", str(tmp_path)]) == 0
    text = (tmp_path / "report.md").read_text()
    assert "FKF" in text
    assert "## Elements of the paper" in text


def test_plot_of_numbers_and_a_map_is_drawn() -> None:
    heat = Heat("", "position", "vertex", np.eye(3), ("a", "b", "c"), "pheromone")
    figure = draw_plot(PaperPlot("both", "Both", (*PLOT.panels, heat), 2))
    assert len(figure.axes) == 3  # two panels and the colour bar


def test_dugoff_tyres_in_the_plant_reach_the_printed_friction_error() -> None:
    filters = {
        "it": (shipped_memberships("paper-aco-fckf"), AT_THE_TRUTH),
        "printed": (shipped_memberships("paper-aco-fckf"), AS_PRINTED),
    }
    run = run_noise(MATCHED["004.dlc"], "constant", filters, range(20))
    assert run.values("it")["mae_mu"] <= 0.0095
    assert run.values("it")["mae_vy"] <= 0.0131
    assert run.values("printed")["mae_vx"] <= 0.072
    assert run.values("printed")["mae_vy"] <= 0.0131
    magic = replace(
        MATCHED["004.dlc"], vehicle=replace(MATCHED["004.dlc"].vehicle, curve="magic-formula")
    )
    assert run_noise(magic, "constant", filters, range(20)).values("it")["mae_mu"] > 0.0095


def test_matched_plant_of_001_reaches_the_printed_errors() -> None:
    found = run_drive(MATCHED["001.dlc"], BOTH).values("improved")
    assert found["mae_vx"] <= 0.0009
    assert found["mae_vy"] <= 0.0024
    assert found["mae_beta"] <= 0.0002


def test_vehicle_of_002_has_the_printed_axle_stiffness_and_inertia() -> None:
    vehicle = IN_WHEEL.vehicle
    base = vehicle.cg_to_front_axle + vehicle.cg_to_rear_axle
    weight = vehicle.mass * 9.81
    slope = vehicle.cornering_stiffness / (weight / 4.0)
    assert slope * weight * vehicle.cg_to_rear_axle / base == pytest.approx(60_000.0)
    assert slope * IN_WHEEL.rear_slope * weight * vehicle.cg_to_front_axle / base == pytest.approx(
        40_000.0
    )
    assert vehicle.wheel_inertia == 7.143


def test_default_plant_is_as_it_was() -> None:
    sedan = PRESETS["sedan"]
    assert (sedan.curve, sedan.stiffness, sedan.rear_slope, sedan.motors) == (
        "magic-formula",
        "similarity",
        1.0,
        None,
    )


def test_reference_page_lists_every_paper() -> None:
    text = elements_page()
    for paper, (estimator, elements) in ELEMENT_LISTS.items():
        assert f"## Paper {paper}: `{estimator}`" in text
        assert all(element.place.replace("|", "\\|") in text for element in elements)
