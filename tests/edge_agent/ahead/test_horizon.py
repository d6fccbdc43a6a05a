"""Tests of the horizon, the friction of the road ahead of a car. Distances along the road become
cells, unknown cells must stay unknown, old values must age, and the safe speed must follow from the
cells.
"""

from __future__ import annotations

import math

import numpy as np
import pytest

from edge_agent.ahead import local_map
from edge_agent.ahead.horizon import (
    COMFORT,
    SIGHT_M,
    UNKNOWN_LOWER,
    WARN_ABOVE,
    horizon_length,
    look_ahead,
    safe_speed,
)
from edge_agent.ahead.local_map import (
    ALERT_HELD_S,
    BORROWED,
    HELD_S,
    OTHER_WAY,
    LocalMap,
    belief_of,
)
from edge_agent.ahead.path import NONE, GivenRoute, Pose, straight_path, to_degrees, to_plane
from edge_agent.ahead.request_log import FURTHER_M, RequestLog
from edge_agent.ahead.roads import ways_on
from schemas import grid, mugrid
from schemas.thresholds import CHANGE_S, GRAVITY, NS
from tests.edge_agent.ahead.roads import HOME, NOW, alert, cells, keys_on, line, make_local_map


def test_place_across_the_antimeridian_is_near() -> None:
    east, north = to_plane(np.array([0.0]), np.array([-179.999]), Pose(0.0, 179.999, 0.0, 10.0, 0))
    assert east[0] == pytest.approx(222.6, abs=1.0)
    assert north[0] == 0.0


def test_every_metre_of_a_route_is_in_the_cell_of_its_position() -> None:
    path = GivenRoute(*line()).ahead(HOME, 200.0)
    assert path is not None
    assert path.kind == "route"
    latitude, longitude = line()
    assert len(path.distance) == 200
    assert path.places[99, 0] // grid.SECTORS == grid.cell_of(latitude[100], longitude[100])
    assert path.places[99, 0] % grid.SECTORS == 0  # heading sector 0 is east
    assert np.abs(path.curvature).max() < 1e-6


def test_route_continues_from_the_car_and_is_none_after_it_left() -> None:
    route = GivenRoute(*line())
    latitude, longitude = line()
    further = HOME._replace(latitude=float(latitude[300]), longitude=float(longitude[300]))
    path = route.ahead(further, 500.0)
    assert path is not None
    assert len(path.distance) in (98, 99)
    assert route.ahead(further._replace(latitude=57.701), 500.0) is None
    assert route.ahead(further._replace(yaw=HOME.yaw + math.pi), 500.0) is None, (
        "the other way is another road"
    )


@pytest.mark.parametrize("spacing", [1.0, 60.0])
@pytest.mark.parametrize("turned", [0.0, 35.0, 70.0, 89.0])
@pytest.mark.parametrize("ahead", [-12.0, 0.0, 12.0])
def test_car_that_turns_early_or_late_stays_on_its_route(
    ahead: float, turned: float, spacing: float
) -> None:
    """The route has a right angle to the left after 120 m. A car that turns before this corner, or
    only some metres after it, must still count as on the route.
    """
    way = np.arange(0.0, 120.0 + spacing / 2, spacing)
    x = np.concatenate([way, np.full(len(way) - 1, 120.0)])
    y = np.concatenate([np.zeros(len(way)), way[1:]])
    route = GivenRoute(*to_degrees(x, y, HOME))
    latitude, longitude = to_degrees(
        np.array([120.0 + min(ahead, 0.0)]), np.array([max(ahead, 0.0)]), HOME
    )
    yaw = HOME.yaw + math.radians(turned)
    pose = HOME._replace(latitude=float(latitude[0]), longitude=float(longitude[0]), yaw=yaw)
    path = route.ahead(pose, 500.0)
    assert path is not None
    assert len(path.distance) == pytest.approx(120.0 - ahead, abs=2.0)


@pytest.mark.parametrize("turned", [0.0, 90.0, 180.0])
def test_car_at_the_start_of_a_route_is_on_it_at_any_heading(turned: float) -> None:
    """A car must count as on its route although its heading differs from the direction in which the
    route begins. A navigation system leaves out the part already driven, so the route may begin at
    the next corner.
    """
    path = GivenRoute(*line()).ahead(HOME._replace(yaw=HOME.yaw + math.radians(turned)), 300.0)
    assert path is not None
    assert len(path.distance) in (299, 300)


