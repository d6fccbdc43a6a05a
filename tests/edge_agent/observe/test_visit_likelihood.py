"""Tests of the likelihood that an observation reports. That a visit gives a friction value must be
limited evidence that the vehicle used almost all of the grip; that it gives none, evidence that it
did not. A bound must stay a bound.
"""

from __future__ import annotations

import numpy as np
import pytest

from edge_agent.observe.visit_likelihood import weigh_by_use
from schemas import mugrid
from schemas.numeric import FloatArray
from schemas.thresholds import EXCITED_SHARE, VALUE_NATS

WIDE_VALUE = -0.5 * np.square((mugrid.CENTRES - 0.5) / 0.4)[None]  # a value: it falls by 1.5 nat


def bin_of(mu: float) -> int:
    """Return the index of the friction bin that contains `mu`."""
    return int(np.searchsorted(mugrid.EDGES, mu)) - 1


def log_ratio(log_likelihood: FloatArray, low: float, high: float) -> float:
    """Return ln p(low)/p(high) [nat] of one log-likelihood (1, 32)."""
    return float(log_likelihood[0, bin_of(low)] - log_likelihood[0, bin_of(high)])


def test_a_value_is_evidence_that_almost_all_grip_was_used() -> None:
    weighed = weigh_by_use(WIDE_VALUE, np.array([0.3]))
    gained = log_ratio(weighed, 0.3, 0.9) - log_ratio(WIDE_VALUE, 0.3, 0.9)
    assert gained == pytest.approx(-np.log(EXCITED_SHARE), abs=0.02)


def test_evidence_of_a_value_is_limited_and_does_not_lower_the_grip_used() -> None:
    for used in (0.05, 0.3, 0.6, 1.1):
        added = (weigh_by_use(WIDE_VALUE, np.array([used])) - WIDE_VALUE)[0]
        assert np.ptp(added) <= -np.log(EXCITED_SHARE) + 1e-12
        assert np.allclose(added[used >= mugrid.CENTRES], 0.0)
        assert np.all(np.diff(added) <= 1e-12)


def test_gentle_use_does_not_change_ratios_of_higher_frictions() -> None:
    weighed = weigh_by_use(WIDE_VALUE, np.array([0.05]))
    assert log_ratio(weighed, 0.3, 0.9) == pytest.approx(log_ratio(WIDE_VALUE, 0.3, 0.9))


@pytest.mark.parametrize("fall", [0.0, 0.8 * VALUE_NATS])
@pytest.mark.parametrize("used", [0.05, 0.3, 0.6])
def test_a_bound_stays_a_bound(fall: float, used: float) -> None:
    slope = fall * (mugrid.CENTRES - mugrid.LOWER)
    bound = np.where(used > mugrid.CENTRES, -8.0, -slope)[None]
    weighed = weigh_by_use(bound, np.array([used]))[0]
    assert weighed[-1] > weighed.max() - VALUE_NATS


def test_a_bound_states_that_not_all_grip_was_used() -> None:
    bound = np.where(mugrid.CENTRES < 0.5, -8.0, 0.0)[None]
    weighed = weigh_by_use(bound, np.array([0.5]))
    assert log_ratio(weighed, 0.52, 1.0) < -0.5
    assert log_ratio(weighed, 0.65, 1.0) == pytest.approx(0.0, abs=0.2)
    assert log_ratio(weighed, 0.85, 1.0) == 0.0


def test_visit_without_information_has_a_flat_likelihood() -> None:
    flat = np.zeros((1, mugrid.BINS))
    assert np.array_equal(weigh_by_use(flat, np.array([0.5])), flat)


def test_unknown_grip_used_changes_no_belief() -> None:
    assert np.array_equal(weigh_by_use(WIDE_VALUE, np.array([np.nan])), WIDE_VALUE)
