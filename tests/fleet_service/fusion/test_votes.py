"""Tests of votes (effects of single visits) on the belief about a cell. Visits of several vehicles
must have more effect than the same number of visits of one vehicle. A change of the road must be
believed after few visits. A vehicle that always disagrees with others must lose its influence.
"""

from __future__ import annotations

import dataclasses
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numpy.typing import NDArray

from fleet_service.fusion import Fusion, constants
from fleet_service.fusion.fuse import RecordedResult
from fleet_service.fusion.likelihoods import level_above_used, make_evidence
from schemas import mugrid
from tests.fleet_service.examples import (
    START,
    at_least,
    belief,
    interval,
    observations,
    posterior_evidence,
    slippery,
    value,
)

PRIOR_LOWER, PRIOR_UPPER = interval(mugrid.PRIOR)


def width(fusion: Fusion) -> float:
    lower, upper = interval(belief(fusion))
    return upper - lower


def test_five_vehicles_narrow_a_cell_more_than_fifty_visits_of_one() -> None:
    rng = np.random.default_rng(1)
    one = Fusion(120.0)
    five = Fusion(120.0)
    for visit in range(50):
        one.update(observations([30.0 * visit], [1], value(0.8 + 0.03 * rng.normal(size=1))))
    for vehicle in range(5):
        five.update(
            observations([300.0 * vehicle], [vehicle], value(0.8 + 0.05 * rng.normal(size=1)))
        )
    assert width(five) < 0.8 * width(one)
    assert one.live.vehicles[0] == 1
    assert five.live.vehicles[0] == 5


@pytest.mark.parametrize("used", [0.1, 0.3, 0.5])
def test_any_number_of_unexcited_vehicles_keeps_the_priors_upper_end(used: float) -> None:
    fusion = Fusion(120.0)
    n = 200
    fusion.update(observations(np.arange(n) * 5.0, np.arange(n), at_least(np.full(n, used))))
    lower, upper = interval(belief(fusion))
    assert upper >= PRIOR_UPPER - 0.02
    assert lower > PRIOR_LOWER
    assert slippery(belief(fusion)) < 0.31


def test_fifty_bounds_that_fall_by_half_a_nat_are_noise() -> None:
    fusion = Fusion(120.0)
    sloping = np.tile(-0.5 * np.linspace(0.0, 1.0, 32), (50, 1))
    fusion.update(observations(np.arange(50.0), np.arange(50), sloping))
    np.testing.assert_allclose(belief(fusion), mugrid.PRIOR, atol=1e-6)


def test_a_larger_fall_of_a_bound_is_evidence_against_high_friction_only() -> None:
    bound = at_least(np.full(5, 0.2))
    flat = Fusion(120.0)
    fallen = Fusion(120.0)
    for fusion, fall in ((flat, 0.0), (fallen, 0.9)):
        falling = bound - np.where(mugrid.CENTRES > 0.5, fall, 0.0)
        fusion.update(observations(5.0 * np.arange(5), np.arange(5), falling))
    assert slippery(belief(fallen)) > slippery(belief(flat)) + 0.1
    assert interval(belief(fallen))[0] <= interval(belief(flat))[0]


def test_few_passes_suffice_for_ice_after_vehicles_reported_dry() -> None:
    fusion = Fusion(120.0)
    fusion.update(observations(np.arange(10) * 20.0, np.arange(10), value(np.full(10, 0.85))))
    assert slippery(belief(fusion)) < 0.01
    for passes in range(1, 7):
        fusion.update(observations([300.0 + 20.0 * passes], [passes], value([0.2])))
        if slippery(belief(fusion)) > 0.9:
            break
    assert passes <= 4


def test_a_repeated_value_hardly_counts_and_a_changed_one_counts_whole() -> None:
    same = Fusion(120.0)
    changed = Fusion(120.0)
    for fusion, second in ((same, 0.8), (changed, 0.3)):
        fusion.update(observations([0.0, 30.0], [1, 1], value([0.8, second])))
    assert same.live.values[0] < 0.77
    assert changed.live.values[0] == pytest.approx(1.5)


def test_a_vehicle_that_always_disagrees_loses_its_vote() -> None:
    rng = np.random.default_rng(2)
    fusion = Fusion(120.0)
    for cell in range(30):
        for place, vehicle in enumerate(rng.permutation([1, 2, 3, 4, 5, 99])):
            mu = 0.25 if vehicle == 99 else 0.8 + 0.05 * rng.normal()
            fusion.update(observations([cell * 20.0 + place], [vehicle], value([mu]), cell=cell))
    fusion.update(observations([2000.0], [1], value([0.8]), cell=99))
    assert fusion.trust(99) < 0.1
    assert min(fusion.trust(v) for v in (1, 2, 3, 4, 5)) > 0.9
    assert 0.5 < fusion.trust(12345) < 0.9


