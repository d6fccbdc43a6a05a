"""Tests of the evaluation campaign. All figures and targets must exist, scores must be correct on
small cases, and the report must be made from the measured figures alone.
"""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from edge_agent.cli import main
from edge_agent.estimators import ESTIMATORS, Estimates
from edge_agent.estimators.estimates import ONE_FRICTION, Column
from edge_agent.lab.evaluation import measures
from edge_agent.lab.evaluation.bars import BARS, evaluation_figures
from edge_agent.lab.evaluation.batch import (
    DriveSet,
    DriveSpec,
    repeat_drive,
    simulate_ideal,
    simulate_realistic,
)
from edge_agent.lab.evaluation.campaign import DEFAULT, Results
from edge_agent.lab.evaluation.faults import CASES
from edge_agent.lab.evaluation.paper_004 import add_noise, noise_variances
from edge_agent.lab.evaluation.printed import OWN, PRINTED
from edge_agent.lab.evaluation.report import evaluation_report
from edge_agent.lab.evaluation.scenarios import (
    FOREIGN,
    OTHERS,
    PAPERS,
    SEDAN,
    VEHICLES,
    with_foreign_tyres,
)
from edge_agent.lab.seeds import FIGURES
from schemas.runtime.figures import Figure
from schemas.signals import S

# Required targets by name: value, and "less" or "more".
ASKED = {
    **{
        f"papers.004.{kind}.mae_{name}": (bar, "less")
        for kind in ("constant", "variable")
        for name, bar in (("vx", 0.002), ("vy", 0.007), ("yaw_rate", 0.002))
    },
    "default.dlc.mu_error": (0.05, "less"),
    "default.dlc.coverage90": (0.85, "more"),
    "papers.001.rmse_vx": (0.02, "less"),
    "papers.001.rmse_vy": (0.01, "less"),
    "papers.001.rmse_beta": (0.001, "less"),
    **{
        f"papers.002.{drive}.rmse_{name}": (0.03, "less")
        for drive in ("sine", "jturn")
        for name in ("vx", "vy")
    },
    "papers.003.accel.mu_error": (0.08, "less"),
    "papers.003.turn.mu_error": (0.05, "less"),
    "papers.003.split.low_error": (0.07, "less"),
    "papers.003.split.high_coverage90": (0.85, "more"),
    "papers.000.coverage90": (0.87, "more"),
    "default.jump.accel_s": (0.1, "less"),
    "default.jump.brake_s": (0.25, "less"),
    "default.jump.false_per_hour": (1.0, "less"),
    "default.straight.width_ratio": (0.8, "more"),
    "default.straight.coverage90": (0.9, "more"),
    "default.foreign_tyres.coverage90": (0.85, "more"),
    "default.abs.coverage90": (0.80, "more"),
    "default.spin.coverage90": (0.80, "more"),
    "default.turns.dry.coverage90": (0.85, "more"),
    "default.turns.dry.slippery": (0.002, "less"),
    "default.turns.ice.slippery": (0.8, "more"),
    "real_world.standing_5pct.v_max": (0.2, "less"),
    "real_world.width": (0.5, "less"),
    "real_world.false_ice": (0.002, "less"),
    "real_world.false_ice.off_ice": (0.002, "less"),
    "real_world.false_ice.of_all": (0.002, "less"),
    "real_world.below": (0.002, "less"),
    "real_world.coverage90": (0.88, "more"),
    **{
        f"real_world.coverage90.{name}": (0.80, "more")
        for name in ("ice", "snow", "wet", "dry", "excited")
    },
    **{
        f"real_world.contradiction_share.{name}.excited": (0.2, "less")
        for name in ("ice", "snow", "wet", "dry")
    },
    "fuzzy.worth": (0.97, "less"),
    "ants.worth": (1.0, "less"),
    "ants.worth.random": (1.0, "less"),
}


