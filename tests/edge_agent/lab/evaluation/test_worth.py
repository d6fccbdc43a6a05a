"""What fuzzy inference and the ants bring is measured on drives that nobody tuned on."""

import numpy as np
import pytest

from edge_agent.lab.evaluation import worth
from edge_agent.lab.seeds import FIGURES
from edge_agent.lab.tuning import objectives


def test_drives_that_judge_are_those_of_the_figures() -> None:
    tuned_on = {drive.seed for drive in objectives.TRAIN + objectives.HELD_OUT}
    tuned_on |= {seed for seeds, _ in objectives.TOWNS.values() for seed in seeds}
    assert max(tuned_on) < FIGURES


def test_worth_is_the_ratio_of_the_means_with_its_spread_and_tells_every_surface() -> None:
    scores = {
        way: {"all": np.array(values), "ice": np.array(values), "dry": np.array([np.nan, np.nan])}
        for way, values in {
            "fuzzy": [0.5, 0.7],
            "none": [1.0, 1.0],
            "colony": [0.4, 0.6],
            "random": [0.5, 0.5],
        }.items()
    }
    found = {figure.name: figure for figure in worth.figures(scores)}
    assert worth.ratio(scores, "fuzzy.worth") == pytest.approx(0.6)
    assert worth.ratio(scores, "ants.worth") == pytest.approx(1.0)
    assert np.isnan(
        worth.ratio({way: scores[way] for way in ("fuzzy", "colony", "random")}, "fuzzy.worth")
    )
    assert found["fuzzy.worth.sd"].value == pytest.approx(0.1 * np.sqrt(2.0))
    assert found["fuzzy.worth.ice"].value == pytest.approx(0.6)
    assert "fuzzy.worth.dry" not in found


def test_with_and_without_rules_are_two_filters() -> None:
    scores = worth.campaign([FIGURES], quick=True)
    assert scores["fuzzy"]["all"] != scores["none"]["all"]
    assert {"fuzzy", "none", "same_scales", "default"} <= set(scores)
    assert all(np.isfinite(found["all"]).all() for found in scores.values())
