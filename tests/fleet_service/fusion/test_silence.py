"""Tests of visits (passages of a cell) in which a vehicle measured no friction. They weaken a
belief of ice, but never prove grip. If they used much grip, they weaken values little above it.
"""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest

from fleet_service.fusion import Fusion, constants
from fleet_service.fusion.likelihoods import at_least as normal_bound
from fleet_service.fusion.likelihoods import states_more_grip
from fleet_service.fusion.store.records import USED
from fleet_service.fusion.votes import note_silent_use
from schemas import mugrid
from schemas.numeric import FloatArray
from tests.fleet_service.examples import at_least, belief, interval, observations, slippery, value

QUIET = 40
UNKNOWN = float(mugrid.SLIPPERY_SHARE @ mugrid.PRIOR)


def visited(noticed: FloatArray, *, limited: bool = False) -> Fusion:
    """Return a fusion (beliefs about friction) after visits (passages) of one cell, a minute apart.
    First, vehicles report the friction values `noticed`. Then QUIET other vehicles use a grip of
    0.05, which is too little to measure friction; `limited` is the flag of their slip controller.
    """
    fusion = Fusion(120.0)
    n = len(noticed)
    if n:
        fusion.update(observations(60.0 * np.arange(n), np.arange(n), value(noticed, 0.03)))
    quiet = observations(
        60.0 * (n + np.arange(QUIET)), 100 + np.arange(QUIET), at_least(np.full(QUIET, 0.05))
    )
    fusion.update(dataclasses.replace(quiet, limited=np.full(QUIET, limited)))
    return fusion


def test_many_visits_without_grip_demand_leave_ice_undecided() -> None:
    before = Fusion(120.0)
    before.update(observations(60.0 * np.arange(8), np.arange(8), value(np.full(8, 0.15), 0.03)))
    assert slippery(belief(before)) > 0.95
    assert constants.UNSURE < slippery(belief(visited(np.full(8, 0.15)))) < 0.65


def test_quiet_visits_raise_no_lower_bound_above_their_use() -> None:
    lower, upper = interval(belief(visited(np.full(8, 0.15))))
    assert lower < 0.15
    assert upper > 0.9


def test_few_quiet_visits_do_not_end_ice_that_most_visitors_noticed() -> None:
    fusion = Fusion(120.0)
    fusion.update(observations(60.0 * np.arange(8), np.arange(8), value(np.full(8, 0.15), 0.03)))
    fusion.update(observations([500.0, 560.0], [100, 101], at_least(np.full(2, 0.05))))
    assert slippery(belief(fusion)) > 0.9


def test_a_working_controller_is_no_silence() -> None:
    assert slippery(belief(visited(np.full(8, 0.15), limited=True))) > 0.8


@pytest.mark.parametrize("noticed", [np.zeros(0), np.full(8, 0.8)], ids=["nobody", "grip"])
def test_road_without_ice_is_not_called_slippery_by_silence(noticed: FloatArray) -> None:
    assert slippery(belief(visited(noticed))) <= UNKNOWN + 1e-6 < constants.UNSURE


def disputed_cell(values: int, silent: int, *, used: float = 0.5, states: bool = True) -> Fusion:
    """Return a fusion after visits to one cell, a minute apart. First, `values` vehicles report the
    friction .57. Then `silent` other vehicles use the grip `used` and report no value. If `states`,
    they state that this was not all of the road's grip.
    """
    fusion = Fusion(120.0)
    n = values + silent
    likelihoods = np.concatenate(
        [value(np.full(values, 0.57), 0.08), at_least(np.full(silent, used))]
    )
    visits = observations(60.0 * np.arange(n), np.arange(n), likelihoods)
    limited = np.full(n, -int(states), np.int8)
    fusion.update(dataclasses.replace(visits, used=np.full(n, used, np.float32), limited=limited))
    return fusion


def median_friction(fusion: Fusion) -> float:
    """Return the median of the friction in the tests' cell."""
    return float(mugrid.quantiles(belief(fusion), 0.5))


def test_many_silent_visits_with_much_grip_outweigh_few_low_values() -> None:
    dry = disputed_cell(3, 20)
    assert median_friction(dry) > median_friction(disputed_cell(3, 0)) + 0.06
    assert interval(belief(dry))[0] < 0.6


def test_few_silent_visits_do_not_outweigh_many_values() -> None:
    assert median_friction(disputed_cell(12, 3)) == pytest.approx(
        median_friction(disputed_cell(12, 0)), abs=0.04
    )


def test_silent_visits_with_little_grip_do_not_change_values() -> None:
    assert median_friction(disputed_cell(3, 20, used=0.2)) == pytest.approx(
        median_friction(disputed_cell(3, 0)), abs=0.06
    )


@pytest.mark.parametrize("used", [0.0, 0.3, 0.36, 0.6, 1.2, 2.0])
def test_silent_use_never_changes_the_probability_of_slippery_road(used: float) -> None:
    rng = np.random.default_rng(3)
    for p in rng.dirichlet(np.ones(mugrid.BINS), 20):
        noted = p.copy()
        note_silent_use(noted, round(used * USED), 0.7)
        assert np.all(noted >= 0.0)
        assert slippery(noted) == pytest.approx(slippery(p), abs=1e-12)


def test_silent_visits_alone_raise_no_lower_bound() -> None:
    silent, others = (belief(disputed_cell(0, 40, states=flag)) for flag in (True, False))
    assert np.array_equal(silent, others)


def test_silence_of_vehicles_without_values_does_not_change_values() -> None:
    others = disputed_cell(3, 20, states=False)
    assert median_friction(others) == pytest.approx(median_friction(disputed_cell(3, 0)), abs=0.04)


def test_only_a_slope_above_the_grip_used_states_more_grip() -> None:
    used = np.full(5, 0.5)
    step = at_least([0.5])[0]
    gentle = step + 0.4 * (mugrid.CENTRES - mugrid.UPPER)
    steep = step + np.where(mugrid.CENTRES < 0.6, -0.8, 0.0)
    low = value([0.3], 0.05)[0]
    plain = normal_bound(np.array([0.5]))[0]
    sent = mugrid.encode_log_likelihood(np.stack([step, gentle, steep, low, plain]))
    columns = {"log_likelihood": sent, "with_likelihood": np.ones(5, np.bool_)}
    assert states_more_grip(columns, used).tolist() == [False, False, True, False, False]
    columns["with_likelihood"] = np.zeros(5, np.bool_)
    assert not states_more_grip(columns, used).any()


@pytest.mark.parametrize("mu", [0.5, 0.6, 0.7])
def test_fleet_with_few_values_causes_no_false_grip(mu: float) -> None:
    """All vehicles of another make use almost all of the grip, a tenth of them give a value, and
    none states more grip. The lower end of the interval must not exceed the true friction.
    """
    rng = np.random.default_rng(1)
    n = 60
    for _ in range(5):
        used = 0.95 * mu * (1.0 + 0.03 * rng.standard_normal(n))
        reading = np.maximum(mu * (1.0 + 0.08 * rng.standard_normal(n)), used)
        gives_value = rng.random(n) < 0.1
        likelihoods = np.where(gives_value[:, None], value(reading, 0.08 * mu), at_least(used))
        visits = observations(60.0 * np.arange(n), np.arange(n), likelihoods)
        fusion = Fusion(120.0)
        fusion.update(dataclasses.replace(visits, used=used.astype(np.float32)))
        assert interval(belief(fusion))[0] < mu
