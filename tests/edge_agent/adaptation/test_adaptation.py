"""Tests of the fuzzy adaptation. The measurement noise R must grow within its bounds when
innovations (measurement minus prediction) are too large, and invalid rule tables must be refused.
"""

from __future__ import annotations

import json
from typing import Any

import numpy as np
import pytest

from edge_agent.adaptation.fuzzy import LARGEST_FACTOR, LEAST_FACTOR, adapted_factor, infer_step
from edge_agent.adaptation.memberships import Memberships
from schemas.errors import InputError

SETS = Memberships()
INPUTS = np.array(SETS.inputs)
OUTPUTS = np.array(SETS.outputs)


def test_peak_of_a_fuzzy_set_gives_exactly_its_output() -> None:
    for peak, output in zip(INPUTS, OUTPUTS, strict=True):
        assert infer_step(float(peak), INPUTS, OUTPUTS) == pytest.approx(float(output))


def test_inference_rises_with_the_mismatch_and_covers_its_whole_range() -> None:
    reported = [infer_step(float(x), INPUTS, OUTPUTS) for x in np.linspace(-1.0, 50.0, 2000)]
    assert (np.diff(reported) >= 0).all()


def test_noise_grows_where_innovations_exceed_their_theory() -> None:
    assert adapted_factor(1.0, 3.0, 1.0, INPUTS, OUTPUTS) > 1.0
    assert adapted_factor(1.0, 1.0, 1.0, INPUTS, OUTPUTS) == 1.0
    assert adapted_factor(2.0, 0.2, 1.0, INPUTS, OUTPUTS) < 2.0


def test_noise_factor_stays_in_bounds_during_a_long_mismatch() -> None:
    high = 1.0
    low = 1.0
    for _ in range(1000):
        high = adapted_factor(high, 100.0, 1.0, INPUTS, OUTPUTS)
        low = adapted_factor(low, 0.0, 1.0, INPUTS, OUTPUTS)
    assert high == LARGEST_FACTOR
    assert low == LEAST_FACTOR


def test_zero_theoretical_variance_keeps_the_factor() -> None:
    assert adapted_factor(2.0, 1.0, 0.0, INPUTS, OUTPUTS) == 2.0


def test_memberships_survive_vector_and_json() -> None:
    sets = Memberships(ln_scales=(0.2, -0.3))
    assert Memberships.from_vector(sets.to_vector()) == sets
    assert Memberships.from_json(json.loads(json.dumps(sets.to_json()))) == sets


def test_a_file_from_before_the_rules_has_the_untuned_ones() -> None:
    old = {name: list(getattr(SETS, name)) for name in ("inputs", "outputs", "ln_scales")}
    assert Memberships.from_json(old) == Memberships.from_vector(SETS.to_vector()[:12]) == SETS


def test_file_older_than_the_consistency_test_keeps_its_valid_entries() -> None:
    old = SETS.to_json() | {"stretched": [14.0, 22.0], "far": [1.5, 4.0]}
    assert Memberships.from_json(old) == SETS


def test_every_vector_within_the_bounds_is_a_valid_set_of_memberships() -> None:
    lower, upper = Memberships.bounds()
    rng = np.random.default_rng(6)
    for share in rng.uniform(size=(200, len(lower))):
        Memberships.from_vector(lower + share * (upper - lower))
    assert ((SETS.to_vector() >= lower) & (SETS.to_vector() <= upper)).all()


@pytest.mark.parametrize(
    ("change", "field"),
    [
        ({"inputs": (0.0, -0.4, 0.1, 1.0, 4.0)}, "inputs"),
        ({"inputs": (-0.8, -0.4, 0.0, 1.0)}, "inputs"),
        ({"outputs": (0.1, 0.0, 0.0, 0.0, -0.1)}, "outputs"),
        ({"outputs": (-0.1, 0.0, 0.0, 0.0, float("nan"))}, "outputs"),
        ({"outputs": (0.01, 0.02, 0.03, 0.04, 0.05)}, "outputs"),
        ({"ln_scales": (9.0, 0.0)}, "ln_scales"),
        ({"shares": (0.1,) * 12}, "shares"),
        ({"strained": (-9.0, 0.0)}, "strained"),
    ],
)
def test_impossible_memberships_are_refused_by_name(change: dict[str, Any], field: str) -> None:
    with pytest.raises(InputError, match=field):
        Memberships(**change)


@pytest.mark.parametrize("document", [None, [], {"inputs": "wide"}, {}])
def test_a_document_that_is_no_memberships_is_refused(document: object) -> None:
    with pytest.raises(InputError, match="memberships"):
        Memberships.from_json(document)
