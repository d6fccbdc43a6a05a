"""Tests of visits (passages of a cell) with an uncertain position: the report counts less in the
reported cell, and in no other.
"""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from fleet_service.fusion import Fusion, constants, space
from fleet_service.serve.alerts import Alerts
from schemas import grid, mugrid
from schemas.numeric import FloatArray
from tests.fleet_service.examples import CELL, LATITUDE, at_least, belief, observations, value

WIDTH_M = 10.2  # [m] width of a cell at LATITUDE


def weight(std: float, yaw: float = 0.0) -> float:
    return float(space.position_weights(np.array([LATITUDE]), np.array([yaw]), np.array([std]))[0])


def information(p: FloatArray) -> float:
    """Return the information that a belief `p` (32,) has gained over the prior [nat]."""
    return float(np.sum(p * np.log(np.maximum(p, 1e-300) * mugrid.BINS)))


@given(st.floats(0.01, 100.0), st.floats(1.0, 40.0))
def test_share_of_the_cell_is_a_probability_and_falls_with_the_error(
    std: float, length: float
) -> None:
    better, worse = space.own_share(np.array([std, 1.5 * std]), np.full(2, length))
    assert 0.0 <= worse < better <= 1.0


def test_share_matches_simulated_visits_with_normal_position_error() -> None:
    rng = np.random.default_rng(1)
    for std in (3.0, 8.0, 40.0):
        at = np.floor(
            (rng.uniform(0.0, WIDTH_M, 200_000) + std * rng.normal(size=200_000)) / WIDTH_M
        )
        found = space.own_share(np.array([std]), np.array([WIDTH_M]))[0]
        assert found == pytest.approx(np.mean(at == 0), abs=0.005)


def test_good_or_unknown_position_has_full_weight_and_a_poor_one_less() -> None:
    assert weight(1.5) == weight(np.nan) == weight(0.0) == 1.0
    share = space.own_share(np.array([20.0]), np.array([WIDTH_M]))[0]
    assert weight(20.0) == pytest.approx(share / (1.0 - constants.CONTAMINATION), rel=0.01)
    assert weight(20.0, np.nan) == weight(20.0)
    # A cell is longer along its diagonal.
    assert weight(20.0, np.pi / 4) > weight(20.0)


@given(st.floats(0.1, 60.0), st.floats(0.1, 1.1), st.floats(0.03, 0.3))
def test_poor_position_teaches_no_more_than_a_good_one(std: float, mu: float, width: float) -> None:
    sure = Fusion(120.0)
    unsure = Fusion(120.0)
    o = observations([0.0], [1], value([mu], width))
    sure.update(o)
    unsure.update(dataclasses.replace(o, share=np.full(1, weight(std), np.float32)))
    # Tolerance: probabilities are rounded to 16 bits.
    assert information(belief(unsure)) <= information(belief(sure)) + 2e-3


def test_only_the_reported_cell_learns_and_is_visited() -> None:
    fusion = Fusion(120.0)
    o = observations([0.0], [1], value([0.2]))
    fusion.update(dataclasses.replace(o, share=np.full(1, 0.5, np.float32)))
    assert fusion.cell.tolist() == [CELL]
    assert fusion.live.vehicles[:1].tolist() == fusion.live.visits[:1].tolist() == [1]
    # A new vehicle's weight is 0.75.
    assert fusion.live.values[0] == pytest.approx(0.75 * 0.5, rel=1e-5)


def test_ice_is_not_blurred_over_road_where_vehicles_gave_no_values() -> None:
    rng = np.random.default_rng(7)
    place = rng.permutation(np.repeat(np.arange(12), 60))
    n = len(place)
    icy = place < 6
    std = 6.0
    reports = np.where(icy[:, None], value(np.full(n, 0.15), 0.03), at_least(np.full(n, 0.15)))
    found = place + np.floor(rng.random(n) + std / WIDTH_M * rng.normal(size=n)).astype(int)
    x, y = grid.deinterleave(CELL)
    o = dataclasses.replace(
        observations(30.0 * np.arange(n), np.arange(n) % 40, reports),
        cell=grid.interleave(x + found, y),
        share=np.full(n, weight(std), np.float32),
    )
    fusion = Fusion(120.0)
    fusion.update(o)
    slots = fusion.slots_of(grid.interleave(x + np.arange(12), y), np.zeros(12, np.int64))
    p = fusion.beliefs(slots, int(o.time.max())) @ mugrid.SLIPPERY_SHARE
    assert (p[:6] > 0.9).all()
    assert (p[7:] < 0.5).all()


def drive_inaccurately(mu: dict[int, float]) -> tuple[Fusion, bool]:
    """Let 12 vehicles pass three cells three times. Each measures its friction `mu` (number of the
    vehicle: friction), with a position error of 15 m. Return the fusion, and True if there was an
    alert.
    """
    fusion = Fusion(120.0, enrolled=True)
    alerts = Alerts(fusion)
    was_raised = False
    x, y = grid.deinterleave(CELL)
    for k in range(36):
        row = int(grid.interleave(x + k % 3, y))
        o = observations([40.0 * k], [k // 3], value([mu[k // 3]]), cell=row)
        o = dataclasses.replace(o, share=np.full(1, weight(15.0), np.float32))
        was_raised |= any(alert.raised for alert in alerts.update(fusion.update(o).slots))
    fusion.update(observations([2000.0, 2100.0], [50, 50], value([0.8, 0.8]), cell=CELL + 4000))
    return fusion, was_raised


def test_vehicles_with_poor_positions_find_ice_and_raise_no_alert_on_grip() -> None:
    assert drive_inaccurately(dict.fromkeys(range(12), 0.15))[1]
    assert not drive_inaccurately(dict.fromkeys(range(12), 0.8))[1]


def test_wrong_values_cost_trust_also_with_poor_positions() -> None:
    fusion, was_raised = drive_inaccurately(dict.fromkeys(range(12), 0.8) | {4: 0.15})
    assert not was_raised
    assert fusion.trust(4) < 0.5 < 0.8 < fusion.trust(7)
