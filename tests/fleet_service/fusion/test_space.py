"""Tests of visits (passages of a cell) with an uncertain position: the report is divided among the
cells that the vehicle may have visited, and counts only once in all.
"""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from fleet_service.fusion import Fusion, space
from fleet_service.serve.alerts import Alerts
from schemas import grid, mugrid
from schemas.numeric import FloatArray, IntArray
from tests.fleet_service.examples import CELL, LATITUDE, observations, value

WIDTH_M = 10.2  # [m] width of a cell at LATITUDE


def spread(std: float, yaw: float = 0.0, cell: int = CELL) -> tuple[IntArray, FloatArray]:
    found = space.other_cells(
        np.array([cell]), np.array([LATITUDE]), np.array([yaw]), np.array([std])
    )
    return found[0][0], found[1][0].astype(float)


def information(p: FloatArray) -> float:
    """Return the information that a belief `p` (32,) has gained over the prior [nat]."""
    return float(np.sum(p * np.log(np.maximum(p, 1e-300) * mugrid.BINS)))


def read_beliefs(fusion: Fusion) -> FloatArray:
    """Return the belief (32 probabilities of friction) of each cell, from reports of this cell
    alone, without its neighbours.
    """
    kept = fusion.live.belief[: fusion.size].astype(float)
    return np.asarray(kept / kept.sum(axis=1, keepdims=True))


@given(st.floats(0.01, 100.0), st.floats(1.0, 40.0))
def test_shares_of_all_cells_are_probabilities_that_sum_to_one_at_the_most(
    std: float, length: float
) -> None:
    share = space.cell_shares(np.array([std]), np.array([length]))[0]
    assert (share >= -1e-9).all()
    assert share.sum() <= 1.0 + 1e-9
    np.testing.assert_allclose(share, share[::-1], atol=1e-9)


def test_shares_match_simulated_visits_with_normal_position_error() -> None:
    rng = np.random.default_rng(1)
    for std in (3.0, 8.0):
        at = np.floor(
            (rng.uniform(0.0, WIDTH_M, 200_000) + std * rng.normal(size=200_000)) / WIDTH_M
        )
        drawn = [np.mean(at == k) for k in (-2, -1, 1, 2)]
        assert space.cell_shares(np.array([std]), np.array([WIDTH_M]))[0] == pytest.approx(
            drawn, abs=0.005
        )


def test_good_fix_stays_in_its_cell_and_poor_one_spreads_along_heading() -> None:
    assert not spread(1.5)[1].any()
    x, y = grid.deinterleave(CELL)
    for yaw, ahead in ((0.0, (1, 0)), (np.pi / 2, (0, -1)), (np.pi, (-1, 0))):
        cells, share = spread(5.0, yaw)
        assert cells.tolist() == [
            -1,
            grid.interleave(x - ahead[0], y - ahead[1]),
            grid.interleave(x + ahead[0], y + ahead[1]),
            -1,
        ]
        assert 0.1 < share[1] == share[2] < 0.25
    assert not spread(np.nan)[1].any()
    assert not spread(5.0, np.nan)[1].any()


def test_a_visit_is_not_spread_into_another_region() -> None:
    border = grid.cell_of(LATITUDE, 0.0)  # a cell where two regions meet
    cells, share = spread(6.0, 0.0, int(border))
    assert (cells >= 0).sum() == 1
    assert share.sum() < 0.3


@given(st.floats(0.1, 60.0), st.floats(0.1, 1.1), st.floats(0.03, 0.3), st.floats(-3.1, 3.1))
def test_all_cells_together_learn_no_more_than_one_would(
    std: float, mu: float, width: float, yaw: float
) -> None:
    sure = Fusion(120.0)
    unsure = Fusion(120.0)
    o = observations([0.0], [1], value([mu], width))
    cells, share = space.other_cells(o.cell, np.array([LATITUDE]), np.array([yaw]), np.array([std]))
    sure.update(o)
    unsure.update(dataclasses.replace(o, other=cells, other_share=share))
    total = sum(information(kept) for kept in read_beliefs(unsure))
    # Tolerance: probabilities are rounded to 16 bits.
    assert total <= information(read_beliefs(sure)[0]) + 2e-3


def test_possibly_visited_cell_learns_a_little_but_is_not_visited() -> None:
    fusion = Fusion(120.0)
    cells, share = spread(5.0)
    o = observations([0.0], [1], value([0.2]))
    fusion.update(
        dataclasses.replace(o, other=cells[None], other_share=share[None].astype(np.float32))
    )
    slots = fusion.slots_of(np.array([CELL, cells[2]]), np.zeros(2, np.int64))
    own, beside = read_beliefs(fusion)[slots]
    assert information(own) > 3 * information(beside) > 0.0
    assert fusion.live.vehicles[slots].tolist() == fusion.live.visits[slots].tolist() == [1, 0]
    # A new vehicle's weight is 0.75.
    assert fusion.live.values[slots[1]] == pytest.approx(0.75 * share[2], rel=1e-5)


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
        cells, share = spread(15.0, 0.0, row)
        o = observations([40.0 * k], [k // 3], value([mu[k // 3]]), cell=row)
        o = dataclasses.replace(o, other=cells[None], other_share=share[None].astype(np.float32))
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