def fake(mu: float, lower: float, upper: float, like: DriveSet) -> Estimates:
    """Return made-up estimates for the drives `like`: their true motion, and everywhere the
    friction `mu` with the interval from `lower` to `upper`.
    """
    output = np.zeros((*like.t.shape, ONE_FRICTION))
    truth = like.truth
    output[..., Column.VX], output[..., Column.VY], output[..., Column.YAW_RATE] = (
        truth[f"true_{name}"] for name in ("vx", "vy", "yaw_rate")
    )
    output[..., Column.SIDESLIP] = np.arctan2(truth["true_vy"], truth["true_vx"])
    output[..., Column.MU] = mu
    output[..., Column.MU_LOWER] = lower
    output[..., Column.MU_UPPER] = upper
    output[..., Column.VX_STD : Column.MU] = 1.0
    output[..., Column.INNOVATION_NIS] = 1.0
    return Estimates(output)


@pytest.fixture(scope="module")
def jumping() -> DriveSet:
    """Return two simulated drives in which the road's friction falls from 0.85 to 0.5."""
    return simulate_realistic(replace(PAPERS["003.jump"], duration_s=5.0), range(2))


def test_the_bars_are_those_that_were_asked_for() -> None:
    assert {bar.name: (bar.bar, bar.better) for bar in BARS} == ASKED


def test_missing_measurements_are_reported_except_in_a_quick_run() -> None:
    assert {figure.name for figure in evaluation_figures(Results(), quick=False)} == set(ASKED)
    assert not any(figure.holds for figure in evaluation_figures(Results(), quick=False))
    assert evaluation_figures(Results(), quick=True) == []


def test_every_printed_figure_names_a_scenario_and_an_estimator_that_exist() -> None:
    assert set(OWN.values()) | {DEFAULT} <= set(ESTIMATORS)
    for row in PRINTED:
        assert not row.real or any(
            row.real.startswith(f"real.{scenario}.ESTIMATOR.") for scenario in PAPERS
        ), row
        assert row.same.split(".")[0] in ("ideal", "noise"), row


def test_true_motion_has_no_error_and_a_constant_friction_the_error_it_has(
    jumping: DriveSet,
) -> None:
    found = measures.common_measures(jumping, fake(0.6, 0.45, 0.7, jumping))
    assert found["rmse_vx"] == pytest.approx([0.0, 0.0])
    assert found["nees"] == pytest.approx([0.0, 0.0])
    assert found["mu_error"] == pytest.approx([0.1, 0.1])
    after = (jumping.mu == 0.5).mean(axis=0)
    assert (found["coverage90"] >= after).all()
    assert (found["coverage90"] < 1.0).all()
    assert found["width"] == pytest.approx([0.25, 0.25])


def test_arrival_time_counts_from_the_change_or_to_the_end(
    jumping: DriveSet,
) -> None:
    assert measures.arrival_time(jumping, fake(0.55, 0.4, 0.7, jumping)) == pytest.approx(
        [0.0, 0.0]
    )
    late = fake(0.85, 0.7, 0.9, jumping)
    late.mu[-50:] = 0.5
    changed = np.argmax(jumping.mu == 0.5, axis=0)
    assert measures.arrival_time(jumping, late) == pytest.approx(
        (len(late.mu) - 50 - changed) / 100.0
    )
    assert (measures.arrival_time(jumping, fake(0.85, 0.7, 0.9, jumping)) > 1.0).all()


def test_false_change_is_an_interval_that_stays_away_from_the_truth(jumping: DriveSet) -> None:
    reported = fake(0.85, 0.1, 1.0, jumping)
    assert measures.false_changes(jumping, reported).tolist() == [0.0, 0.0]
    reported.mu_upper[20:30] = 0.3
    assert measures.false_changes(jumping, reported).tolist() == [0.0, 0.0]
    reported.mu_upper[50:90, 1] = 0.3
    assert measures.false_changes(jumping, reported).tolist() == [0.0, 1.0]


def test_sides_are_distinguished() -> None:
    batch = simulate_realistic(replace(PAPERS["003.split"], duration_s=2.0), range(2))
    found = measures.side_measures(batch, fake(0.3, 0.2, 0.4, batch))
    assert found["low_error"] == pytest.approx([0.0, 0.0])
    assert found["high_coverage90"] == pytest.approx([0.0, 0.0])