def test_unconfirmed_belief_fades_to_the_prior() -> None:
    fusion = Fusion(120.0)
    fusion.update(observations(np.arange(8) * 10.0, np.arange(8), value(np.full(8, 0.3))))
    widths = [
        np.subtract(*interval(belief(fusion, now=START + int(h * 3600e9)))[::-1])
        for h in (0.1, 1, 4, 24)
    ]
    assert widths == sorted(widths)
    assert widths[-1] == pytest.approx(PRIOR_UPPER - PRIOR_LOWER, abs=0.01)


def test_a_heading_near_a_sectors_edge_votes_in_both() -> None:
    fusion = Fusion(120.0)
    fusion.update(observations([0.0], [1], value([0.5]), second=1))
    np.testing.assert_array_equal(belief(fusion, sector=0), belief(fusion, sector=1))
    assert fusion.size == 2


def test_a_posterior_is_a_value_where_grip_was_used_and_else_a_bound() -> None:
    excited = posterior_evidence(0.5, 0.4, 0.6, used=0.31)
    unexcited = posterior_evidence(0.5, 0.4, 0.6, used=0.29)
    assert mugrid.CENTRES[excited.argmax()] == pytest.approx(0.5, abs=0.03)
    assert excited[-1] < -10
    assert unexcited[-1] == 0.0
    assert (np.diff(unexcited) >= 0).all()


def test_posterior_without_values_contains_no_evidence() -> None:
    nan = float("nan")
    assert not posterior_evidence(nan, nan, nan, nan).any()
    assert not posterior_evidence(0.5, nan, nan, nan).any()
    assert posterior_evidence(0.5, nan, nan, 0.45)[-1] < -1


@given(st.lists(st.integers(0, 255), min_size=32, max_size=32), st.floats(0.0, 1.3))
def test_bound_excludes_no_friction_just_above_the_grip_used(steps: list[int], used: float) -> None:
    sent = np.array([steps], np.uint8) - np.uint8(min(steps))
    found = level_above_used(sent, np.array([used], np.float32))
    if sent[0, -1] >= constants.VALUE_DROP_STEPS:
        np.testing.assert_array_equal(found, sent)
    else:
        above = found[0, np.float32(used) <= mugrid.CENTRES]
        last = len(above) - int(np.argmin(above[::-1])) if len(above) else 0
        assert not above[:last].any()
        assert (found <= sent).all()


def test_upward_slopes_of_many_unexcited_visits_make_no_value() -> None:
    n = 60
    sloping = mugrid.encode_log_likelihood(np.tile(np.linspace(-2.0, 0.0, 32), (n, 1)))
    columns: dict[str, NDArray[Any]] = {
        "log_likelihood": sloping,
        "mu_utilised": np.full(n, 0.2, np.float32),
    }
    fusion = Fusion(120.0)
    o = observations(np.arange(n) * 2.0, np.arange(n), value(np.full(n, 0.5)))
    fusion.update(dataclasses.replace(o, evidence=make_evidence(columns, np.full(n, True)).steps))
    lower, upper = interval(belief(fusion))
    assert lower < 0.3
    assert upper == pytest.approx(PRIOR_UPPER, abs=0.03)


def test_flood_of_one_vehicle_is_bounded_and_reported_as_not_fused() -> None:
    fusion = Fusion(120.0)
    n = 500
    rng = np.random.default_rng(2)
    o = observations(60.0 * rng.random(n), np.full(n, 7), value(rng.uniform(0.1, 1.1, n)))
    updated = [fusion.update(o.take(part)) for part in np.array_split(np.arange(n), 10)]
    assert fusion.waiting == constants.WAITING_MOST == n - sum(int(f.late.sum()) for f in updated)
    fusion.update(observations([70.0], [8], value([0.5])))
    assert fusion.waiting == constants.WAITING_MOST + 1
    again = Fusion(120.0)
    recorded = (
        np.concatenate(of)
        for of in zip(*((f.late, f.late_by, f.weight) for f in updated), strict=True)
    )
    again.update(o, RecordedResult(*recorded))
    again.update(observations([70.0], [8], value([0.5])))
    np.testing.assert_array_equal(belief(again), belief(fusion))
