"""Tests of the flags by which vehicles report that their slip controller acted. A flag may support
an alert if the vehicle's earlier flags agreed with friction values of other vehicles. It changes
the belief only if the report contains neither a likelihood nor a value.
"""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest

from fleet_service.fusion import Fusion, Observations, observations_of
from fleet_service.fusion.likelihoods import find_limited
from fleet_service.fusion.store.records import Side
from fleet_service.serve.alerts import Alerts
from schemas import mugrid
from schemas.numeric import BoolArray, FloatArray
from tests.fleet_service.examples import (
    CELL,
    LATITUDE,
    REGION,
    START,
    at_least,
    belief,
    observations,
    slippery,
    value,
)

ICY = 0.15
FLAGGED = 1  # number of the vehicle with a working slip controller


def flags(o: Observations, limited: BoolArray, used: FloatArray) -> Observations:
    return dataclasses.replace(o, limited=limited.astype(np.int8), used=used.astype(np.float32))


def make_acquainted(claims_on_dry: bool) -> Fusion:
    """Return a fusion (beliefs about all cells) after 30 minutes in which vehicles visited dry
    cells.

    The vehicle FLAGGED brakes gently in every second visit; with `claims_on_dry`, its slip
    controller's flag is then on. In its other visits it reports friction values, so that the fusion
    learns to trust it.
    """
    fusion = Fusion(120.0)
    for minute in range(30):
        who = np.arange(12)
        gentle = (who == FLAGGED) & (minute % 2 == 1)
        dry = np.where(gentle[:, None], at_least(np.full(12, 0.2)), value(np.full(12, 0.8), 0.04))
        o = observations(60.0 * minute + 2.0 * who, who, dry, cell=CELL + 100 + minute % 5)
        fusion.update(flags(o, gentle & claims_on_dry, np.where(gentle, 0.2, 0.7)))
    return fusion


def ice_with(fusion: Fusion, *, flag: bool) -> bool:
    """Let two vehicles visit a cell, and return True if their reports raise an alert. One vehicle
    reports the friction of ice. The vehicle FLAGGED uses little grip, and `flag` is the flag of its
    slip controller.
    """
    who = np.array([3, FLAGGED])
    likelihood = np.concatenate([value(np.array([ICY]), 0.02), at_least(np.array([0.1]))])
    o = observations(np.array([1900.0, 1905.0]), who, likelihood)
    updated = fusion.update(flags(o, np.array([False, flag]), np.array([0.14, 0.1])))
    return any(alert.raised for alert in Alerts(fusion).update(updated.slots))


def test_controller_is_the_second_witness_of_ice() -> None:
    assert ice_with(make_acquainted(claims_on_dry=False), flag=True)
    assert not ice_with(make_acquainted(claims_on_dry=False), flag=False)


def test_flag_that_is_always_on_supports_no_alert() -> None:
    fusion = make_acquainted(claims_on_dry=True)
    assert fusion.vote_weights[-1].heeded.sum() == 11
    assert not ice_with(fusion, flag=True)


def test_flags_alone_raise_no_alert_and_move_no_belief() -> None:
    beliefs = []
    for limited in (False, True):
        fusion = Fusion(120.0)
        who = np.arange(8)
        o = observations(10.0 * who, who, at_least(np.full(8, 0.1)))
        updated = fusion.update(flags(o, np.full(8, limited), np.full(8, 0.1)))
        assert not Alerts(fusion).update(updated.slots)
        assert (fusion.sources(updated.slots, Side.ICE, 0) > 0).any() == limited
        beliefs.append(belief(fusion))
    assert np.array_equal(beliefs[0], beliefs[1])


def test_value_of_grip_is_not_overruled_by_its_own_flag() -> None:
    fusion = Fusion(120.0)
    o = observations(np.zeros(1), np.zeros(1, np.int64), value(np.array([0.8]), 0.04))
    updated = fusion.update(flags(o, np.array([True]), np.array([0.2])))
    assert not (fusion.sources(updated.slots, Side.ICE, 0) > 0).any()


@pytest.mark.parametrize(
    ("abs_active", "used", "limited"),
    [(1, 0.15, True), (0, 0.15, False), (-1, 0.15, False), (1, 0.38, False), (1, 0.9, False)],
)
def test_only_an_intervention_at_little_grip_counts(
    abs_active: int, used: float, limited: bool
) -> None:
    columns = {"abs_active": np.array([abs_active], np.int8)}
    assert find_limited(columns, np.array([used])).tolist() == [limited]


def test_unknown_use_is_no_intervention_at_little_grip() -> None:
    assert not find_limited({"esc_active": np.ones(1, np.int8)}, np.array([np.nan])).any()
    assert not find_limited({}, np.array([0.1])).any()


def slides(
    vehicle: int, seconds: float, *, active: bool = True, mu: float = np.nan
) -> Observations:
    """Return one observation of a vehicle that sends no likelihood: it used a grip of .12, and
    `active` is the flag of its ABS. `mu` is the friction that it measured; NaN if it measured none.
    """
    numbers = {
        "leave_time": START + int(seconds * 1e9),
        "cell": CELL,
        "sector": 0,
        "boot": vehicle + 1,
        "region": REGION,
        "seq": int(seconds) + 1,
        "row": 0,
    }
    floats = {
        "latitude": LATITUDE,
        "yaw": 0.0,
        "position_std": 1.5,
        "mu": mu,
        "mu_lower": mu - 0.1,
        "mu_upper": mu + 0.1,
        "mu_utilised": 0.12 if np.isnan(mu) else 0.9 * mu,
        "used_longitudinal": np.nan,
        "used_lateral": np.nan,
    }
    columns = {name: np.array([number]) for name, number in (numbers | floats).items()}
    columns["abs_active"] = np.array([active], np.int8)
    columns["log_likelihood"] = np.zeros((1, mugrid.BINS), np.uint8)
    columns["with_likelihood"] = np.array([False])
    return observations_of(columns, np.array([vehicle]))


def raises_alert(parts: list[Observations]) -> bool:
    fusion = Fusion(120.0)
    alerts = Alerts(fusion)
    return any(alert.raised for part in parts for alert in alerts.update(fusion.update(part).slots))


def test_slides_of_vehicles_without_values_raise_an_alert() -> None:
    assert raises_alert([slides(k, 60.0 * k) for k in range(2)])
    assert not raises_alert([slides(k, 60.0 * k, active=False) for k in range(40)])


def test_slides_of_one_vehicle_alone_raise_no_alert() -> None:
    assert not raises_alert([slides(1, 60.0 * k) for k in range(40)])


def test_slides_on_a_road_with_measured_grip_raise_no_alert() -> None:
    gripping = [slides(10 + k, 30.0 * k, mu=0.8, active=False) for k in range(6)]
    assert not raises_alert([*gripping, slides(1, 200.0), slides(2, 260.0)])


def test_slide_limits_friction_from_above_but_not_to_one_number() -> None:
    fusion = Fusion(120.0)
    fusion.update(slides(1, 0.0))
    assert slippery(belief(fusion)) > 0.6
    evidence = slides(1, 0.0).evidence[0]
    near = np.interp([0.13, 0.18], mugrid.CENTRES, evidence / mugrid.STEPS_PER_NAT)
    assert (near < 1.0).all()
