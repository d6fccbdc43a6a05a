"""Tests of the figures about the reliability of friction intervals and the consistency of filters.
A known error in made-up estimates must be visible in these figures.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from edge_agent.app.estimator_factory import bank_of
from edge_agent.estimators import Estimates
from edge_agent.estimators.friction_mixture.report.reported_interval import (
    LOWER_END,
    NEARER,
    UPPER_END,
)
from edge_agent.lab.evaluation.batch import DriveSet, run_estimator, simulate_realistic
from edge_agent.lab.evaluation.measures import consistency_shares, mean_bounds
from edge_agent.lab.evaluation.reliability import (
    LEVELS,
    between_quantiles,
    estimate_with_ranks,
    on_the_grid,
    rank_shares,
)
from edge_agent.lab.evaluation.scenarios import PAPERS
from schemas.mugrid import BINS, CENTRES
from tests.edge_agent.lab.evaluation.test_evaluation import fake


@pytest.fixture(scope="module")
def turning() -> DriveSet:
    return simulate_realistic(replace(PAPERS["003.turn"], duration_s=4.0), range(3))


def test_truths_from_the_stated_distribution_match_each_quantile() -> None:
    rng = np.random.default_rng(0)
    mean = rng.uniform(0.5, 0.7, 20_000)
    truth = mean + 0.05 * rng.normal(size=mean.shape)
    ranks = between_quantiles(truth, mean - 1.6449 * 0.05, mean, mean + 1.6449 * 0.05)
    assert rank_shares(ranks) == pytest.approx(np.array(LEVELS), abs=0.012)


def test_an_overconfident_answer_is_seen_at_both_ends() -> None:
    rng = np.random.default_rng(1)
    mean = np.full(20_000, 0.6)
    truth = mean + 0.1 * rng.normal(size=mean.shape)
    output = rank_shares(between_quantiles(truth, mean - 1.6449 * 0.05, mean, mean + 1.6449 * 0.05))
    assert output[0] > 0.15
    assert output[-1] < 0.85


def test_prior_is_uniform_and_grid_posterior_is_its_own_distribution() -> None:
    truth = np.array([0.05, 0.34, 1.2])
    flat = np.zeros((3, BINS))
    assert on_the_grid(truth, flat) == pytest.approx((truth - 0.05) / 1.15)
    prior = (np.full(3, 0.1075), np.full(3, 0.625), np.full(3, 1.1425))
    assert between_quantiles(truth, *prior) == pytest.approx((truth - 0.05) / 1.15)
    peak = -0.5 * ((CENTRES - 0.6) / 0.1) ** 2
    assert on_the_grid(np.array([0.6]), peak[None]) == pytest.approx([0.5], abs=0.02)


def test_an_end_that_the_range_cuts_off_does_not_narrow_the_gaussian() -> None:
    cut = between_quantiles(
        np.array([0.15]), np.array([0.05]), np.array([0.10]), np.array([0.2645])
    )
    assert cut == pytest.approx([0.692], abs=0.01)


@pytest.mark.parametrize("estimator", ["aco-fckf", "sr-ukf"])
def test_computing_ranks_does_not_change_the_estimates(estimator: str, turning: DriveSet) -> None:
    plain = run_estimator(bank_of(estimator, turning.vehicles), turning)
    reported, ranks = estimate_with_ranks(bank_of(estimator, turning.vehicles), turning)
    assert np.array_equal(plain.values, reported.values)
    assert ranks.shape == (3, 3)
    assert ((ranks >= 0.0) & (ranks <= 1.0)).all()


def test_posterior_of_the_default_has_its_reported_quantiles(
    turning: DriveSet,
) -> None:
    """The ends of the friction interval that the default estimator reports must be the posterior's
    quantiles at the calibrated levels. The lower end may lie lower, because possible ice patches
    lower it.
    """
    reported, _ = estimate_with_ranks(bank_of("aco-fckf", turning.vehicles), turning)
    for least, most, output in (
        (0.0, LOWER_END, reported.mu_lower),
        (0.5, 0.5, reported.mu),
        (UPPER_END - NEARER, UPPER_END, reported.mu_upper),
    ):
        for side, level in ((-1.0, most), (1.0, least)):
            beside = output + side * 1.15 / BINS
            moved = replace(
                turning, truth={f"true_mu_{w}": beside for w in ("fl", "fr", "rl", "rr")}
            )
            _, ranks = estimate_with_ranks(bank_of("aco-fckf", turning.vehicles), moved)
            assert (side * (ranks - level) > 0.0).all()


def test_consistency_is_one_for_the_right_spread_and_zero_for_a_tenth(
    turning: DriveSet,
) -> None:
    reported = fake(0.35, 0.3, 0.4, turning)
    rng = np.random.default_rng(2)
    right = Estimates(reported.values.copy())
    wrong = Estimates(reported.values.copy())
    for one in (right, wrong):
        one.vx[:] += rng.normal(size=reported.vx.shape)
        one.vy[:] += rng.normal(size=reported.vy.shape)
        one.innovation_nis[:] = rng.chisquare(3, reported.vx.shape) / 3.0
    found = consistency_shares(turning, right)
    assert found["nees_within"][0] == pytest.approx(0.95, abs=0.03)
    assert found["nis_within"][0] == pytest.approx(0.95, abs=0.03)
    wrong.vx_std[:] = 0.1 * reported.vx_std
    wrong.vy_std[:] = 0.1 * reported.vy_std
    assert consistency_shares(turning, wrong)["nees_within"][0] < 0.05


def test_bounds_close_in_on_one_with_more_drives() -> None:
    few = mean_bounds("nees", 5)
    many = mean_bounds("nees", 500)
    assert few[0] < many[0] < 1.0 < many[1] < few[1]
