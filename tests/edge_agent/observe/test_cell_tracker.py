"""Tests of the division of a drive into visits (passes through a map cell in one heading sector).
Each visit must begin where the previous one ends. Position noise at a border must start no visit,
and without a position there must be no visit.
"""

from __future__ import annotations

import numpy as np
import pytest

from edge_agent.observe.cell_tracker import (
    CELL_MARGIN,
    FIX_HELD_S,
    NOWHERE,
    locate_vehicles,
    new_tracks,
)
from schemas import grid
from tests.edge_agent.fakes import ground, wanderers

CELL_M = 10.2  # [m] side of a cell at this latitude


def straight(samples: int, speed: float = 10.0) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return east and north [m] and yaw [rad], each (T, 1), of a drive due east, 10 samples a
    second.
    """
    east = (np.arange(samples) * speed / 10.0)[:, None]
    return east, np.zeros_like(east), np.zeros_like(east)


def test_a_straight_drive_visits_each_cell_once() -> None:
    block = ground(*straight(100))
    _, located = locate_vehicles(new_tracks(1), block.t, block.signals)
    visited = located.cell[located.closes]
    assert len(np.unique(visited)) == len(visited)
    assert len(visited) - 1 == pytest.approx(99 / CELL_M, abs=1)
    assert set(visited) == set(np.unique(located.cell))


def test_the_visited_cell_is_that_of_the_position_but_for_the_margin() -> None:
    block = ground(*straight(200, speed=3.0))
    _, located = locate_vehicles(new_tracks(1), block.t, block.signals)
    true_cell = grid.cell_of(located.latitude, located.longitude)
    differs = (true_cell != located.cell).mean()
    assert 0 < differs < 2 * CELL_MARGIN


def test_jitter_at_a_border_does_not_start_a_visit_with_every_fix() -> None:
    """A standing car on the border of two cells must begin hardly any visits (passages of a cell),
    although its receiver's position scatters by 0.3 m.
    """
    rng = np.random.default_rng(3)
    west, south, _, north = (float(v) for v in grid.bounds(grid.cell_of(57.70, 11.97)))
    block = ground(np.zeros((600, 1)), np.zeros((600, 1)), np.zeros((600, 1)))
    block.signals[..., -3] = (south + north) / 2 + rng.normal(0, 0.3, (600, 1)) / 111_320
    block.signals[..., -2] = west + rng.normal(0, 0.3, (600, 1)) / 59_500
    _, located = locate_vehicles(new_tracks(1), block.t, block.signals)
    crossings = np.count_nonzero(np.diff(grid.cell_of(located.latitude, located.longitude)[:, 0]))
    assert crossings > 200
    assert np.count_nonzero(located.closes) <= 3


def test_a_turn_into_another_sector_starts_a_visit_in_the_same_cell() -> None:
    yaw = np.linspace(0.0, np.pi / 2, 40)[:, None]
    block = ground(np.zeros_like(yaw), np.zeros_like(yaw), yaw)
    _, located = locate_vehicles(new_tracks(1), block.t, block.signals)
    assert located.sector[located.closes].tolist() == [0, 1]
    assert len(np.unique(located.cell)) == 1


def test_a_yaw_that_swings_about_a_sector_edge_does_not_change_the_sector() -> None:
    yaw = np.pi / 4 + 0.05 * np.sin(np.arange(100.0))[:, None]
    block = ground(np.zeros_like(yaw), np.zeros_like(yaw), yaw)
    _, located = locate_vehicles(new_tracks(1), block.t, block.signals)
    assert np.count_nonzero(located.closes) == 1


def test_without_fixes_the_vehicle_is_nowhere_until_the_next() -> None:
    block = ground(*straight(100, speed=0.0))
    block.signals[20:60, :, -3:-1] = np.nan
    _, located = locate_vehicles(new_tracks(1), block.t, block.signals)
    nowhere = np.flatnonzero(located.cell[:, 0] == NOWHERE)
    assert nowhere[0] == 20 + round(FIX_HELD_S * 10)
    assert nowhere[-1] == 59
    assert np.flatnonzero(located.closes[:, 0]).tolist() == [0, nowhere[0], 60]
    assert np.isnan(located.latitude[nowhere]).all()


def test_between_fixes_the_last_one_is_held() -> None:
    east, north, yaw = straight(400, speed=1.0)
    dense = ground(east, north, yaw, rate_hz=100.0)
    sparse = ground(east, north, yaw, rate_hz=100.0, fix_every=10)
    _, often = locate_vehicles(new_tracks(1), dense.t, dense.signals)
    _, seldom = locate_vehicles(new_tracks(1), sparse.t, sparse.signals)
    assert np.isfinite(seldom.latitude).all()
    assert np.mean(seldom.cell != often.cell) < 0.12
    assert not seldom.inside[np.arange(400) % 10 != 0].any()


def test_without_yaw_the_course_over_ground_gives_the_sector() -> None:
    north, east, _ = straight(60)
    block = ground(east, north, np.full_like(east, np.nan))
    _, located = locate_vehicles(new_tracks(1), block.t, block.signals)
    assert set(located.sector[located.cell != NOWHERE]) == {1}
    assert (located.cell[5:] != NOWHERE).all()


def test_course_across_the_antimeridian_keeps_its_sector() -> None:
    east, north, _ = straight(60)
    block = ground(east, north, np.full_like(east, np.nan))
    longitude = block.signals[..., -2] - block.signals[30, 0, -2] + 180.0
    block.signals[..., -2] = np.where(longitude >= 180.0, longitude - 360.0, longitude)
    _, located = locate_vehicles(new_tracks(1), block.t, block.signals)
    assert set(located.sector[located.cell != NOWHERE]) == {0}


def test_impossible_positions_are_no_fixes() -> None:
    block = ground(*straight(10))
    block.signals[..., -3] = 1e9
    _, located = locate_vehicles(new_tracks(1), block.t, block.signals)
    assert (located.cell == NOWHERE).all()


def test_vehicles_do_not_touch_each_other() -> None:
    block = wanderers(300, 6)
    _, together = locate_vehicles(new_tracks(6), block.t, block.signals)
    for n in range(6):
        _, alone = locate_vehicles(new_tracks(1), block.t[:, [n]], block.signals[:, [n]])
        assert np.array_equal(alone.cell[:, 0], together.cell[:, n])
        assert np.array_equal(alone.closes[:, 0], together.closes[:, n])
