"""Tests of winter equipment and roads in the simulation. Controllers (ABS and others) must act on
slippery road only. Tyres must build up side force over a distance, and a winter town must have the
intended surfaces.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pyarrow as pa
import pytest

from edge_agent.lab.simulation import PRESETS, DriveSetup, SimulatedFleet, simulate_manoeuvre, split
from edge_agent.lab.simulation.fleet import rough_ones, winter_ones
from edge_agent.lab.simulation.friction import SNOW
from edge_agent.lab.simulation.presets import TrueVehicle, winter_equipped
from edge_agent.lab.simulation.scenarios import drawn_town, scenario_named, winter
from schemas.errors import InputError
from schemas.numeric import FloatArray
from schemas.thresholds import GRAVITY


def equip_vehicle(
    preset: str, *, tcs: float = 1.0, esc: float = 1.0, regeneration: float = 0.0
) -> TrueVehicle:
    vehicle = replace(PRESETS[preset], relaxation=0.4, abs_hz=8.0)
    return replace(vehicle, tcs=tcs, esc=esc, regeneration=regeneration)


def column(log: pa.Table, name: str) -> FloatArray:
    return np.asarray(log[name].to_numpy(zero_copy_only=False))


@pytest.mark.parametrize("preset", ["small", "sedan", "van"])
def test_anti_lock_brakes_work_in_cycles_and_use_most_of_the_grip_of_snow(preset: str) -> None:
    log, _ = simulate_manoeuvre(
        "braking",
        mu=0.3,
        speed=20.0,
        duration_s=6.0,
        setup=DriveSetup(vehicle=equip_vehicle(preset), sensors="ideal"),
    )
    works = np.flatnonzero((column(log, "true_abs_active") > 0.0) & (column(log, "true_vx") > 4.0))
    torque = column(log, "torque_fl")[works]
    off = torque - torque.mean()
    cycles = np.count_nonzero((off[1:] > 0.0) & (off[:-1] <= 0.0)) / (len(works) / 100.0)
    assert len(works) > 300
    assert 6.0 <= cycles <= 10.0
    assert -column(log, "true_ax")[works].mean() > 0.85 * 0.3 * GRAVITY


def test_traction_control_ends_a_spin_which_is_endless_without_it() -> None:
    faster = {}
    for tcs in (0.0, 1.0):
        vehicle = equip_vehicle("small", tcs=tcs)
        log, _ = simulate_manoeuvre(
            "acceleration",
            mu=0.2,
            speed=3.0,
            duration_s=6.0,
            setup=DriveSetup(vehicle=vehicle, sensors="ideal"),
        )
        rim = column(log, "omega_fl") * vehicle.vehicle.wheel_radius
        faster[tcs] = np.median(rim - column(log, "true_vx"))
        assert (column(log, "true_tcs_active").mean() > 0.3) == (tcs > 0.0)
    assert faster[1.0] < 0.5
    assert faster[0.0] > 5.0


def test_stability_control_keeps_a_lane_change_on_snow_from_spinning() -> None:
    drift = {}
    for esc in (0.0, 1.0):
        log, _ = simulate_manoeuvre(
            "double-lane-change",
            mu=0.3,
            speed=16.0,
            setup=DriveSetup(vehicle=equip_vehicle("small", esc=esc), sensors="ideal"),
        )
        drift[esc] = np.abs(np.arctan2(column(log, "true_vy"), column(log, "true_vx"))).max()
        assert (column(log, "true_esc_active").max() > 0.0) == (esc > 0.0)
    assert drift[1.0] < 0.2 < 1.0 < drift[0.0]


def test_no_controller_works_in_ordinary_driving_on_dry_road() -> None:
    for manoeuvre in ("gentle-braking", "straight", "stop-and-go", "j-turn"):
        log, _ = simulate_manoeuvre(
            manoeuvre, mu=0.9, setup=DriveSetup(vehicle=equip_vehicle("van"), sensors="ideal")
        )
        assert not any(
            column(log, f"true_{name}_active").any() for name in ("abs", "tcs", "esc")
        ), manoeuvre


def test_regeneration_brakes_the_driven_axle_alone() -> None:
    log, _ = simulate_manoeuvre(
        "gentle-braking",
        mu=0.9,
        duration_s=9.0,
        setup=DriveSetup(vehicle=equip_vehicle("van", regeneration=3.0), sensors="ideal"),
    )
    fast = (column(log, "true_vx") > 5.0) & (column(log, "t") > 3.0)
    assert np.abs(column(log, "torque_fl")[fast]).max() < 1.0
    assert column(log, "torque_rl")[fast].mean() < -300.0


def test_a_tyre_builds_up_its_side_force_over_its_relaxation_length() -> None:
    rises = []
    for length in (0.0, 0.6):
        vehicle = replace(PRESETS["sedan"], relaxation=length)
        log, _ = simulate_manoeuvre(
            "j-turn", mu=0.9, speed=10.0, setup=DriveSetup(vehicle=vehicle, sensors="ideal")
        )
        lateral = np.abs(column(log, "true_ay"))
        rises.append(int(np.argmax(lateral > 0.5 * lateral.max())))
        ends = lateral[-50:].mean()
        assert ends == pytest.approx(lateral[-100:-50].mean(), rel=0.05)
    assert 1 <= rises[1] - rises[0] <= 10


def test_split_road_makes_unlike_brake_torques() -> None:
    log, _ = simulate_manoeuvre(
        "split-braking",
        mu=split(0.8, 0.15),
        setup=DriveSetup(vehicle=equip_vehicle("sedan"), sensors="ideal"),
    )
    works = np.flatnonzero(column(log, "true_abs_active"))
    left, right = (np.abs(column(log, f"torque_{side}")[works].mean()) for side in ("fl", "fr"))
    assert max(left, right) > 2.0 * min(left, right)


def test_winter_equipment_is_drawn_for_each_vehicle_and_changes_no_other() -> None:
    rng = np.random.default_rng(0)
    drawn_ones = [winter_equipped(PRESETS["van"], rng) for _ in range(200)]
    assert all(6.0 <= one.abs_hz <= 10.0 and 0.3 <= one.relaxation <= 0.6 for one in drawn_ones)
    assert 0.7 < np.mean([one.esc for one in drawn_ones]) < 1.0
    plain, half, few = (
        SimulatedFleet("test", n, 5, 50.0, winter=w) for n, w in ((4, 0.0), (4, 0.5), (3, 0.5))
    )
    assert half.winter.tolist() == [False, False, True, True]
    signals = [fleet.step(400)[1] for fleet in (plain, half, few)]
    np.testing.assert_array_equal(signals[0][:, :2], signals[1][:, :2])
    np.testing.assert_array_equal(signals[1][:, :3], signals[2])
    assert not np.array_equal(signals[0][:, 2], signals[1][:, 2], equal_nan=True)


def test_half_of_the_winter_vehicles_are_rough_where_half_are_each() -> None:
    both = rough_ones(16, 0.5) & winter_ones(16, 0.5)
    assert both.sum() == 4
    with pytest.raises(InputError, match="winter"):
        SimulatedFleet("test", 1, 0, 100.0, winter=-0.1)


def test_blocks_of_a_winter_fleet_do_not_depend_on_how_they_are_cut() -> None:
    whole, parts = (SimulatedFleet("test", 2, 5, 100.0, winter=1.0) for _ in range(2))
    together = whole.step(300)[1]
    pieces = np.concatenate([parts.step(steps)[1] for steps in (1, 99, 200)])
    np.testing.assert_array_equal(together, pieces)
    assert whole.truth.abs.shape == whole.truth.air_temperature.shape == (300, 2)
    assert whole.truth.abs.dtype == whole.truth.tcs.dtype == whole.truth.esc.dtype == np.bool_


def test_a_winter_town_has_ice_in_each_place_and_ruts_of_slush() -> None:
    town = winter(50_001)
    own = town.patches[len(drawn_town(50_001).patches) :]
    assert town.name == "winter-50001" == scenario_named("winter-50001").name
    for word, count in (
        ("ice before", 3),
        ("ice in bend", 3),
        ("ice left", 2),
        ("ice right", 2),
        ("rut", 6),
    ):
        assert sum(patch.name.startswith(word) for patch in own) == count
    assert all(
        patch.mu < 0.2 or (patch.name.startswith("rut") and patch.mu < SNOW + 0.06) for patch in own
    )
    assert -6.0 <= town.air_temperature <= 1.0


def test_controllers_are_reported_where_wheels_slip_in_a_winter_town() -> None:
    fleet = SimulatedFleet(winter(50_001), 6, 50_001, 100.0, winter=1.0)
    fleet.step(6000)
    truth = fleet.truth
    slides = np.asarray((truth.theta > 2.6).any(axis=-1))
    acts = np.asarray(truth.abs | truth.tcs | truth.esc)
    assert 0.01 < acts.mean() < 0.3
    assert slides[acts].mean() > 10.0 * slides[~acts].mean() > 0.0
    assert np.isfinite(truth.vx).all()