def test_car_that_crosses_a_route_or_turns_off_has_left_it() -> None:
    latitude, longitude = line()
    further = HOME._replace(latitude=float(latitude[300]), longitude=float(longitude[300]))
    assert GivenRoute(*line()).ahead(further._replace(yaw=HOME.yaw + math.pi / 2), 500.0) is None


def test_a_loop_that_is_driven_twice_is_not_jumped_ahead_in() -> None:
    latitude, longitude = line(100.0)
    twice = GivenRoute(
        np.concatenate([latitude, latitude[::-1], latitude]),
        np.concatenate([longitude, longitude[::-1], longitude]),
    )
    path = twice.ahead(HOME, 500.0)
    assert path is not None
    assert len(path.distance) > 290


def test_unknown_stays_unknown() -> None:
    horizon = look_ahead(straight_path(HOME, 300.0), LocalMap(), NOW)
    assert not horizon.basis.any()
    assert (horizon.key == NONE).all()
    assert np.isnan(horizon.mu_lower).all()
    assert np.isnan(horizon.p_slippery).all()
    assert np.isnan(horizon.safe_speed).all()
    assert not horizon.slippery.any()


def test_lower_bound_gives_no_friction_value_and_no_safe_speed() -> None:
    horizon = look_ahead(
        straight_path(HOME, 100.0),
        make_local_map([cells(keys_on(), 0.3, basis=local_map.BOUND)]),
        NOW,
    )
    assert (horizon.basis == local_map.BOUND).any()
    assert np.isnan(horizon.mu).all()
    assert not horizon.slippery.any()
    assert np.isnan(horizon.safe_speed).all()


def test_belief_rebuilt_from_a_tile_has_its_quantiles() -> None:
    belief = belief_of(*(np.array([value]) for value in (0.31, 0.5, 0.8, 0.17)))
    assert belief.sum() == pytest.approx(1.0)
    bin_width = (mugrid.UPPER - mugrid.LOWER) / mugrid.BINS
    for share, value in ((0.05, 0.31), (0.5, 0.5), (0.95, 0.8)):
        assert mugrid.quantiles(belief, share)[0] == pytest.approx(value, abs=bin_width)
    assert (belief @ mugrid.SLIPPERY_SHARE)[0] == pytest.approx(0.17, abs=0.05)


def test_without_a_network_the_horizon_fades_to_unknown() -> None:
    cache = make_local_map([cells(keys_on(), 0.8, width=0.05)])
    path = straight_path(HOME, 60.0)
    fresh, later, gone = (
        look_ahead(path, cache, NOW + round(s * NS)) for s in (0.0, 1800.0, HELD_S + 1.0)
    )
    seen = fresh.basis == local_map.MEASURED
    assert seen.any()
    assert (later.mu_lower[seen] < fresh.mu_lower[seen] - 0.1).all(), "the interval opens"
    assert later.age_s[seen] == pytest.approx(1800.0)
    assert not gone.basis.any()


def test_a_warning_fades_in_half_an_hour_and_an_alert_in_ten_minutes() -> None:
    received = cells(keys_on(), 0.15, width=0.05)
    received = received._replace(
        belief=0.9 * received.belief + 0.1 * cells(received.key, 0.8, width=0.05).belief
    )
    cache = make_local_map([received])
    path = straight_path(HOME, 60.0)
    share = -math.expm1(-2400.0 / CHANGE_S)
    assert 0.9 * (1.0 - share) + 0.304 * share < WARN_ABOVE
    assert look_ahead(path, cache, NOW + 1500 * NS).slippery.any()
    assert not look_ahead(path, cache, NOW + 2400 * NS).slippery.any()
    alone = LocalMap()
    alone.store_alert(alert(keys_on()[3]), NOW)
    assert look_ahead(path, alone, NOW + NS).alerted.any()
    assert not look_ahead(path, alone, NOW + round((ALERT_HELD_S + 1) * NS)).alerted.any()


