"""Tests of roads and friction in the simulation. Lanes must join without gaps and never end, and
the friction must be right at every place and time.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from edge_agent.lab.simulation import SCENARIOS, Scenario, SimulatedFleet
from edge_agent.lab.simulation.friction import ICE, Patch
from edge_agent.lab.simulation.roads import (
    BRAKING,
    LanePoint,
    Network,
    Road,
    build_network,
    network_of,
    round_corners,
)
from schemas.errors import InputError

EVERY = pytest.mark.parametrize("scenario", SCENARIOS.values(), ids=SCENARIOS.keys())


def onward(network: Network, lane: int) -> list[int]:
    return [int(way) for way in network.ways[lane] if way >= 0]


def test_a_bend_is_an_arc_of_its_radius() -> None:
    line = round_corners([(0.0, 0.0), (100.0, 0.0), (100.0, 100.0)], 30.0)
    np.testing.assert_allclose(line[[0, -1]], [[0, 0], [100, 100]])
    bend = line[(line[:, 0] > 71) & (line[:, 1] < 29)]
    np.testing.assert_allclose(np.hypot(bend[:, 0] - 70.0, bend[:, 1] - 30.0), 30.0, atol=0.01)


@EVERY
def test_every_lane_joins_the_next_without_a_gap_or_a_kink(scenario: Scenario) -> None:
    network = scenario.network
    for k in range(len(network.size)):
        for way in onward(network, k):
            end = network.lane(k)[-1]
            start = network.lane(way)[0]
            assert np.hypot(*(end[:2] - start[:2])) < 0.01
            assert (
                end[LanePoint.COS] * start[LanePoint.COS]
                + end[LanePoint.SIN] * start[LanePoint.SIN]
                > 0.95
            )


@EVERY
def test_every_lane_can_be_reached_again_from_itself(scenario: Scenario) -> None:
    network = scenario.network
    for begin in range(network.roads):
        seen: set[int] = set()
        todo = [begin]
        while todo:
            fresh = set(onward(network, todo.pop())) - seen
            seen |= fresh
            todo += fresh
        assert begin in seen


@EVERY
def test_one_keeps_to_the_right_four_metres_from_the_other_lane(scenario: Scenario) -> None:
    network = scenario.network
    for k in range(0, network.roads, 2):
        lane = network.lane(k)
        back = network.lane(k + 1)
        for point in lane[10:-10]:
            offset = back[:, :2] - point[:2]
            nearest = offset[np.hypot(*offset.T).argmin()]
            # The opposite lane lies 4 m to the left.
            assert nearest @ (-point[LanePoint.SIN], point[LanePoint.COS]) == pytest.approx(
                4.0, abs=0.2
            )


@EVERY
def test_the_speed_profile_asks_for_no_more_than_the_budget(scenario: Scenario) -> None:
    network = scenario.network
    for k in range(len(network.size)):
        for number, way in enumerate(onward(network, k)):
            lane = network.lane(k)
            profile = network.lane(k)[:, LanePoint.PROFILE + number]
            assert (profile * np.abs(lane[:, LanePoint.CURVATURE]) <= 1 + 1e-9).all()
            assert (profile[:-1] - profile[1:] <= 2 * BRAKING * network.spacing[k] + 1e-9).all()
            assert profile[-1] <= network.lane(way)[0, LanePoint.PROFILE :].min() + 1e-9


def test_the_demonstration_is_small_enough_to_be_covered_many_times() -> None:
    network = SCENARIOS["demo"].network
    lanes = ((network.size - 1) * network.spacing)[: network.roads]
    assert 1500 < lanes.sum() / 2.0 < 3000, "each road has two lanes"


def test_roads_that_lead_nowhere_are_refused() -> None:
    with pytest.raises(InputError, match="'moon'"):
        build_network({"a": (0.0, 0.0)}, (Road("a", "moon"),))
    with pytest.raises(InputError, match="0 successors"):
        build_network({"a": (0.0, 0.0), "b": (100.0, 0.0)}, (Road("a", "b"),))


@EVERY
def test_ice_appears_at_its_time_and_not_before(scenario: Scenario) -> None:
    assert scenario.events
    for event in scenario.events:
        x = np.array([event.x])
        y = np.array([event.y])
        before = scenario.friction(event.start - 0.01, x, y)
        after = scenario.friction(event.start, x, y)
        assert before[0] > 0.5
        assert after[0] == ICE


def test_the_event_of_the_demonstration_is_at_seventy_seconds() -> None:
    assert [event.start for event in SCENARIOS["demo"].events] == [70.0]


def test_later_patches_lie_on_top_and_turn_with_their_angle() -> None:
    scenario = Scenario(
        "here",
        "",
        {},
        (),
        0.9,
        (
            Patch("snow", 0.0, 0.0, 100.0, 100.0, 0.35),
            Patch("ice", 0.0, 0.0, 40.0, 4.0, 0.15, angle=np.pi / 4),
        ),
    )
    points = np.array([[10.0, 10.0], [10.0, -10.0], [60.0, 0.0]])
    assert scenario.friction(0.0, points[:, 0], points[:, 1]).tolist() == [0.15, 0.35, 0.9]


def test_friction_takes_arrays_of_any_shape() -> None:
    scenario = SCENARIOS["demo"]
    x = np.random.default_rng(0).uniform(-200, 200, (5, 7, 4))
    t = np.linspace(0, 100, 5)[:, None, None]
    values = scenario.friction(t, x, x)
    assert values.shape == (5, 7, 4)
    assert values[3, 2, 1] == scenario.friction(t[3, 0, 0], x[3, 2, 1:2], x[3, 2, 1:2])[0]


def test_the_demonstration_has_dry_wet_snowy_icy_and_split_roads() -> None:
    scenario = SCENARIOS["demo"]
    points = scenario.network.points
    mu = scenario.friction(0.0, points[:, LanePoint.X], points[:, LanePoint.Y])
    assert set(mu.tolist()) == {0.9, 0.6, 0.35, 0.18}
    right = points[:, [LanePoint.X, LanePoint.Y]] + 0.8 * points[
        :, [LanePoint.SIN, LanePoint.COS]
    ] * [1, -1]
    left = points[:, [LanePoint.X, LanePoint.Y]] - 0.8 * points[
        :, [LanePoint.SIN, LanePoint.COS]
    ] * [1, -1]
    sides = [scenario.friction(0.0, *side.T) for side in (left, right)]
    assert (sides[0] > sides[1] + 0.1).sum() > 50  # [m] length of lane


def test_patches_that_cover_nothing_or_have_no_friction_are_refused() -> None:
    with pytest.raises(InputError, match="^mu: "):
        Patch("void", 0.0, 0.0, 1.0, 1.0, 0.0)
    with pytest.raises(InputError, match="^patch: "):
        Patch("line", 0.0, 0.0, 1.0, 0.0, 0.5)


def test_vehicles_start_on_given_lanes_at_the_speed_of_traffic() -> None:
    """Vehicles must start on the given lanes and drive at each lane's speed of traffic. The test
    has two parallel straight lanes with speeds of 13 m/s and 6 m/s.
    """
    x = np.arange(0.0, 400.0)
    lanes = [np.column_stack([x, np.full(400, y)]) for y in (0.0, 50.0)]
    allowed = [np.full(400, speed**2 / 5.0) for speed in (13.0, 6.0)]
    given = replace(network_of(lanes, [[0], [1]], 2, allowed), starts=np.array([1, 0, 1]))

    class Given(Scenario):
        network = given

    fleet = SimulatedFleet(Given("two", "lanes", {}, (), 0.9, ()), 3, 5, 100.0)
    fleet.step(1)
    np.testing.assert_allclose(fleet.truth.x[0], 0.0, atol=0.1)
    np.testing.assert_allclose(fleet.truth.y[0], [50.0, 0.0, 50.0], atol=0.1)
    fleet.step(1500)
    assert fleet.truth.vx[:, 1].max() > 1.5 * fleet.truth.vx[:, [0, 2]].max()
    np.testing.assert_allclose(fleet.truth.y[-1], [50.0, 0.0, 50.0], atol=1.0)
