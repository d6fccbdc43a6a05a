"""Tests of the map as a prior of the friction estimate. The car must use the map when it enters a
cell, and drop the map if it is wrong. A published report must not contain the map.
"""

from __future__ import annotations

import numpy as np
import pytest

from edge_agent.ahead.local_map import BOUND, HELD_S, belief_of
from edge_agent.ahead.prior import MOST, NOWHERE, SHARE, MapPrior
from edge_agent.app.estimator_factory import bank_of
from edge_agent.inputs.block import Block
from edge_agent.lab.simulation import SimulatedFleet
from edge_agent.lab.simulation.blocks import blocks
from edge_agent.observe.pipeline import Pipeline
from schemas import mugrid
from schemas.config import AgentConfig
from schemas.numeric import FloatArray
from schemas.thresholds import NS
from tests.edge_agent.ahead.roads import NOW, cells, keys_on, make_local_map

FLAT = np.zeros((1, mugrid.BINS))


def sharp(mu: float, std: float = 0.06) -> FloatArray:
    """Return a map's belief about a cell: probabilities (32,) on the friction grid, with median
    `mu` and a 90 % interval of `mu` ± 1.6·`std`.
    """
    values = (np.array([value]) for value in (mu - 1.6 * std, mu, mu + 1.6 * std, float(mu < 0.4)))
    return np.asarray(belief_of(*values)[0])


def saying(mu: float, std: float = 0.08) -> FloatArray:
    """Return the log-likelihood (1, 32) of a friction measurement `mu` with a normal error of
    standard deviation `std`, on the friction grid.
    """
    log = -0.5 * ((mugrid.CENTRES - mu) / std) ** 2
    return np.asarray((log - log.max())[None])


def middle(p: FloatArray) -> float:
    return float(mugrid.quantiles(p, 0.5)[0])


def key(k: int) -> np.ndarray[tuple[int], np.dtype[np.int64]]:
    return np.array([k])


def test_belief_without_a_map_is_that_of_the_filter() -> None:
    prior = MapPrior(1)
    own = saying(0.7)
    out = prior.step(key(5), own, saying(0.7), {0: None})
    assert np.array_equal(out, np.exp(own) / np.exp(own).sum())


def test_at_the_border_of_a_cell_that_the_map_knows_its_belief_is_expected() -> None:
    prior = MapPrior(1)
    prior.step(key(4), saying(0.9), FLAT, {0: sharp(0.9)})
    assert prior.entered_vehicles(key(5)) == [0]
    out = prior.step(key(5), saying(0.9), FLAT, {0: sharp(0.2)})
    assert prior.entered_vehicles(key(5)) == []
    assert out[0, mugrid.CENTRES < 0.4].sum() > 0.7
    assert mugrid.quantiles(out, 0.95)[0] > 0.8, "what no map can take away"


def test_map_prior_fades_with_age_and_ignores_lower_bounds() -> None:
    road = keys_on(100.0)
    place = int(road[0])
    shares = []
    for age_s in (0.0, 1800.0, 4 * 3600.0):
        received = cells(road, 0.2, at=NOW - round(age_s * NS))
        belief = make_local_map([received._replace(map_time=np.full(len(road), NOW))]).belief_at(
            place, NOW
        )
        assert belief is not None
        shares.append(float(belief[mugrid.CENTRES < 0.4].sum()))
    assert shares[0] > shares[1] + 0.05 > shares[2] + 0.2
    assert (
        make_local_map([cells(road, 0.2)]).belief_at(place, NOW + round((HELD_S + 1.0) * NS))
        is None
    )
    assert make_local_map([cells(road, 0.2, basis=BOUND)]).belief_at(place, NOW) is None
    assert make_local_map([]).belief_at(place, NOW) is None


def test_a_wrong_map_is_abandoned_quickly_and_trusted_less_in_next_cells() -> None:
    prior = MapPrior(1)
    says = []
    prior.step(key(4), saying(0.9), FLAT, {0: sharp(0.9)})
    for cell in range(5, 9):
        entered = prior.step(key(cell), saying(0.2, 0.3), FLAT, {0: sharp(0.9)})
        says.append(middle(entered))
        left = prior.step(key(cell), saying(0.2), saying(0.2), {})
        assert middle(left) < 0.35
    assert says[-1] < says[0] - 0.1


def test_repeated_map_belief_does_not_become_more_certain() -> None:
    """A car drives through many cells for which the map has the same belief. Repetition must not
    make this belief more certain. Therefore the car's friction interval must not become narrower
    after the second cell.
    """
    prior = MapPrior(1)
    widths = []
    for cell in range(30):
        out = prior.step(key(cell), FLAT, FLAT, {0: sharp(0.6)})
        widths.append(float((mugrid.quantiles(out, 0.95) - mugrid.quantiles(out, 0.05))[0]))
    assert min(widths[1:]) == pytest.approx(widths[1], abs=1e-9)


def test_vehicle_without_a_place_uses_no_map() -> None:
    prior = MapPrior(2)
    out = prior.step(np.array([NOWHERE, 7]), np.zeros((2, 32)), np.zeros((2, 32)), {1: sharp(0.2)})
    assert np.array_equal(out[0], mugrid.PRIOR)
    assert not np.array_equal(out[1], mugrid.PRIOR)
    assert 0.0 < SHARE < MOST < 1.0


def test_map_prior_changes_no_published_record() -> None:
    fleet = SimulatedFleet("test", 2, 3, 100.0)
    published = []
    source = blocks(fleet, 100.0)
    driven: list[Block] = [next(source) for _ in range(60)]
    for lie in (None, sharp(0.15), sharp(1.0)):
        pipeline = Pipeline(bank_of("aco-fckf", fleet.vehicles), 2, AgentConfig())
        prior = MapPrior(2)
        records = []
        helped = 0.0
        for block in driven:
            _, seen, states = pipeline.step(block)
            records += [*seen.columns.values(), *states.columns.values()]
            beliefs = pipeline.beliefs()
            assert beliefs is not None
            own, visit = beliefs
            out = prior.step(
                pipeline.places,
                own,
                visit,
                dict.fromkeys(prior.entered_vehicles(pipeline.places), lie),
            )
            alone = np.exp(own) / np.exp(own).sum(axis=1, keepdims=True)
            helped = max(helped, float(np.abs(out - alone).max()))
        published.append(records)
        assert (helped > 0.05) == (lie is not None)
    for one in published[1:]:
        assert all(
            np.array_equal(a, b, equal_nan=a.dtype.kind == "f")
            for a, b in zip(published[0], one, strict=True)
        )
