"""Tests of the study of paper 004's tuning. The drives for the search and for the final evaluation
must be separate. The variance of the simulated sensor noise must follow table 2 of the paper. The
command must run from end to end.
"""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

from edge_agent.adaptation.memberships import Memberships
from edge_agent.app.tuned_memberships import WAYS, load_tuned
from edge_agent.cli import main
from edge_agent.lab.simulation.white import SCHEDULE
from edge_agent.lab.tuning import study, study_report
from edge_agent.lab.tuning.study import (
    CONDITIONS,
    HELD_OUT,
    TRAIN,
    VARIANCE,
    StudySet,
    mean_log_likelihood,
    record_noisy_drives,
    run_search,
    scores_of,
)
from schemas.runtime.figures import Figure
from schemas.signals import S

STILL = study_report.GIVEN["fixed"]


@pytest.fixture(scope="module")
def drives() -> StudySet:
    """Return the first two drives of the study's search set, six seconds of each."""
    return record_noisy_drives(TRAIN[:2])


def test_judging_drives_share_no_seed_or_manoeuvre_with_search_drives() -> None:
    for name in ("seed", "manoeuvre"):
        assert not {getattr(drive, name) for drive in TRAIN} & {
            getattr(drive, name) for drive in HELD_OUT
        }


def test_noise_lies_on_three_signals_alone_and_follows_the_schedule(drives: StudySet) -> None:
    right = drives.signals["right"]
    schedule = drives.signals["schedule"]
    differs = (right != schedule) & ~(np.isnan(right) & np.isnan(schedule))
    assert set(np.flatnonzero(differs.any(axis=(0, 1)))) == {S.AX, S.AY, S.YAW_RATE}
    error = schedule[:, :, S.YAW_RATE] - drives.truth[:, :, 2]
    seconds = [error[k : k + 100].var() for k in (0, 100, 200)]
    assert seconds == pytest.approx(SCHEDULE, rel=0.35)
    assert (right[:, :, S.YAW_RATE] - drives.truth[:, :, 2]).var() == pytest.approx(
        VARIANCE, rel=0.2
    )


def test_conditions_state_the_assumed_noise_of_the_filter() -> None:
    scales = [
        study.filter_setting(CONDITIONS[name]).noise[0] / VARIANCE
        for name in ("right", "too-small", "too-large")
    ]
    assert scales == pytest.approx([1.0, 0.1, 10.0])


def test_right_noise_without_adaptation_is_most_likely_with_nis_one(
    drives: StudySet,
) -> None:
    right, small, large = (
        scores_of(STILL, drives, name) for name in ("right", "too-small", "too-large")
    )
    assert right.log_likelihood > max(small.log_likelihood, large.log_likelihood) + 50.0
    assert right.nis == pytest.approx(1.0, abs=0.1)
    assert small.nis > 7.0
    assert large.nis < 0.15


def test_adaptation_recovers_most_of_what_a_wrong_noise_costs(drives: StudySet) -> None:
    best = scores_of(STILL, drives, "right").log_likelihood
    for name in ("too-small", "too-large"):
        lost, left = (
            best - scores_of(sets, drives, name).log_likelihood for sets in (STILL, Memberships())
        )
        assert left < 0.2 * lost


def test_search_is_reproducible_and_never_worse_than_untuned_sets(
    drives: StudySet,
) -> None:
    problem = study.problem_on(drives, positions=7)
    for way in study.WAYS:
        first, again = (run_search(way, problem, ants=3, iterations=2, seed=5) for _ in range(2))
        assert first.value >= mean_log_likelihood(Memberships(), drives)
        assert np.array_equal(first.best, again.best)
        assert first.history == again.history
        assert first.value == mean_log_likelihood(study.memberships_of(first.best), drives)


def test_the_quick_study_writes_figures_table_plot_and_a_tuned_file(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(["tune", "--study", str(tmp_path), "--quick", "--ants", "2"]) == 0
    reported = capsys.readouterr().out
    assert reported.count("elapsed") == 2 * 2 * 2
    header, *rows = json.loads((tmp_path / "figures.json").read_text())
    assert header["seeds"] == [0, 1]
    listed = [Figure(row["name"], row["value"], row["unit"]) for row in rows]
    assert (tmp_path / "study.md").read_text() == study_report.results_table(listed)
    names = {figure.name for figure in listed}
    for name in CONDITIONS:
        assert {f"tuning.{name}.{way}.log_likelihood" for way in study_report.SHOWN} <= names
    assert (tmp_path / "convergence.png").stat().st_size > 1000
    tuned = load_tuned(tmp_path / "paper-aco-fckf.json")
    assert tuned.document.provenance.budget.evaluations == {"random": 8, "colony": 8}
    assert set(tuned.document.scores) == set(WAYS)


def test_a_folder_that_cannot_be_made_is_refused(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["tune", "--study", "/dev/null/x", "--quick"]) == 2
    assert capsys.readouterr().err.startswith("error: study:")
