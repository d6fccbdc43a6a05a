"""Tests of order and replay: within the lateness window (the allowed delay) the order of arrival
has no effect, and a replay gives the same map.
"""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from fleet_service.fusion import Fusion, Observations, Updated
from fleet_service.fusion.fuse import RecordedResult
from schemas import mugrid
from schemas.numeric import IntArray
from tests.fleet_service.examples import CELL, at_least, observations, value

LATENESS_S = 120.0


def drive(seed: int, n: int, duration_s: float) -> Observations:
    """Return observations of 12 vehicles, one of which reports wrong values, in 6 cells, in order
    of time.
    """
    rng = np.random.default_rng(seed)
    vehicle = rng.integers(0, 12, n)
    mu = np.where(
        vehicle == 0, 0.25, rng.choice([0.8, 0.3], n, p=[0.9, 0.1]) + 0.04 * rng.normal(size=n)
    )
    likelihood = np.where(rng.random(n)[:, None] < 0.4, value(mu), at_least(0.3 * mu))
    o = observations(np.sort(rng.random(n)) * duration_s, vehicle, likelihood)
    near = rng.random(n) < 0.2
    return Observations(
        **{
            **vars(o),
            "cell": CELL + rng.integers(0, 6, n),
            "second": np.where(near, 1, -1).astype(np.int8),
        }
    )


def delay_arrivals(o: Observations, most_s: float, seed: int) -> IntArray:
    """Return a random order of arrival (indices of the observations `o`) in which each observation
    arrives at most `most_s` [s] late.
    """
    return np.argsort(
        o.time + (np.random.default_rng(seed).random(len(o.time)) * most_s * 1e9).astype(np.int64)
    )


def fold_in(
    o: Observations, order: IntArray, parts: int
) -> tuple[Fusion, list[tuple[IntArray, Updated]]]:
    fusion = Fusion(LATENESS_S)
    updates = [(rows, fusion.update(o.take(rows))) for rows in np.array_split(order, parts)]
    return fusion, updates


def difference(a: Fusion, b: Fusion) -> float:
    """Return the largest difference between the beliefs of two `Fusion` objects, over all cells and
    probabilities.
    """
    assert a.size == b.size
    slots = b.slots_of(a.cell[: a.size], a.sector[: a.size])
    now = int(max(a.live.time.max(), b.live.time.max()))
    return float(np.abs(a.beliefs(np.arange(a.size), now) - b.beliefs(slots, now)).max())


@settings(max_examples=25)
@given(st.integers(0, 10**6), st.integers(1, 40))
@pytest.mark.campaign
def test_any_order_within_the_window_gives_the_same_beliefs(seed: int, parts: int) -> None:
    o = drive(seed, 400, 900.0)
    straight, _ = fold_in(o, np.arange(400), 400)
    mixed, updates = fold_in(o, delay_arrivals(o, 110.0, seed), parts)
    assert not any(updated.late.any() for _, updated in updates)
    assert difference(straight, mixed) <= 1e-6
    order = mixed.slots_of(straight.cell[: straight.size], straight.sector[: straight.size])
    np.testing.assert_array_equal(straight.live.visits[: straight.size], mixed.live.visits[order])
    np.testing.assert_array_equal(
        straight.live.vehicles[: straight.size], mixed.live.vehicles[order]
    )


def test_a_replay_with_the_weights_that_were_used_gives_the_same_map() -> None:
    o = drive(3, 3000, 4000.0)
    order = delay_arrivals(o, 300.0, 4)
    fusion, updates = fold_in(o, order, 300)
    late = np.zeros(3000, bool)
    weight = np.zeros(3000, np.float32)
    late_by = np.zeros(3000, np.int64)
    for rows, updated in updates:
        late[rows] = updated.late
        weight[rows] = updated.weight
        late_by[rows] = updated.late_by
    assert 0 < late.sum() < 2000
    assert len(np.unique(weight)) > 5
    again = Fusion(LATENESS_S)
    again.update(o, RecordedResult(late, late_by, weight))
    assert difference(fusion, again) <= 1e-6
    assert [again.trust(v) for v in range(12)] == pytest.approx(
        [fusion.trust(v) for v in range(12)], abs=1e-6
    )


def test_observation_long_before_the_checkpoint_changes_no_belief() -> None:
    fusion = Fusion(LATENESS_S)
    fusion.update(observations([0.0], [1], value([0.8])))
    fusion.update(observations([20_000.0], [2], value([0.8])))
    before = fusion.live.belief[0].copy()
    updated = fusion.update(observations([100.0], [3], value([0.2])))
    assert updated.late.tolist() == [True]
    assert not len(updated.slots)
    assert not updated.weight.any()
    np.testing.assert_array_equal(fusion.live.belief[0], before)


def test_a_window_frees_its_places_when_the_checkpoint_passes() -> None:
    fusion = Fusion(LATENESS_S)
    for k in range(200):
        fusion.update(
            observations(k * 60.0 + np.arange(50.0), np.arange(50), value(np.full(50, 0.7)))
        )
    assert fusion.waiting <= 4 * 50


def test_growing_stores_keep_their_content() -> None:
    n = 20_000
    rng = np.random.default_rng(5)
    cells = rng.permutation(n)
    o = observations(
        np.linspace(0.0, 900.0, n), rng.integers(0, 300, n), value(np.full(n, 0.6)), cell=cells
    )
    grown, _ = fold_in(o, np.arange(n), 37)
    whole = Fusion(LATENESS_S)
    whole.update(o)
    assert grown.size == n
    assert difference(grown, whole) <= 1e-6
    np.testing.assert_array_equal(np.sort(grown.cell[:n]), np.arange(n))
    assert (grown.slots_of(np.array([n + 5]), np.array([0])) == -1).all()
    assert mugrid.quantiles(grown.beliefs_at_last_report(np.arange(n)), 0.5) == pytest.approx(
        np.full(n, 0.6), abs=0.1
    )
