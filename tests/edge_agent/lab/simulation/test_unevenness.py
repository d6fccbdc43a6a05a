"""Tests of uneven roads: size and correlation of the load swings, and their effect on a drive."""

from __future__ import annotations

import math

import numpy as np
import pytest

from edge_agent.lab.simulation import DriveSetup, simulate_manoeuvre
from edge_agent.lab.simulation.relief import Relief, road_named
from edge_agent.lab.simulation.scenarios import drawn_town, with_cobbles
from edge_agent.lab.simulation.unevenness import (
    COBBLES,
    LEAST_LOAD,
    TYRE_DEFLECTION,
    HeightWave,
    load_swing,
    radius_change,
    uneven_surface,
)
from schemas.numeric import FloatArray


def swings(surface: FloatArray, speed: float, heading: float = 0.0) -> FloatArray:
    """Return the load swings (T,) of a wheel that drives 400 m at `speed` [m/s]."""
    cos = math.cos(heading)
    sin = math.sin(heading)
    run = np.arange(0.0, 400.0, 0.01 * speed)
    velocity = (speed * cos, speed * sin)
    return np.array([load_swing(surface, (cos * s, sin * s), velocity) for s in run.tolist()])


def test_level_road_changes_neither_load_nor_radius() -> None:
    assert load_swing(Relief().surface_table, (3.0, 4.0), (20.0, 0.0)) == 0.0
    assert radius_change(0.0) == 0.0


def test_wheel_loads_on_cobbles_swing_by_a_quarter_in_town() -> None:
    for seed in range(3):
        surface = road_named("cobbled", seed).surface_table
        town = swings(surface, 12.0)
        assert 0.15 < town.std() < 0.4
        assert abs(town.mean()) < 0.03
        assert swings(surface, 3.0).std() < 0.5 * town.std()


def test_a_rough_road_swings_the_loads_alike_in_all_directions() -> None:
    surface = np.array(uneven_surface(COBBLES, 7))
    sizes = [swings(surface, 12.0, heading).std() for heading in (0.0, 0.8, 1.6, 2.4)]
    assert max(sizes) < 2.5 * min(sizes)


def test_a_wheel_that_lifts_off_keeps_a_small_load() -> None:
    high = np.array(uneven_surface(100.0 * COBBLES, 7))
    assert swings(high, 20.0).min() == LEAST_LOAD - 1.0


def test_a_slow_wheel_follows_a_long_wave_without_deflection() -> None:
    wave = np.array([HeightWave(0.05, 2.0 * math.pi / 100.0, 0.0, 0.0)])
    assert np.abs(swings(wave, 1.0)).max() < 0.01


def test_a_wheel_hops_most_at_its_own_frequency() -> None:
    wave = np.array([HeightWave(0.001, 2.0 * math.pi, 0.0, 0.0)])  # one metre long
    found = {speed: swings(wave, speed).std() for speed in (4.0, 11.0, 30.0)}
    assert found[11.0] > 1.5 * found[4.0]
    assert found[11.0] > 1.5 * found[30.0]


def test_a_loaded_tyre_rolls_on_a_smaller_radius() -> None:
    assert radius_change(1.0) == pytest.approx(-0.25 * TYRE_DEFLECTION)
    assert radius_change(-0.5) > 0.0


def test_wheel_speeds_jitter_on_cobbles_but_the_mean_grip_stays() -> None:
    drives = {
        road: simulate_manoeuvre(
            "braking", mu=0.8, seed=3, setup=DriveSetup(sensors="ideal", road=road)
        )[0]
        for road in ("level", "cobbled")
    }
    jitter = {}
    braking = {}
    for road, log in drives.items():
        moving = log["true_vx"].to_numpy() > 5.0
        speed = log["omega_fl"].to_numpy()[moving]
        jitter[road] = float(np.std(np.diff(speed)))
        braking[road] = float(np.mean(log["true_ax"].to_numpy()[moving]))
    assert jitter["cobbled"] > 3.0 * jitter["level"]
    assert braking["cobbled"] == pytest.approx(braking["level"], rel=0.25)


def test_a_cobbled_town_has_the_friction_and_slopes_of_the_town() -> None:
    town = drawn_town(12)
    rough = with_cobbles(town, 12)
    assert rough.patches == town.patches
    assert np.array_equal(rough.relief.table, town.relief.table)
    assert len(rough.relief.surface_table) > 0
