"""Tests of the description of reported friction values: it contains the values that vehicles sent,
without the corrections that the service makes before it uses them.
"""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest

from fleet_service.fusion import Fusion, constants
from fleet_service.fusion.likelihoods import make_evidence
from fleet_service.fusion.reported import as_reported
from schemas import mugrid
from tests.fleet_service.examples import CELL, observations, value


def encode_value(mu: float, std: float = 0.05) -> np.ndarray:
    """Return the encoded log-likelihood (1, 32) of a measurement `mu` of friction with standard
    deviation `std`.
    """
    return mugrid.encode_log_likelihood(-0.5 * np.square((mugrid.CENTRES - mu) / std))[None]


def test_value_is_described_as_reported_and_a_bound_is_not() -> None:
    steps, reported = as_reported(
        np.vstack(
            [encode_value(0.85), np.minimum(encode_value(0.3), 200) + 7, 0 * encode_value(0.3)]
        )
    )
    np.testing.assert_array_equal(steps[0], encode_value(0.85)[0])
    assert steps[1].min() == 0
    assert reported[:2, 0] == pytest.approx([0.85, 0.3], abs=0.01)
    assert reported[0, 1] == pytest.approx(
        np.hypot(0.05, np.hypot(constants.BIAS_RELATIVE * 0.85, constants.BIAS_ABSOLUTE)), rel=0.02
    )
    assert reported[:2, 2] == pytest.approx([0.0, 0.97], abs=0.03)
    assert np.isnan(reported[2]).all()


def test_liar_is_compared_with_reported_values_not_with_used_parts() -> None:
    rng = np.random.default_rng(2)
    fusion = Fusion(120.0)
    n = 1200
    who = rng.integers(0, 12, n)
    reading = np.where(who == 0, 0.25, 0.85 + 0.04 * rng.normal(size=n))
    steps = mugrid.encode_log_likelihood(value(reading))
    used = np.where(who == 0, 0.25, 0.5).astype(np.float32)
    evidence_, reported = make_evidence(
        {"log_likelihood": steps, "mu_utilised": used}, np.ones(n, bool)
    )
    o = observations(np.arange(n) * 1.0, who, value(reading))
    o = dataclasses.replace(
        o, cell=CELL + np.arange(n) // 30, evidence=evidence_, reported=reported, used=used
    )
    fusion.update(o)
    assert fusion.trust(0) < 0.2 < 0.8 < fusion.trust(1)
