"""Tests of lower bounds. Vehicles that use little grip measure only a lower bound of friction.
However many such reports arrive, and in any order, the lower end of a cell's friction interval must
not exceed u + UTILISED_STD. Here u is the largest grip that any vehicle used, and UTILISED_STD is
the error of a reported grip.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from fleet_service.fusion import Fusion, constants
from fleet_service.fusion.likelihoods import bound_by_used, level_above_used
from fleet_service.lab import situations
from schemas import mugrid
from tests.fleet_service.examples import at_least, belief, interval, observations

PATHS = ("protobuf posterior", "json posterior", "protobuf likelihood", "json likelihood")


@pytest.mark.parametrize("path", PATHS)
@settings(max_examples=6)
# From .54 the posterior of .9 counts as a measured value, not as a bound.
@given(st.floats(0.0, 0.53))
def test_a_hundred_vehicles_are_no_more_than_one_by_every_path(path: str, used: float) -> None:
    assert situations.bound_excess(used, path) <= constants.UTILISED_STD


@settings(max_examples=15)
@given(st.floats(0.1, 0.9), st.integers(1, 400))
def test_any_number_of_bounds_leaves_belief_flat_above_the_grip_used(
    used: float, vehicles: int
) -> None:
    fusion = Fusion(120.0)
    o = observations(
        np.arange(vehicles) * 2.0, np.arange(vehicles), at_least(np.full(vehicles, used))
    )
    fusion.update(replace(o, evidence=level_above_used(o.evidence, np.full(vehicles, used))))
    lower, upper = interval(belief(fusion))
    assert lower <= max(used, interval(mugrid.PRIOR)[0]) + constants.UTILISED_STD
    assert upper >= interval(mugrid.PRIOR)[1] - 0.02


@settings(max_examples=15)
@given(st.floats(0.1, 0.9), st.integers(1, 200))
def test_grip_used_counts_where_a_contradicted_estimator_reports_nothing(
    used: float, vehicles: int
) -> None:
    flat = np.zeros((vehicles, mugrid.BINS))
    o = observations(np.arange(vehicles) * 2.0, np.arange(vehicles), flat)
    fusion = Fusion(120.0)
    fusion.update(replace(o, evidence=bound_by_used(o.evidence, np.full(vehicles, used))))
    lower, upper = interval(belief(fusion))
    assert lower <= max(used, interval(mugrid.PRIOR)[0]) + constants.UTILISED_STD
    assert upper >= interval(mugrid.PRIOR)[1] - 0.02
    if vehicles >= 10:
        assert lower >= used - 0.15


def test_value_below_the_grip_used_is_replaced_by_it() -> None:
    value = mugrid.encode_log_likelihood(-0.5 * np.square((mugrid.CENTRES - 0.6) / 0.05))[None]
    assert mugrid.CENTRES[np.argmin(bound_by_used(value, np.array([0.8]))[0])] > 0.65
    assert np.array_equal(bound_by_used(value, np.array([np.nan])), value)
    assert np.array_equal(bound_by_used(value, np.array([0.1])), value)
