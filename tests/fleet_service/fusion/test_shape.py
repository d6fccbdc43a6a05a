"""What a likelihood is worth after a visit that left grip unused."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from fleet_service.fusion import Fusion
from fleet_service.fusion import constants as c
from fleet_service.fusion.likelihoods import evidence
from fleet_service.fusion.shape import shape_kernel, unshaped
from schemas import mugrid
from tests.fleet_service.examples import CELL, observations, value


def told(mu: float, std: float = 0.05) -> np.ndarray:
    """A value as bytes, (1, 32)."""
    return mugrid.encode_log_likelihood(-0.5 * np.square((mugrid.CENTRES - mu) / std))[None]


_steps = (
    st.lists(st.integers(0, 255), min_size=32, max_size=32)
    .map(lambda e: (np.array(e) - min(e)).astype(np.uint8)[None])
    .filter(lambda steps: bool(steps[0, -1] >= c.VALUE_DROP_STEPS))
)


@given(_steps, st.integers(0, 60))
def test_it_is_the_told_likelihood_against_the_error_at_each_road(steps: np.ndarray, fiftieths: int) -> None:
    used = fiftieths / 50.0
    likelihood = shape_kernel(used) @ np.exp(steps[0] / -16.0)
    expected = np.clip(-16.0 * np.log(likelihood / likelihood.max()), 0, 255)
    np.testing.assert_allclose(unshaped(steps, np.array([used])).steps[0], expected, atol=1.01)


def test_a_value_from_the_limit_stays_as_it_was_told() -> None:
    steps = told(0.3)
    used = unshaped(steps, np.array([0.3])).steps[0].astype(int)
    near = mugrid.CENTRES < 0.3 / c.SHAPE_SHARE
    np.testing.assert_array_equal(used[near], steps[0][near])


@pytest.mark.parametrize("road", [0.5, 0.8, 1.1])
def test_the_less_was_used_the_less_a_value_says_against_more_grip(road: float) -> None:
    place = int(np.argmin(np.abs(mugrid.CENTRES - road)))
    against = [int(unshaped(told(0.3), np.array([used])).steps[0, place]) for used in (0.6, 0.3, 0.2, 0.1)]
    assert against == sorted(against, reverse=True)
    assert against[-1] < against[0]


def test_a_bound_and_a_visit_whose_use_is_unknown_stay_as_they_were_told() -> None:
    bound = mugrid.encode_log_likelihood(np.where(mugrid.CENTRES < 0.3, -6.0, -0.2 * mugrid.CENTRES))[None]
    np.testing.assert_array_equal(unshaped(bound, np.array([0.1])).steps, bound)
    np.testing.assert_array_equal(unshaped(told(0.3), np.array([np.nan])).steps, told(0.3))


def test_a_value_is_described_as_it_was_told_and_a_bound_is_not() -> None:
    reported = unshaped(np.vstack([told(0.85), told(0.3), 0 * told(0.3)]), np.array([0.5, 0.2, 0.2])).reported
    assert reported[:2, 0] == pytest.approx([0.85, 0.3], abs=0.01)
    assert reported[0, 1] == pytest.approx(np.hypot(0.05, np.hypot(c.BIAS_RELATIVE * 0.85, c.BIAS_ABSOLUTE)), rel=0.02)
    assert reported[:2, 2] == pytest.approx([0.0, 0.97], abs=0.03)
    assert np.isnan(reported[2]).all()


def test_who_lies_is_compared_with_what_others_reported_and_not_with_what_is_used_of_it() -> None:
    rng = np.random.default_rng(2)
    fusion, n = Fusion(120.0), 1200
    who = rng.integers(0, 12, n)
    reading = np.where(who == 0, 0.25, 0.85 + 0.04 * rng.normal(size=n))
    steps = mugrid.encode_log_likelihood(value(reading))
    columns = {"log_likelihood": steps, "mu_utilised": np.where(who == 0, 0.25, 0.5)}
    evidence_, reported = evidence(columns, np.ones(n, bool))
    o = observations(np.arange(n) * 1.0, who, value(reading))
    fusion.update(dataclasses.replace(o, cell=CELL + np.arange(n) // 30, evidence=evidence_, reported=reported))
    assert fusion.trust(0) < 0.2 < 0.8 < fusion.trust(1)


def test_the_error_of_a_reading_is_that_of_the_table() -> None:
    used, i = 0.42, 16  # road .644: share .65
    kernel = shape_kernel(used)[i]
    mean = kernel @ mugrid.CENTRES
    spread = np.sqrt(kernel @ (mugrid.CENTRES - mean) ** 2)
    share = used / mugrid.CENTRES[i]
    wanted = mugrid.CENTRES[i] * min(c.SHAPE_SLOPE * (c.SHAPE_SHARE - share), c.SHAPE_MOST)
    assert spread == pytest.approx(wanted, rel=0.02)
