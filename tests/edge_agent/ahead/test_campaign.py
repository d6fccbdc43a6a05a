"""Tests of the evaluation of warnings ahead (`tests.benchmarks.ahead`) in short runs: warned cars,
bytes and delays are counted correctly.
"""

from __future__ import annotations

import numpy as np
import pytest

from edge_agent.lab.simulation import SimulatedFleet
from schemas.mugrid import STEPS_PER_NAT
from tests.benchmarks.ahead import approaches, cost, entry, latency
from tests.benchmarks.ahead.known_town import map_of_places, places_of


@pytest.mark.campaign
def test_a_longer_way_costs_more_and_a_route_less_than_none() -> None:
    known = cost.street_places()
    short, long = (
        cost.drive_way(np.random.default_rng(1), known, metres, routed=True)[0]
        for metres in (300.0, 1500.0)
    )
    assert 0.0 < short < long
    figures = {figure.name: figure.value for figure in cost.cost_figures(1, 1000.0)}
    assert figures["ahead.mb_per_day"] < figures["ahead.mb_per_day.unrouted"]
    assert figures["ahead.core_share"] > 0.0


@pytest.mark.campaign
def test_cars_that_reach_ice_are_counted_and_warned() -> None:
    counts = approaches.Approaches()
    approaches.drive_town(100, 60.0, 10, counts, routed=True)
    assert counts.arrived > 0
    assert counts.warned > 0
    assert counts.metres > 1000.0
    deaf = approaches.Approaches()
    mu = [0.9] * 20 + [0.15] * 10
    track = approaches._Track([10.0 * k for k in range(30)], [10.0] * 30, mu, mu)
    approaches._count_outcome(track, deaf)
    assert (deaf.arrived, deaf.warned) == (1, 0), "a car without the map is not warned"
    track.raised = {
        "ice": approaches._Raised(12, 80.0, 50.0),
        "nothing": approaches._Raised(2, 30.0, 20.0, ended=8),
    }
    approaches._count_outcome(track, deaf)
    assert (deaf.arrived, deaf.warned, deaf.false) == (2, 1, 1), (
        "the first in time; the second of nothing"
    )
    track.raised["ice"].ended = 18
    approaches._count_outcome(track, deaf)
    assert (deaf.arrived, deaf.warned) == (3, 1), "a warning that was taken back is none"
    track.raised["ice"] = approaches._Raised(18, 20.0, 50.0)
    approaches._count_outcome(track, deaf)
    assert (deaf.arrived, deaf.warned) == (4, 1), "too late"
    track.mu[16:20] = [0.3] * 4
    approaches._count_outcome(track, deaf)
    assert deaf.arrived == 4, "a car that comes from snow needs no warning of it"


@pytest.mark.campaign
def test_warnings_are_timed_over_a_real_router() -> None:
    figures = {figure.name: figure.value for figure in latency.latency_figures(1, 5, 3)}
    assert figures["ahead.latency.unwarned"] == 0
    assert 0.0 < figures["ahead.latency_p50_ms"] < 1e4


def test_correct_map_helps_at_entry_and_is_not_published() -> None:
    fleet = SimulatedFleet("hills-100", 2, 100, 100.0, rough=0.5)
    trace = entry.record_beliefs(fleet, 20.0)
    known = map_of_places(places_of(fleet.scenario, 20.0), entry.START_NS)
    with_, without = entry.entry_errors(trace, known, entry.START_NS).mean(axis=0)
    assert with_ < without
    assert entry.published_change(fleet, trace, 6.0) == 0.0
    other = entry.FilterTrace(
        trace.place, trace.own, trace.visit, trace.truth, [bytes(32)] * len(trace.published)
    )
    assert entry.published_change(fleet, other, 6.0) > 1.0 / STEPS_PER_NAT, "a change would be seen"


def test_places_hold_the_least_friction_of_their_lane_points() -> None:
    scenario = SimulatedFleet("demo", 1, 1, 50.0).scenario
    before, after = (places_of(scenario, t) for t in (0.0, 80.0))
    assert np.array_equal(before.key, after.key)
    assert (after.mu <= before.mu).all()
    assert (after.mu < before.mu).any(), "the black ice has come"
    found = map_of_places(after, 1).look_up(after.key, 1)
    assert found.mu == pytest.approx(np.clip(after.mu, 0.07, 1.18), abs=0.05)
