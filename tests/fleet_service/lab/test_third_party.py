"""Tests of the simulated fleet of another car maker, and of the scores of the evaluation that uses
this fleet. The reports must have the errors that `third_party` describes, such as a gain error. The
scores must be right for beliefs whose score is known.
"""

from __future__ import annotations

import numpy as np
import pytest

from fleet_service.lab import third_party
from fleet_service.lab.score import crps_of, of_beliefs, slippery_scores
from schemas import mugrid


def test_gain_error_moves_value_and_use_alike() -> None:
    rng = np.random.default_rng(1)
    n = 20_000
    gain = np.array([-0.1, 0.1])
    vehicle = np.arange(n) % 2
    reports = third_party.make_reports(rng, gain, vehicle, np.full(n, 0.5), np.ones(n, bool))
    share = reports.used / reports.reading
    for who in (0, 1):
        assert reports.reading[vehicle == who].mean() == pytest.approx(
            0.5 * (1.0 + gain[who]), rel=0.01
        )
        assert share[vehicle == who].mean() == pytest.approx(np.mean(third_party.SHARE), rel=0.02)


def test_columns_hold_no_optional_fact_and_fixes_are_right() -> None:
    drive, mu = third_party.drive_honest(np.random.default_rng(2), 0.05)
    o = third_party.make_observations(drive)
    assert set(o.manoeuvre.tolist()) == {-1}
    assert np.mean(mu[drive.visits.place] != drive.visits.mu) < 0.01, (
        "five metres are three standard deviations"
    )


def test_changing_cells_are_dry_then_white_then_dry() -> None:
    drive = third_party.drive_change(np.random.default_rng(3), 0.3)
    v = drive.visits
    before_change = v.place < third_party.CHANGE_CELLS
    for k, mu in enumerate((third_party.DRY, third_party.WHITE, third_party.DRY)):
        now = v.seconds // (60.0 * third_party.MINUTES) == k
        assert set(v.mu[before_change & now].tolist()) == {mu}
    assert v.excited.mean() == pytest.approx(0.3, abs=0.02)
    assert len(np.unique(drive.cells)) == len(drive.cells)


def test_crps_of_a_point_is_its_error_and_of_the_prior_is_a_known_integral() -> None:
    truth = np.array([0.4])
    sure = np.zeros((1, mugrid.BINS))
    sure[0, 20] = 1.0
    assert crps_of(sure, truth)[0] == pytest.approx(mugrid.CENTRES[20] - 0.4, abs=0.02)
    width = mugrid.UPPER - mugrid.LOWER
    below = (0.4 - mugrid.LOWER) / width
    expected = width * (below**3 + (1.0 - below) ** 3) / 3.0
    assert crps_of(mugrid.PRIOR[None], truth)[0] == pytest.approx(expected, rel=0.01)


def test_slippery_scores_are_those_of_a_coin() -> None:
    truth = np.array([0.2, 0.6])
    scores = of_beliefs(np.tile(mugrid.PRIOR, (2, 1)), truth, np.ones(2, np.int64))
    p = float(scores.slippery[0])
    found = slippery_scores([scores])
    assert found["brier"] == pytest.approx(0.5 * (p**2 + (1.0 - p) ** 2))
    assert found["log"] == pytest.approx(-0.5 * (np.log(p) + np.log(1.0 - p)))
    assert found["ece"] == pytest.approx(abs(p - 0.5))
    assert (found["missed"], found["grip_raised"]) == (0.0, 0.0)