def test_noise_of_paper_004_affects_three_signals_by_its_schedule() -> None:
    exact = repeat_drive(simulate_ideal(replace(PAPERS["004.dlc"], duration_s=10.0)), 1)
    variance = noise_variances(exact.t[:, 0], "variable")
    assert [variance[k] for k in (0, 150, 250, 350, 450)] == [0.04, 0.01, 0.05, 0.04, 0.01]
    batch = add_noise(exact, variance, [0, 1])
    error = batch.signals - np.repeat(exact.signals, 2, axis=1)
    assert np.nanmax(np.abs(np.delete(error, [S.AX, S.AY, S.YAW_RATE], axis=2))) == 0.0
    assert error[:100, :, S.AX].var() == pytest.approx(0.04, rel=0.4)
    assert error[100:200, :, S.AX].var() == pytest.approx(0.01, rel=0.4)
    assert not np.array_equal(error[:, 0], error[:, 1])


@pytest.mark.parametrize("kind", FOREIGN)
def test_foreign_tyres_make_another_drive(kind: str) -> None:
    usual = DriveSpec("j-turn", SEDAN, 0.4, duration_s=2.0)
    own = simulate_ideal(usual)
    other = simulate_ideal(with_foreign_tyres(usual, kind))
    assert np.abs(own.truth["true_vy"] - other.truth["true_vy"]).max() > 1e-3


def test_report_shows_all_figures() -> None:
    text = evaluation_report(
        [
            Figure("papers.001.rmse_vx", 0.3, "m/s", 0.02),
            Figure("real.001.dlc.aco-fckf.rmse_vx", 0.3, "m/s"),
            Figure("real.001.dlc.aco-fckf.rmse_vx.sd", 0.1, "m/s"),
        ],
        seeds=20,
    )
    assert "DOES NOT HOLD" in text
    assert "0 of 1 bars hold" in text
    assert "0.3 ± 0.1" in text
    assert "Reasons for the difference" in text


@pytest.mark.parametrize(
    ("arguments", "field"), [(["--seeds", "1"], "seeds"), (["--out", "/dev/null/x"], "out")]
)
def test_misuse_is_one_line_and_exit_code_two(
    arguments: list[str], field: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(["evaluate", "--out", str(tmp_path), "--no-plots", *arguments]) == 2
    assert capsys.readouterr().err.startswith(f"error: {field}:")


@pytest.mark.campaign
def test_the_quick_campaign_writes_figures_report_and_plots(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(["evaluate", "--out", str(tmp_path), "--quick", "--plots", "svg"]) in (0, 1)
    output = capsys.readouterr()
    assert "double lane change" in output.err
    header, *rows = json.loads((tmp_path / "figures.json").read_text())
    assert header["campaign"] == "edge-agent evaluate --quick"
    assert header["seeds"] == [FIGURES, FIGURES + 1]
    named = {row["name"]: row for row in rows}
    assert named["papers.004.constant.mae_vy"]["holds"]
    assert {"papers.003.split.low_error", "default.jump.accel_s"} <= set(named)
    assert {
        "faults.time-gap.aco-fckf.coverage90",
        "reliability.aco-fckf.below_35",
        "bounds.nees.upper",
    } <= set(named)
    assert named["faults.no-torque-at-all.paper-aco-fckf.told"]["value"] == 1.0
    text = (tmp_path / "report.md").read_text()
    assert all(f"| {case} |" in text for case in CASES)
    assert "NO (" not in text
    assert (tmp_path / "report.md").read_text().startswith("# Evaluation")
    assert {"memberships.svg", "reliability.svg", "consistency.svg", "004.dlc.svg"} <= {
        path.name for path in tmp_path.glob("*.svg")
    }


@pytest.mark.campaign
def test_options_add_seeds_and_omit_plots(tmp_path: Path) -> None:
    assert main(["evaluate", "--out", str(tmp_path), "--quick", "--seeds", "3", "--no-plots"]) in (
        0,
        1,
    )
    assert json.loads((tmp_path / "figures.json").read_text())[0]["seeds"] == [
        FIGURES,
        FIGURES + 1,
        FIGURES + 2,
    ]
    assert not [path for ending in ("png", "svg", "pdf") for path in tmp_path.glob(f"*.{ending}")]
    assert (tmp_path / "report.md").exists()


def test_scenarios_of_papers_and_of_the_default_have_different_names() -> None:
    assert not set(PAPERS) & set(OTHERS)
    assert not (set(PAPERS) | set(OTHERS)) & set(VEHICLES)
