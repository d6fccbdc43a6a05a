"""Tests of the belief about one cell (probabilities of friction). It must stay a probability
distribution and return to the prior with time. A single vote (effect of one visit) may change each
probability only by a limited factor.
"""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from fleet_service.fusion import belief, constants
from schemas import mugrid


def forget(p: np.ndarray, seconds: float) -> None:
    belief.forget(p, seconds, seconds, belief.PRIOR, np.empty(belief.PADDED))


def convolve_bias(evidence: np.ndarray, kind: int, vote: np.ndarray) -> None:
    belief.convolve_bias(evidence, kind, np.zeros(belief.PADDED), vote)


def vote_for(p: np.ndarray, vote: np.ndarray, strength: float) -> None:
    belief.apply_vote(p, vote, strength)
    p /= p.sum()


_rising = (
    st.lists(st.floats(0.0, 1.0), min_size=32, max_size=32)
    .map(np.sort)
    .filter(lambda p: p.sum() > 0.1)
)
_steps = st.lists(st.integers(0, 255), min_size=32, max_size=32).map(
    lambda e: np.array(e, np.uint8)
)


@given(st.lists(st.floats(0.0, 1.0), min_size=64, max_size=64), st.floats(0.0, 1.0))
def test_quantiles_are_those_of_the_contract_bit_for_bit(bins: list[float], level: float) -> None:
    beliefs = np.array(bins).reshape(2, 32)
    expected = [mugrid.quantiles(beliefs, q) for q in (level, 0.5)]
    np.testing.assert_array_equal(belief.quantiles(beliefs, (level, 0.5)), expected)


@given(_steps, st.floats(0.0, 1e6), st.floats(0.15, 1.0), st.floats(0.0, 1.0))
def test_a_belief_stays_a_probability_whatever_time_and_votes_do(
    evidence: np.ndarray, seconds: float, contamination: float, power: float
) -> None:
    p = mugrid.PRIOR.copy()
    vote = np.empty(32)
    for _ in range(3):
        forget(p, seconds)
        convolve_bias(evidence, belief.kind_of(evidence), vote)
        vote_for(p, vote, (1.0 - contamination) * power)
    assert p.min() >= 0.0
    assert p.sum() == pytest.approx(1.0, abs=1e-6)


@given(st.floats(0.0, 1e7))
def test_time_does_not_change_the_prior(seconds: float) -> None:
    p = mugrid.PRIOR.copy()
    forget(p, seconds)
    np.testing.assert_allclose(p, mugrid.PRIOR, atol=1e-15)


@given(_rising, st.floats(0.0, 1e5))
def test_time_keeps_a_rising_belief_rising(p: np.ndarray, seconds: float) -> None:
    p = p / p.sum()
    forget(p, seconds)
    assert np.diff(p).min() >= -1e-9


@given(_steps.filter(lambda e: int(e[-1]) - int(e.min()) <= 8), st.integers(1, 30))
def test_no_number_of_bounds_that_fall_by_half_a_nat_lowers_the_upper_end(
    evidence: np.ndarray, votes: int
) -> None:
    p = mugrid.PRIOR.copy()
    vote = np.empty(32)
    assert belief.kind_of(evidence) == belief.ReportKind.BOUND
    convolve_bias(evidence, belief.ReportKind.BOUND, vote)
    for _ in range(votes):
        vote_for(p, vote, 1.0 - constants.CONTAMINATION)
        forget(p, 60.0)
    assert mugrid.quantiles(p, 0.95) >= mugrid.quantiles(mugrid.PRIOR, 0.95) - 1e-9


@pytest.mark.parametrize("seconds", [60.0, 1800.0, 20_000.0])
def test_drift_keeps_the_mean_and_adds_its_variance(seconds: float) -> None:
    p = np.zeros(32)
    p[16] = 1.0
    forget(p, seconds)
    change = -np.expm1(-seconds / constants.CHANGE_S)
    drifted = (p - change / 32) / (1.0 - change)
    mean = drifted @ mugrid.CENTRES
    variance = drifted @ (mugrid.CENTRES - mean) ** 2
    assert mean == pytest.approx(mugrid.CENTRES[16], abs=1e-6)
    assert variance == pytest.approx(constants.DRIFT_PER_ROOT_HOUR**2 * seconds / 3600.0, rel=1e-5)


def test_the_bias_kernel_is_a_probability_for_every_road() -> None:
    kernel = belief.bias_kernel()
    np.testing.assert_allclose(kernel.sum(axis=1), 1.0, atol=1e-14)
    middle = kernel[20] @ mugrid.CENTRES
    spread = np.sqrt(kernel[20] @ (mugrid.CENTRES - middle) ** 2)
    assert spread == pytest.approx(
        np.hypot(constants.BIAS_RELATIVE * mugrid.CENTRES[20], constants.BIAS_ABSOLUTE), rel=0.02
    )


def test_one_vote_moves_the_odds_by_a_bounded_factor() -> None:
    evidence = np.full(32, 255, np.uint8)
    evidence[4] = 0
    vote = np.empty(32)
    p = mugrid.PRIOR.copy()
    convolve_bias(evidence, belief.ReportKind.VALUE, vote)
    vote_for(p, vote, 1.0 - constants.CONTAMINATION)
    assert p.max() / p.min() < 32 / constants.CONTAMINATION


def test_vote_without_weight_or_power_changes_no_belief() -> None:
    evidence = np.arange(32, dtype=np.uint8) * 8
    vote = np.empty(32)
    convolve_bias(evidence, belief.ReportKind.VALUE, vote)
    for contamination, power in ((1.0, 1.0), (constants.CONTAMINATION, 0.0)):
        p = np.linspace(1.0, 2.0, 32)
        p /= p.sum()
        before = p.copy()
        vote_for(p, vote, (1.0 - contamination) * power)
        np.testing.assert_allclose(p, before, atol=1e-15)
