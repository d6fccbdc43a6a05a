"""Tests of the sensitivity analysis, which measures how much the default estimator's results change
with each of its constants.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from edge_agent.app.tuned_memberships import shipped_memberships
from edge_agent.estimators.friction_mixture.state.constants import Constants
from edge_agent.estimators.friction_mixture.state.design import design_of
from edge_agent.lab.evaluation import worth
from edge_agent.lab.tuning import sensitivity
from edge_agent.lab.tuning.sensitivity import ConstantChange


@pytest.fixture(scope="module")
def drives() -> list[sensitivity.ScoredDrives]:
    """Simulate short drives for two seeds: manoeuvres, a town, and a town in winter. Return the
    drives.
    """
    return sensitivity.simulate_drives([8001, 8002], cars=2, town_s=8.0, drive_s=2.0)


def test_a_constant_that_matters_changes_the_score(drives: list[sensitivity.ScoredDrives]) -> None:
    changes = sensitivity.vary_constants(drives, only="curve_c")
    assert [change.name for change in changes] == ["curve_c"] * 2
    assert {change.factor for change in changes} == set(sensitivity.FACTORS)
    assert changes[0].effect >= changes[1].effect
    assert changes[0].effect > sensitivity.SMALL


def test_repeated_measurement_of_a_filter_gives_the_same_result(
    drives: list[sensitivity.ScoredDrives],
) -> None:
    usual = design_of(shipped_memberships(worth.ESTIMATOR), adaptive=True)
    assert sensitivity.measure(usual, drives) == sensitivity.measure(usual, drives)


def test_every_constant_is_changed_by_both_factors() -> None:
    memberships = shipped_memberships(worth.ESTIMATOR)
    found = [(name, factor) for name, factor, _ in sensitivity.vary_numbers(memberships)]
    assert len(found) == len(set(found))
    for name in Constants().by_name():
        assert {factor for other, factor in found if other == name} == set(sensitivity.FACTORS)
    assert any(name.startswith("shares") for name, _ in found)


def test_a_number_has_an_effect_if_one_of_its_factors_has() -> None:
    changes = [
        ConstantChange("a", 0.7, 0.1, 0.0, 0.0, 0.0),
        ConstantChange("a", 1.4, 0.0, 0.0, -3.0, 0.0),
        ConstantChange("b", 0.7, 0.9, 0.0, 0.0, 40.0),
    ]
    assert sensitivity.list_without_effect(changes) == ["b"]
    table = sensitivity.to_markdown(changes)
    assert "| `a` | 1.4 | +0.00 | +0.000 | -3.00 | +0 |" in table
    assert "(1): `b`" in table


def test_the_command_writes_table_and_numbers(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, drives: list[sensitivity.ScoredDrives]
) -> None:
    monkeypatch.setattr(sensitivity, "simulate_drives", lambda _seeds: drives)
    sensitivity.main(["--out", str(tmp_path), "--only", "hazard"])
    assert "`slip_hazard`" in (tmp_path / "sensitivity.md").read_text(encoding="utf-8")
    assert (tmp_path / "sensitivity.json").exists()


def test_excited_samples_are_judged_in_towns_only(drives: list[sensitivity.ScoredDrives]) -> None:
    assert all(np.shape(excited) == batch.mu.shape for batch, excited in drives)
    assert not drives[1].excited.any()
