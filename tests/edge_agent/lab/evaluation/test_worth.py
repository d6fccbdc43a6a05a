"""Tests of the comparison that shows the benefit of fuzzy inference and of tuning by an ant colony.
The comparison must use only simulated drives that the tuning does not use.
"""

import numpy as np
import pytest

from edge_agent.lab.evaluation import worth
from edge_agent.lab.seeds import FIGURES
from edge_agent.lab.tuning import objectives


def test_drives_that_judge_are_those_of_the_figures() -> None:
    tuned_on = {drive.seed for drive in objectives.TRAIN + objectives.HELD_OUT}
    tuned_on |= {seed for seeds, _ in objectives.TOWNS.values() for seed in seeds}
    assert max(tuned_on) < FIGURES


def test_worth_is_the_ratio_of_means_with_its_spread_per_surface() -> None:
    scores = {
        way: {"all": np.array(values), "ice": np.array(values), "dry": np.array([np.nan, np.nan])}
        for way, values in {
            "fuzzy": [0.5, 0.7],
            "sets_off": [1.0, 1.0],
            "default": [0.8, 0.8],
            "colony": [0.4, 0.6],
            "random": [0.5, 0.5],
        }.items()
    }
    found = {figure.name: figure for figure in worth.comparison_figures(scores)}
    assert worth.score_ratio(scores, "fuzzy.worth") == pytest.approx(0.6)
    assert worth.score_ratio(scores, "ants.worth") == pytest.approx(0.625)
    assert worth.score_ratio(scores, "ants.worth.random") == pytest.approx(1.0)
    assert np.isnan(
        worth.score_ratio(
            {way: scores[way] for way in ("fuzzy", "default", "colony")}, "fuzzy.worth"
        )
    )
    assert found["fuzzy.worth.sd"].value == pytest.approx(0.1 * np.sqrt(2.0))
    assert found["ants.worth.random.difference"].value == pytest.approx(0.0)
    assert found["ants.worth.random.difference.se"].value == pytest.approx(0.1)
    assert found["ants.worth.difference"].value == pytest.approx(-0.3)
    assert found["ants.worth.wins"].value == 1.0
    values = {one.name: one.value for one in worth.barred_figures(scores)}
    row = "| `ants.worth` | colony, default | 0.625 | -0.3000 ± 0.1000 | 1.00 |"
    assert row in worth.comparison_table(values)
    assert found["fuzzy.worth.ice"].value == pytest.approx(0.6)
    assert "fuzzy.worth.dry" not in found


def test_figures_with_targets_are_first_and_missing_ones_fail() -> None:
    scores = {"fuzzy": {"all": np.array([1.0])}, "sets_off": {"all": np.array([1.1])}}
    found = worth.barred_figures(scores)
    assert [figure.name for figure in found[:3]] == list(worth.BARS)
    assert [figure.holds for figure in found[:3]] == [True, False, False]


def test_with_and_without_rules_are_three_filters() -> None:
    lines: list[str] = []
    scores = worth.compare_variants([FIGURES], quick=True, log_line=lines.append)
    every = {float(scores[way]["all"][0]) for way in ("fuzzy", "sets_off", "none")}
    assert len(every) == 3
    assert {"default", "random", "colony"} <= set(scores)
    assert all(np.isfinite(found["all"]).all() for found in scores.values())
    assert lines[0].startswith(f"seed {FIGURES}: ")


def test_without_sets_keeps_strain_and_the_consistency_test() -> None:
    design = worth.without_sets()
    assert design.adaptive
    assert not design.fuzzy_outputs.any()
    assert not design.rules.by_sets
