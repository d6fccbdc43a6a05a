"""Tests of two learned properties of vehicles: the weight of a vehicle's reports, and the amount by
which a friction value is too low if the vehicle used little grip.
"""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest

from fleet_service.fusion import Fusion, constants, shared
from fleet_service.fusion.store.records import Side
from fleet_service.fusion.trust import shape_of
from schemas import mugrid
from schemas.numeric import FloatArray
from tests.fleet_service.examples import belief, interval, observations, value

VEHICLES = 30


def make_acquainted(
    slope: float = 0.0, gain_std: float = 0.06, *, gain_in_use: bool = False
) -> Fusion:
    """Return a fusion (beliefs about all cells) after forty minutes of reports about ten cells.

    Args:
        slope: each friction value is too low by `slope` times the unused part of μ.
        gain_std: standard deviation, over the vehicles, of a vehicle's constant relative error.
        gain_in_use: True if the reported used grip also has this relative error.
    """
    rng = np.random.default_rng(5)
    fusion = Fusion(120.0)
    gain = gain_std * rng.normal(size=VEHICLES)
    for minute in range(40):
        n = 60
        who = rng.integers(0, VEHICLES, n)
        cell = rng.integers(0, 10, n)
        share = rng.uniform(0.5, 1.0, n)
        mu = 0.5 + 0.04 * cell
        reading = mu * (1.0 + gain[who] - slope * (1.0 - share)) + 0.04 * rng.normal(size=n)
        used = share * mu * (1.0 + gain[who] * gain_in_use)
        o = observations(
            60.0 * minute + np.sort(rng.uniform(0, 60, n)), who, value(reading, 0.04), cell=cell
        )
        fusion.update(
            dataclasses.replace(o, used=used.astype(np.float32), manoeuvre=np.zeros(n, np.int8))
        )
    return fusion


def learned_slope(fusion: Fusion) -> float:
    return shape_of(fusion.store.peers, fusion.vote_weights[-1].weight).slope


@pytest.mark.parametrize("slope", [0.0, 0.5])
def test_shape_is_found_from_a_vehicle_that_differs_from_itself(slope: float) -> None:
    assert learned_slope(make_acquainted(slope)) == pytest.approx(slope, abs=0.15)


def test_shape_without_observations_is_the_prior() -> None:
    assert learned_slope(Fusion(120.0)) == pytest.approx(constants.SHAPE_PRIOR)


@pytest.mark.parametrize("gain_std", [0.05, 0.1])
def test_gain_error_common_to_value_and_use_is_no_shape(gain_std: float) -> None:
    """The slope is the error of a friction value per unit of unused grip. A gain error multiplies
    all friction values of a vehicle, and its used grip, by the same factor. The fusion must not
    learn a slope from gain errors.

    If it compared different vehicles, values and used grip would be correlated through their gain
    errors, and a regression would find a slope that does not exist. The fusion must therefore
    compare only visits of the same vehicle: the factor is the same in all of them, so it causes no
    difference that looks like a slope.
    """
    assert learned_slope(make_acquainted(0.0, gain_std, gain_in_use=True)) < 0.12


def road_after(slope: float, used: float) -> FloatArray:
    """Return the belief (32 probabilities of μ) about a new cell after three vehicles reported a
    friction of 0.5 and a used grip of `used`. The values of this fleet are too low by `slope` per
    unit of unused μ.
    """
    fusion = make_acquainted(slope)
    o = observations(2500.0 + np.arange(3.0), np.arange(3), value(np.full(3, 0.5)), cell=70)
    fusion.update(dataclasses.replace(o, used=np.full(3, used, np.float32)))
    return belief(fusion, cell=70)


def test_shape_widens_a_gentle_value_upwards_and_lifts_no_lower_end() -> None:
    flat = interval(road_after(0.0, 0.25))
    steep = interval(road_after(0.5, 0.25))
    assert steep[1] > flat[1] + 0.05
    assert steep[0] < flat[0] + 0.02
    hard = interval(road_after(0.5, 0.5))
    assert hard[1] < steep[1] - 0.05


def test_shape_is_the_slope_and_a_doubt() -> None:
    shapes = [shared.Shape(slope, 0.0) for slope in (0.0, 0.11, 0.42, 1.0)]
    assert [shared.SHAPES[shared.shape_class(shape.reader)] for shape in shapes] == [
        0.1,
        0.2,
        0.5,
        0.7,
    ]


def test_doubt_of_an_alarm_ends_once_the_shape_is_known() -> None:
    """Before the service raises an alert, it assumes an additional error for values that vehicles
    measured with little grip. The additional error must become small once the service has learned
    the errors of its fleet.
    """
    unknown = shared.UNKNOWN_SHAPE
    assert unknown.alarm == pytest.approx(0.5, abs=0.01)
    fusion = make_acquainted(0.0)
    known = shape_of(fusion.store.peers, fusion.vote_weights[-1].weight)
    assert known.std < 0.05
    assert known.alarm < known.reader + 0.08 < unknown.alarm - 0.2
    steep = make_acquainted(0.5)
    assert shape_of(steep.store.peers, steep.vote_weights[-1].weight).alarm > 0.5


def test_vehicle_with_a_record_sharpens_a_cell_and_a_newcomer_does_not() -> None:
    widths = []
    for who in (3, 999):
        fusion = make_acquainted()
        fusion.update(observations([2500.0], [who], value([0.6], 0.04), cell=77))
        lower, upper = interval(belief(fusion, cell=77))
        widths.append(upper - lower)
    assert widths[0] < 0.35 < 0.6 < widths[1]


@pytest.mark.parametrize(
    ("used", "tail", "witnesses"),
    [(0.05, -12.0, 1), (0.19, -12.0, 1), (0.19, -4.0, 1), (0.19, -1.0, 0)],
)
def test_ice_below_any_grip_is_evidence_and_a_tail_of_dry_road_is_not(
    used: float, tail: float, witnesses: int
) -> None:
    assert count_witnesses(0.15, used, tail) == witnesses


@pytest.mark.parametrize(("used", "witnesses"), [(0.17, 0), (0.28, 1)])
def test_gentle_value_a_little_below_grip_may_be_a_soft_tyre(used: float, witnesses: int) -> None:
    assert count_witnesses(0.3, used, -12.0) == witnesses


def count_witnesses(mu: float, used: float, tail: float) -> int:
    """Process one vehicle's friction value `mu`, measured while it used the grip `used`; `tail` is
    the log-likelihood [nat] that its report gives to a dry road. Return 1 if the report may support
    an ice alert, otherwise 0.
    """
    fusion = Fusion(120.0)
    tailed = np.maximum(value([mu], 0.03), np.where(mugrid.CENTRES > 0.5, tail, -12.0))
    o = observations([0.0], [1], tailed)
    fusion.update(dataclasses.replace(o, used=np.array([used], np.float32)))
    slot = fusion.slots_of(o.cell, o.sector)
    return int((fusion.sources(slot, Side.ICE, 0)[0] > 0).sum())
