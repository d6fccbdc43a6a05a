"""Tests of warnings. Each must be given once, and early enough to stop even if the friction is at
the lower end of its interval. It must end when the ice is passed or gone, or the car takes another
road. No warning may be false.
"""

from __future__ import annotations

import math

import numpy as np
import pytest

from edge_agent.ahead.horizon import MARGIN_M, UNKNOWN_LOWER, look_ahead
from edge_agent.ahead.local_map import BOUND, LocalMap
from edge_agent.ahead.path import GivenRoute, Pose, straight_path
from edge_agent.ahead.warnings import ABSENT_S, UPDATE_S, Active, update_warnings
from schemas.numeric import IntArray
from schemas.thresholds import GRAVITY, NS, REACTION_S
from schemas.wire.ahead import GripWarning
from tests.edge_agent.ahead.roads import HOME, NOW, alert, cells, keys_on, line, make_local_map

ROAD = 600.0


class Car:
    """Simulated car that drives along the road and collects the warnings that it gets."""

    def __init__(self, cache: LocalMap, speed: float = 14.0) -> None:
        self.cache = cache
        self.speed = speed
        self.route = GivenRoute(*line(ROAD))
        self.active: tuple[Active, ...] = ()
        self.metre = 0.0

    def pose(self) -> Pose:
        latitude, longitude = line(ROAD)
        k = min(int(self.metre), len(latitude) - 2)
        time = NOW + round(self.metre / self.speed * NS)
        return Pose(float(latitude[k]), float(longitude[k]), HOME.yaw, self.speed, time)

    def look(self) -> list[GripWarning]:
        pose = self.pose()
        path = self.route.ahead(pose, 400.0)
        assert path is not None
        horizon = look_ahead(path, self.cache, pose.time)
        self.active, found = update_warnings(self.active, [horizon], pose, self.cache)
        return found

    def drive(self, metres: float) -> list[GripWarning]:
        found = self.look()
        for _ in range(int(metres / self.speed)):
            self.metre += self.speed
            found += self.look()
        return found


def icy(start: float = 300.0, length: float = 40.0) -> IntArray:
    return keys_on(start + length, start=start)


def dry_but(*ice: IntArray) -> LocalMap:
    slippery = np.concatenate(ice)
    rest = keys_on(ROAD)
    return make_local_map(
        [cells(rest[~np.isin(rest, slippery)], 0.9), cells(slippery, 0.15, width=0.05)]
    )


def test_one_warning_in_time_to_stop_ends_when_the_stretch_is_passed() -> None:
    car = Car(dry_but(icy()))
    warnings = car.drive(450.0)
    assert [one.state for one in warnings] == ["raised", "ended"]
    raised, ended = warnings
    assert raised.distance_m >= 14.0 * REACTION_S + MARGIN_M + 14.0**2 / (2 * 0.8 * GRAVITY)
    assert raised.distance_m <= 120.0, "not long before it matters"
    assert raised.time_s == pytest.approx(raised.distance_m / 14.0)
    assert raised.id == ended.id
    assert ended.reason == "passed"
    assert raised.mu == pytest.approx(0.15, abs=0.03)
    assert raised.mu_lower < raised.mu
    assert raised.sure
    assert raised.safe_speed < 10.0


def test_warning_on_an_unknown_road_leaves_room_for_its_lower_friction() -> None:
    cache = LocalMap()
    for key in icy():
        cache.store_alert(alert(key), NOW)
    car = Car(cache)
    raised = car.drive(250.0)[0]
    assert raised.distance_m >= 14.0 * REACTION_S + 14.0**2 / (2 * UNKNOWN_LOWER * GRAVITY)


def test_slow_vehicle_is_warned_later() -> None:
    fast, slow = (Car(dry_but(icy()), speed).drive(290.0)[0].distance_m for speed in (20.0, 7.0))
    assert fast > slow + 30.0


def test_dry_and_unknown_roads_warn_of_nothing() -> None:
    assert Car(make_local_map([cells(keys_on(ROAD), 0.9)])).drive(450.0) == []
    assert Car(LocalMap()).drive(450.0) == []