def test_full_cache_drops_the_cells_received_longest_ago() -> None:
    cache = LocalMap(most_cells=50)
    first = cells(keys_on(), 0.5)
    far = cells(keys_on(3000.0, start=2500.0), 0.5)
    cache.store_cells(1, first, NOW)
    cache.store_cells(2, far, NOW)
    assert cache.cells == len(far.key)
    assert np.isin(cache.keys(), far.key).all()


def test_part_of_a_tile_replaces_only_its_own_cells() -> None:
    keys = keys_on(100.0)
    cache = LocalMap()
    cache.store_cells(1, cells(keys, 0.8), NOW)
    cache.store_cells(1, cells(keys[:3], 0.2), NOW + NS)
    found = cache.look_up(keys, NOW + NS)
    assert found.mu[:3] == pytest.approx(0.2, abs=0.03)
    assert found.mu[3:] == pytest.approx(0.8, abs=0.03)


def test_older_tile_does_not_replace_a_newer_one() -> None:
    keys = keys_on(100.0)
    cache = LocalMap()
    cache.store_cells(1, cells(keys[:3], 0.2, at=NOW + NS), NOW + NS)
    cache.store_cells(1, cells(keys, 0.8), NOW + NS)
    found = cache.look_up(keys, NOW + NS)
    assert found.mu[:3] == pytest.approx(0.2, abs=0.03)
    assert found.mu[3:] == pytest.approx(0.8, abs=0.03)
    cache.store_cells(2, cells(keys[:0], 0.8), NOW)
    cache.drop_old(NOW + NS)
    assert cache.cells == len(keys), "a tile without cells is none"


