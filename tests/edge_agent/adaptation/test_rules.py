"""Tests of two adaptation rules. Paper 001: at the peaks of the fuzzy sets, the rule table must
give its entries. Paper 002: the noise estimate, computed from the last innovations (measurement
minus prediction), must find the variance of white noise.
"""

from __future__ import annotations

import math

import numpy as np
import pytest

from edge_agent.adaptation.fuzzy import FactorLimits, adapted_factor, adapted_within
from edge_agent.adaptation.memberships import Memberships
from edge_agent.adaptation.rules import ALPHA, PRINTED, RATE, infer_two, rule_table
from edge_agent.adaptation.windows import push_innovation, weighted_noise
from schemas.errors import InputError

TABLE = rule_table()


def test_rules_leave_r_unchanged_if_the_noise_is_right() -> None:
    assert infer_two(0.0, 0.0, ALPHA, RATE, TABLE) == 0.0


def test_rule_table_is_exact_at_peaks_and_constant_beyond_its_edge() -> None:
    for j, rate in enumerate(RATE):
        for i, alpha in enumerate(ALPHA):
            assert infer_two(alpha, rate, ALPHA, RATE, TABLE) == pytest.approx(
                TABLE[j, i], abs=1e-12
            )
    assert infer_two(1e9, 1e9, ALPHA, RATE, TABLE) == pytest.approx(math.log(8.0))


def test_r_follows_the_ratio_of_actual_to_expected_innovations() -> None:
    assert infer_two(2.0, 0.0, ALPHA, RATE, TABLE) > 0.0 > infer_two(-0.7, 0.0, ALPHA, RATE, TABLE)


@pytest.mark.parametrize(
    "printed",
    [PRINTED[:4], ("PXX" + PRINTED[0][3:], *PRINTED[1:]), (*PRINTED[:2], PRINTED[3], *PRINTED[3:])],
)
def test_a_corrupted_table_is_refused(printed: tuple[str, ...]) -> None:
    with pytest.raises(InputError, match="rules"):
        rule_table(printed)


def test_bounds_and_pace_of_the_adaptation_matter() -> None:
    sets = Memberships()
    inputs = np.array(sets.inputs)
    outputs = np.array(sets.outputs)
    one = adapted_within(1.0, 3.0, 1.0, inputs, outputs, FactorLimits(1.0, 0.1, 20.0))
    assert one == adapted_factor(1.0, 3.0, 1.0, inputs, outputs)
    assert adapted_within(
        1.0, 3.0, 1.0, inputs, outputs, FactorLimits(2.0, 0.1, 20.0)
    ) == pytest.approx(one**2)
    assert adapted_within(1.0, 3.0, 1.0, inputs, outputs, FactorLimits(1.0, 0.1, 1.01)) == 1.01
    assert adapted_within(1.0, 0.1, 1.0, inputs, outputs, FactorLimits(1.0, 0.99, 20.0)) == 0.99


def test_the_weighted_window_finds_the_variance_of_white_noise() -> None:
    window = 0.3 * np.random.default_rng(0).normal(size=20_000)
    assert weighted_noise(window, 0.0, 0.09, 0.1, 10.0) == pytest.approx(0.09, rel=0.05)
    assert weighted_noise(window, 0.04, 0.09, 0.1, 10.0) == pytest.approx(0.05, rel=0.1)


def test_window_changes_the_noise_only_when_full_and_within_bounds() -> None:
    window = np.full(3, np.nan)
    for error in (5.0, 5.0):
        push_innovation(window, error)
    assert weighted_noise(window, 0.0, 1.0, 0.5, 4.0) == 1.0
    push_innovation(window, 5.0)
    assert weighted_noise(window, 0.0, 1.0, 0.5, 4.0) == 4.0
    for _ in range(3):
        push_innovation(window, 0.0)
    assert weighted_noise(window, 0.0, 1.0, 0.5, 4.0) == 0.5


def test_larger_innovations_weigh_more() -> None:
    assert weighted_noise(np.array([1.0, 3.0]), 0.0, 1.0, 0.0, 99.0) == pytest.approx(
        0.5 * (1 + 27) / 4
    )