def test_ice_on_the_other_carriageway_is_none_of_ours() -> None:
    assert Car(make_local_map([cells(keys_on(ROAD) + 2, 0.15, width=0.05)])).drive(450.0) == []


def test_one_vehicle_alone_causes_no_warning() -> None:
    lonely = cells(icy(), 0.15, width=0.05)
    assert (
        Car(make_local_map([lonely._replace(vehicles=np.ones(len(lonely.key), np.int64))])).drive(
            450.0
        )
        == []
    )


def test_alert_over_a_mere_bound_is_exported_with_its_own_grip() -> None:
    """The map's knowledge of ice may fade until only a lower bound of friction is left, while the
    alert of this ice is still active. The warning must then state the friction in the alert.
    """
    cache = make_local_map([cells(icy(), 0.1, basis=BOUND)])
    for key in icy():
        cache.store_alert(alert(key, time=NOW - NS), NOW)
    raised = Car(cache).drive(290.0)[0]
    assert raised.mu == pytest.approx(0.15, abs=0.03)
    assert raised.reason == "an alert is active"


def test_a_stretch_that_grows_is_an_update_and_one_that_is_cleared_an_end() -> None:
    cache = LocalMap()
    keys = icy(200.0, 80.0)
    for key in keys[:3]:
        cache.store_alert(alert(key), NOW)
    car = Car(cache)
    raised = car.drive(90.0)
    assert [one.state for one in raised] == ["raised"]
    for key in keys[3:]:
        cache.store_alert(alert(key, time=NOW + NS), NOW + NS)
    updated = car.look()
    assert [one.state for one in updated] == ["updated"]
    assert updated[0].id == raised[0].id
    assert updated[0].length_m > raised[0].length_m + 20.0
    assert car.look() == [], "told once"
    for key in keys:
        cache.store_alert(alert(key, raised=False, time=NOW + 2 * NS), NOW + 2 * NS)
    car.metre += 1.0
    ended = car.look()
    assert [one.state for one in ended] == ["ended"]
    assert "no longer" in ended[0].reason


def test_warning_ends_when_the_car_takes_another_road() -> None:
    car = Car(dry_but(icy()))
    raised = car.drive(224.0)
    assert raised[0].state == "raised"
    pose = car.pose()._replace(
        yaw=HOME.yaw + math.pi / 2, time=car.pose().time + round((ABSENT_S + UPDATE_S) * NS)
    )
    horizon = look_ahead(straight_path(pose, 200.0), car.cache, pose.time)
    _, issued = update_warnings(car.active, [horizon], pose, car.cache)
    assert [one.state for one in issued] == ["ended"]
    assert issued[0].reason == "the vehicle left this route"


def test_nearly_touching_stretches_are_one_warning_distant_ones_two() -> None:
    near = Car(dry_but(icy(250.0, 20.0), icy(290.0, 20.0))).drive(300.0)
    assert [one.state for one in near] == ["raised"]
    apart = Car(dry_but(icy(200.0, 20.0), icy(320.0, 20.0))).drive(500.0)
    assert sorted(one.state for one in apart) == ["ended", "ended", "raised", "raised"]


def test_stretch_behind_a_fork_is_reported_as_possible() -> None:
    cache = dry_but(icy(100.0, 40.0))
    pose = HOME._replace(speed=20.0)
    route = GivenRoute(*line(ROAD)).ahead(pose, 300.0)
    assert route is not None
    ways = [
        look_ahead(route, cache, NOW),
        look_ahead(straight_path(pose._replace(yaw=1.6), 150.0), cache, NOW),
    ]
    _, issued = update_warnings((), ways, pose, cache)
    assert [one.sure for one in issued] == [False]
    _, issued = update_warnings((), ways[:1], pose, cache)
    assert [one.sure for one in issued] == [True]


def test_a_warning_reads_as_a_sentence() -> None:
    raised, ended = Car(dry_but(icy())).drive(450.0)
    assert raised.line().startswith("slippery in ")
    assert "km/h" in raised.line()
    assert ended.line().startswith("warning over: passed")