def test_alerts_missing_from_a_tiles_standing_list_are_dropped() -> None:
    cache = LocalMap()
    keys = keys_on()
    tile = int(grid.tile_of(keys[3] // grid.SECTORS))
    assert cache.store_alert(alert(keys[3]), NOW)
    assert not cache.store_alert(alert(keys[3]), NOW + NS), "put again, it is no news"
    assert cache.store_standing_alerts(tile, [], NOW)
    assert not cache.alerts
    assert cache.store_alert(alert(keys[3]), NOW)
    assert cache.store_alert(alert(keys[3], raised=False), NOW)


def test_the_map_shows_the_road_around_a_bend_and_both_ways_at_a_fork() -> None:
    straight = keys_on(90.0, yaw=0.0)
    east, north = grid.deinterleave(straight[-1:] // grid.SECTORS)
    up = grid.interleave(np.repeat(east, 8), north - np.arange(1, 9)) * grid.SECTORS + 1
    on = grid.interleave(east + np.arange(1, 9), np.repeat(north, 8)) * grid.SECTORS
    pose = HOME._replace(yaw=0.0)
    bent = ways_on(pose, np.sort(np.concatenate([straight, up])), 250.0)
    assert len(bent) == 1
    assert set(up.tolist()) <= set(bent[0].places[:, 0].tolist())
    forked = ways_on(pose, np.sort(np.concatenate([straight, up, on])), 250.0)
    assert len(forked) == 2
    assert set(on.tolist()) & set(forked[0].places[:, 0].tolist()), "straight on comes first"
    assert ways_on(pose, up[4:], 250.0) == [], "no road here"


def test_a_car_without_a_route_knows_the_road_some_way_ahead_all_the_time() -> None:
    """The car must always know the road some way ahead. It receives only the map boxes (areas) that
    it requested, so it must request a box before it arrives there.
    """
    road = keys_on(1500.0)
    cache = LocalMap()
    asked = RequestLog()
    known_m = []
    latitude, longitude = line(1500.0)
    length = horizon_length(HOME.speed)
    for second in range(80):
        k = int(second * HOME.speed)
        pose = Pose(
            float(latitude[k]), float(longitude[k]), HOME.yaw, HOME.speed, NOW + second * NS
        )
        ways = ways_on(pose, cache.keys(), length + FURTHER_M) or [straight_path(pose, length)]
        horizon = look_ahead(ways[0].first_metres(length), cache, pose.time)
        known_m.append(int((horizon.basis == local_map.MEASURED).sum()))
        for box in asked.missing_boxes(ways[0], pose, length):
            received = cells(
                road[grid.touches(box, grid.bounds(road // grid.SECTORS))], 0.8, at=pose.time
            )
            cache.store_cells(1, received, pose.time)
    assert min(known_m[1:]) > 100


def test_road_behind_its_last_place_is_unknown() -> None:
    (way,) = ways_on(HOME, keys_on(60.0), 400.0)
    horizon = look_ahead(way, make_local_map([cells(keys_on(60.0), 0.8)]), NOW)
    assert len(way.distance) > 180
    assert horizon.basis[:50].all()
    assert not horizon.basis[85:].any()


def test_the_other_carriageway_is_no_way_on() -> None:
    back = keys_on(90.0, yaw=0.0) + 2
    assert ways_on(HOME._replace(yaw=0.0), back, 200.0) == []


def test_safe_speed_allows_stopping_in_sight_and_falls_comfortably() -> None:
    lower = np.concatenate([np.full(100, 0.8), np.full(50, 0.12)])
    speed = safe_speed(np.zeros(150), lower)
    v = speed[120]
    a = 0.12 * GRAVITY
    assert v * 1.5 + v * v / (2 * a) == pytest.approx(SIGHT_M)
    assert -np.diff(speed[:101] ** 2).min() / 2.0 <= COMFORT + 1e-9
    assert (np.diff(speed) <= 1e-9).all()


def test_safe_speed_of_a_bend_is_none_if_its_friction_is_unknown() -> None:
    bend = np.where(np.arange(80) > 50, 1.0 / 30.0, 0.0)
    assert safe_speed(bend, np.full(80, 0.2))[60] == pytest.approx(math.sqrt(0.2 * GRAVITY * 30.0))
    assert np.isnan(safe_speed(bend, np.full(80, np.nan))).all()


def test_look_ahead_covers_the_stopping_distance_on_an_unknown_road() -> None:
    assert horizon_length(14.0) > 14.0 * 1.5 + 14.0**2 / (2 * UNKNOWN_LOWER * GRAVITY)
    assert horizon_length(0.0) == 150.0
    assert horizon_length(80.0) == 1000.0


def test_opposite_alert_warns_until_grip_is_found_on_this_side() -> None:
    road = keys_on()
    path = straight_path(HOME, 60.0)
    other = [int(key) ^ OTHER_WAY for key in road[2:4]]
    cache = LocalMap()
    for key in other:
        assert cache.store_alert(alert(key), NOW)
    seen = look_ahead(path, cache, NOW + NS)
    assert set(seen.key[seen.alerted].tolist()) == set(road[2:4].tolist())
    assert (seen.basis[seen.alerted] == BORROWED).all(), "nobody has measured this side"
    assert (seen.mu_upper[seen.alerted] < 0.4).all()
    assert np.isfinite(seen.safe_speed[seen.alerted]).all()
    tile = int(grid.tile_of(road[2] // grid.SECTORS))
    cache.store_cells(tile, cells(road[2:3], 0.8, at=NOW - NS), NOW)
    assert look_ahead(path, cache, NOW + NS).slippery.sum() == seen.slippery.sum(), (
        "grip that was found before"
    )
    cache.store_cells(tile, cells(road[2:3], 0.3, basis=local_map.BOUND, at=NOW + NS), NOW)
    assert look_ahead(path, cache, NOW + NS).slippery.sum() == seen.slippery.sum(), (
        "who rolled over it found none"
    )
    cache.store_cells(tile, cells(road[2:3], 0.6, basis=local_map.BOUND, at=NOW + NS), NOW)
    assert look_ahead(path, cache, NOW + NS).slippery.sum() < seen.slippery.sum(), (
        "who braked there found enough"
    )
    cache.store_cells(tile, cells(road[2:3], 0.8, at=NOW + NS), NOW)
    assert set((found := look_ahead(path, cache, NOW + NS)).key[found.alerted].tolist()) == {
        int(road[3])
    }
    across = straight_path(HOME._replace(yaw=HOME.yaw + np.pi / 2), 60.0)
    assert not look_ahead(across, cache, NOW + NS).alerted.any(), "another road"
