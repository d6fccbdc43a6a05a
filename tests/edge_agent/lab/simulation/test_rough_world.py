"""Tests of slopes, banks, standing vehicles and misaligned sensors in the simulation. The first
tests check the mechanics, the others the readings of the sensors.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pyarrow as pa
import pytest

from edge_agent.dynamics.parameters import Parameter
from edge_agent.lab.simulation import (
    PRESETS,
    ROADS,
    SCENARIOS,
    SENSORS,
    DriveSetup,
    Relief,
    SimulatedFleet,
    Wave,
    simulate_manoeuvre,
)
from edge_agent.lab.simulation.misaligned import (
    DEVICE_OF,
    DEVICES,
    WIDE,
    Misaligned,
    Misalignment,
    misalignment_row,
)
from edge_agent.lab.simulation.plant import advance, command, is_held, start_at, wheel_forces
from edge_agent.lab.simulation.relief import STEEPEST, cross_slope, gradient, slope_in_body
from edge_agent.lab.simulation.roads import LanePoint
from edge_agent.lab.simulation.scenarios import scenario_named
from edge_agent.lab.simulation.sensors import ROUGH_FLEET, Sensors
from edge_agent.lab.simulation.state import INPUTS, STATES, Control, Motion, Wheel
from schemas.errors import InputError
from schemas.numeric import FloatArray
from schemas.signals import CHANNELS, S, per_wheel
from schemas.thresholds import GRAVITY

SLOPES = (-0.08, -0.03, 0.02, 0.05, 0.08)


def column(log: pa.Table, name: str) -> FloatArray:
    return np.asarray(log[name].to_numpy(zero_copy_only=False), dtype=np.float64)


def sine(slope: float) -> float:
    """Return the sine of the slope angle, for a slope given as rise per metre."""
    return slope / float(np.hypot(1.0, slope))


def still(
    slope: float, bank: float = 0.0, mu: float = 0.85
) -> tuple[FloatArray, FloatArray, FloatArray, FloatArray]:
    """Return the arrays of a simulated sedan that stands on a road with the given slope and bank:
    state, parameters, inputs, and forces of the wheels.
    """
    p = PRESETS["sedan"].row()
    x = np.zeros(STATES)
    u = np.zeros((INPUTS, 4))
    w = np.zeros((len(Wheel), 4))
    start_at(x, p, (0.0, 0.0, 0.0), 0.0)
    u[Control.MU] = mu
    u[Control.TILT, 0] = slope
    u[Control.TILT, 1] = bank
    return x, p, u, w


@pytest.mark.parametrize("slope", SLOPES)
def test_a_standing_car_feels_the_sine_of_the_slope_and_stays_where_it_is(slope: float) -> None:
    log, _ = simulate_manoeuvre("standing", setup=DriveSetup(sensors="ideal", slope=slope))
    np.testing.assert_allclose(column(log, "ax"), GRAVITY * sine(slope), rtol=1e-12)
    for name in ("true_vx", "true_vy", "true_x", "true_y", "true_yaw", *per_wheel("omega")):
        assert not column(log, name).any(), name
    torque = sum(column(log, name)[-1] for name in per_wheel("torque"))
    vehicle = PRESETS["sedan"].vehicle
    assert torque == pytest.approx(
        vehicle.mass * GRAVITY * sine(slope) * vehicle.wheel_radius, rel=1e-9
    )
    used = np.mean([column(log, name)[-1] for name in per_wheel("true_utilisation")])
    # Tangent of the slope over the friction.
    assert used == pytest.approx(abs(slope) / 0.85, rel=1e-9)


@pytest.mark.parametrize("slope", SLOPES)
def test_climbing_at_constant_speed_takes_the_torque_of_the_slope(slope: float) -> None:
    light = replace(PRESETS["sedan"], drag=0.0, rolling=0.0)
    log, _ = simulate_manoeuvre(
        "straight", setup=DriveSetup(sensors="ideal", slope=slope, vehicle=light)
    )
    vehicle = light.vehicle
    torque = sum(column(log, name)[-500:].mean() for name in per_wheel("torque"))
    assert torque == pytest.approx(
        vehicle.mass * GRAVITY * sine(slope) * vehicle.wheel_radius, rel=2e-3
    )
    assert column(log, "ax")[-500:].mean() == pytest.approx(GRAVITY * sine(slope), rel=2e-3)
    assert column(log, "true_vx")[-1] == pytest.approx(column(log, "true_vx")[0], abs=0.1)


@pytest.mark.parametrize("bank", [-0.06, 0.04])
def test_straight_driving_on_a_bank_feels_its_sine(bank: float) -> None:
    log, _ = simulate_manoeuvre(
        "straight", setup=DriveSetup(sensors="ideal", road=Relief(crossfall=bank))
    )
    assert column(log, "ay")[-500:].mean() == pytest.approx(GRAVITY * sine(bank), rel=0.01)
    assert column(log, "true_bank")[-1] == pytest.approx(bank, rel=1e-3)
    # The tyres carry the side force with a slip angle.
    assert abs(column(log, "true_vy")[-1]) > 0.01


@pytest.mark.parametrize("slope", [-0.06, 0.03])
def test_coasting_vehicle_gains_only_its_lost_potential_energy(slope: float) -> None:
    p = replace(PRESETS["sedan"], drag=0.0, rolling=0.0).row()
    x = np.zeros(STATES)
    u = np.zeros((INPUTS, 4))
    w = np.zeros((len(Wheel), 4))
    start_at(x, p, (0.0, 0.0, 0.0), 15.0)
    u[Control.MU] = 0.9
    u[Control.TILT, 0] = slope
    command(p, u, 0.0, 0.0)

    def energy() -> float:
        turning = 0.5 * p[Parameter.WHEEL_INERTIA] * (x[Motion.OMEGA : Motion.OMEGA + 4] ** 2).sum()
        return float(
            0.5 * p[Parameter.MASS] * x[Motion.VX] ** 2
            + turning
            + p[Parameter.MASS] * GRAVITY * sine(slope) * x[Motion.X]
        )

    before = energy()
    for _ in range(50):
        advance(x, p, u, w, 1e-3, 100)
        assert before * (1 - 1e-3) < energy() <= before * (1 + 1e-5)
    assert (x[Motion.VX] - 15.0) * slope < 0.0


def test_loads_sum_to_the_normal_weight_and_shift_downhill() -> None:
    x, p, u, w = still(0.08, -0.05)
    command(p, u, 0.0, -8000.0)
    advance(x, p, u, w, 1e-3, 1000)
    wheel_forces(x, p, u, w)
    assert w[Wheel.FZ].sum() == pytest.approx(
        p[Parameter.MASS] * GRAVITY / np.sqrt(1 + 0.08**2 + 0.05**2), rel=1e-9
    )
    level, *_ = still(0.0)
    flat = np.zeros((len(Wheel), 4))
    wheel_forces(
        level, p, np.zeros((INPUTS, 4)) + 0.85 * (np.arange(INPUTS) == Control.MU)[:, None], flat
    )
    # Uphill the rear axle carries more load. The left side of this road lies lower, so the front
    # left wheel carries more than the front right.
    assert (w[Wheel.FZ, 2:] > flat[Wheel.FZ, 2:])[0]
    assert w[Wheel.FZ, 0] > w[Wheel.FZ, 1]


def test_brake_force_is_limited_by_brakes_and_friction() -> None:
    for force, mu, stays in (
        (-8000.0, 0.85, True),
        (-400.0, 0.85, False),
        (-8000.0, 0.05, False),
        (0.0, 0.85, False),
    ):
        x, p, u, w = still(0.08, mu=mu)
        command(p, u, 0.0, force)
        assert is_held(x, p, u) == stays
        advance(x, p, u, w, 1e-3, 2000)
        assert (x[Motion.VX] == 0.0) == stays
        assert (x[Motion.X] < -0.1) == (not stays)


@pytest.mark.parametrize("slope", [-0.08, 0.0, 0.08])
def test_traffic_lights_stop_hold_and_release_the_vehicle(slope: float) -> None:
    log, _ = simulate_manoeuvre("stop-and-go", setup=DriveSetup(sensors="ideal", slope=slope))
    speed = column(log, "true_vx")
    stands = speed == 0.0
    assert np.diff(stands.astype(int)).tolist().count(1) == 4
    assert stands.mean() > 0.05
    assert speed.max() > 9.0
    assert speed.min() > -0.05  # between brake and accelerator the car may roll back slightly
    for name in per_wheel("omega"):
        assert not column(log, name)[stands].any()
    # The last sample of a stop is left out, because the driver releases the brake in it.
    held_fast = np.flatnonzero(stands[:-1] & stands[1:])
    np.testing.assert_allclose(
        column(log, "ax")[held_fast], GRAVITY * sine(slope), rtol=1e-12, atol=1e-12
    )


@pytest.mark.parametrize("name", ROADS)
def test_every_road_is_the_gradient_of_a_height_and_public(name: str) -> None:
    for seed in range(20):
        table = ROADS[name](seed).table
        slopes = np.array(
            [
                gradient(table, (x, 0.0), (1.0, 0.0), cross_slope(table, 0.0))
                for x in np.arange(0.0, 1e3, 3.0)
            ]
        )
        assert np.hypot(*slopes.T).max() <= STEEPEST * (1 + 1e-12)
        assert slopes.any() == (name not in ("level", "cobbled"))
        east, north = slopes[7].tolist()
        expected = slope_in_body(east, north, 0.3)
        back = slope_in_body(east, north, 0.3 + np.pi)
        # A slope that rises in one direction falls in the other.
        np.testing.assert_allclose(expected, np.negative(back), atol=1e-15)


def test_the_hills_lead_back_to_the_same_height_whatever_the_way() -> None:
    table = replace(SCENARIOS["hills"].relief, crossfall=0.0, banking=0.0).table
    ways = []
    for corner in ((180.0, 0.0), (0.0, 120.0)):
        climbed = 0.0
        for start, end in (((0.0, 0.0), corner), (corner, (180.0, 120.0))):
            line = np.linspace(start, end, 4001)
            middle = 0.5 * (line[1:] + line[:-1])
            step = (np.array(end) - start) / 4000
            climbed += sum(
                float(np.dot(gradient(table, (x, y), (1.0, 0.0), 0.0), step)) for x, y in middle
            )
        ways.append(climbed)
    assert ways[0] == pytest.approx(ways[1], abs=0.05)
    assert abs(ways[0]) > 0.5


def test_lanes_fall_to_their_right_and_bends_to_their_inside() -> None:
    table = Relief(crossfall=0.025, banking=0.5).table
    for heading in np.linspace(0, 6, 9).tolist():
        lane = (float(np.cos(heading)), float(np.sin(heading)))
        falls = []
        for curvature in (0.0, 0.02, -0.02):
            east, north = gradient(table, (0.0, 0.0), lane, cross_slope(table, curvature))
            falls.append(slope_in_body(east, north, heading))
        np.testing.assert_allclose([left for _, left in falls], [0.025, 0.015, 0.035], atol=1e-12)
        np.testing.assert_allclose([ahead for ahead, _ in falls], 0.0, atol=1e-12)


def test_hilly_town_reaches_eight_per_cent_but_is_flatter_on_ice() -> None:
    scenario = SCENARIOS["hills"]
    points = scenario.network.points
    table = scenario.relief.table
    along = []
    for row in points:
        east, north = gradient(
            table,
            (row[LanePoint.X], row[LanePoint.Y]),
            (row[LanePoint.COS], row[LanePoint.SIN]),
            cross_slope(table, row[LanePoint.CURVATURE]),
        )
        along.append(east * row[LanePoint.COS] + north * row[LanePoint.SIN])
    steep = np.abs(along)
    assert 0.07 < steep.max() <= STEEPEST
    assert 0.02 < np.std(along) < 0.045
    icy = scenario.friction(100.0, points[:, LanePoint.X], points[:, LanePoint.Y]) < 0.2
    assert icy.any()
    assert steep[icy].max() < 0.055


ONLY = {
    "tilt": Misalignment(tilt=(0.035, 0.015, 0.01)),
    "steering": Misalignment(steering=(0.003, 0.03, 0.05)),
    "radius": Misalignment(radius=0.004),
    "step": Misalignment(step=0.1),
    "lag": Misalignment(lag_s=0.06),
    "torque": Misalignment(torqueless=1.0),
}


def two(
    manoeuvre: str, mounted: Misalignment
) -> tuple[dict[str, FloatArray], dict[str, FloatArray], FloatArray]:
    """Simulate a drive twice: with ideal sensors and with misaligned sensors. Return the channels
    of the first drive, the channels of the second, and the parameters of the misalignment.
    """
    exact, _ = simulate_manoeuvre(manoeuvre, setup=DriveSetup(sensors="ideal"))
    reported, _ = simulate_manoeuvre(
        manoeuvre, seed=5, setup=DriveSetup(sensors=Sensors(mounted=mounted))
    )
    named = [{name: column(log, name) for name in CHANNELS} for log in (exact, reported)]
    return named[0], named[1], misalignment_row(mounted, 5, 0)


@pytest.mark.parametrize("name", ONLY)
def test_misalignment_changes_exactly_the_signals_of_its_row(name: str) -> None:
    exact, reported, row = two("sine", ONLY[name])
    wanted = {key: value.copy() for key, value in exact.items()}
    t = np.arange(len(exact["ax"])) / 100.0
    if name == "tilt":
        wanted["ax"] = exact["ax"] + row[Misaligned.AX] + row[Misaligned.TURN] * exact["ay"]
        wanted["ay"] = exact["ay"] + row[Misaligned.AY] - row[Misaligned.TURN] * exact["ax"]
    for i, wheel in enumerate(("fl", "fr", "rl", "rr")):
        angle = exact[f"delta_{wheel}"]
        speed = exact[f"omega_{wheel}"]
        if name == "steering" and i < 2:
            bend = 1.0 + row[Misaligned.GAIN] + row[Misaligned.BEND] * np.abs(angle) / WIDE
            wanted[f"delta_{wheel}"] = row[Misaligned.ZERO] + bend * angle
        if name == "radius":
            wanted[f"omega_{wheel}"] = speed * (1.0 + row[Misaligned.RADIUS + i])
        if name == "step":
            wanted[f"omega_{wheel}"] = (
                np.floor(speed / row[Misaligned.STEP] + 0.5) * row[Misaligned.STEP]
            )
        if name == "torque":
            wanted[f"torque_{wheel}"] = np.full_like(speed, np.nan)
    if name == "lag":
        for c, channel in enumerate(CHANNELS[: S.LATITUDE]):
            wanted[channel] = np.interp(t - row[Misaligned.LAG + DEVICE_OF[c]], t, exact[channel])
        assert np.ptp(row[Misaligned.LAG : Misaligned.LAG + DEVICES]) > 0.005
    for channel in CHANNELS[: S.LATITUDE]:
        np.testing.assert_allclose(
            reported[channel], wanted[channel], rtol=1e-9, atol=1e-9, err_msg=channel
        )
    assert any(not np.array_equal(reported[c], exact[c], equal_nan=True) for c in CHANNELS)


def test_misalignments_are_independent_with_the_sizes_of_the_table() -> None:
    whole = SENSORS["rough"].mounted
    rows = np.array([misalignment_row(whole, 1, k) for k in range(400)])
    alone = np.array([misalignment_row(ONLY["radius"], 1, k) for k in range(400)])
    np.testing.assert_array_equal(
        rows[:, Misaligned.RADIUS : Misaligned.RADIUS + 4],
        alone[:, Misaligned.RADIUS : Misaligned.RADIUS + 4],
    )
    assert rows[:, Misaligned.AX].std() == pytest.approx(GRAVITY * whole.tilt[0], rel=0.1)
    assert 0.25 < rows[:, Misaligned.AX].std() < 0.5
    assert 0.12 < rows[:, Misaligned.AY].std() < 0.25
    assert rows[:, Misaligned.ZERO].std() == pytest.approx(whole.steering[0], rel=0.1)
    assert rows[:, Misaligned.STEP].max() <= whole.step
    assert rows[:, Misaligned.LAG : Misaligned.LAG + DEVICES].max() <= whole.lag_s
    assert rows[:, Misaligned.LAG : Misaligned.LAG + DEVICES].max() > 0.9 * whole.lag_s


def test_wheel_speed_is_zero_at_standstill_and_quantised_in_motion() -> None:
    log, _ = simulate_manoeuvre(
        "stop-and-go", seed=3, setup=DriveSetup(sensors="rough-coarse", road="hilly")
    )
    stands = column(log, "true_vx") == 0.0
    step = misalignment_row(SENSORS["rough-coarse"].mounted, 3, 0)[Misaligned.STEP]
    for name in per_wheel("omega"):
        assert not column(log, name)[stands].any()
        np.testing.assert_allclose(
            column(log, name) / step, np.round(column(log, name) / step), atol=1e-6
        )


def test_half_a_fleet_is_rough_and_the_other_half_drives_as_it_always_did() -> None:
    plain = SimulatedFleet("demo", 6, 5, 50.0)
    mixed = SimulatedFleet("demo", 6, 5, 50.0, rough=0.5)
    assert mixed.rough.tolist() == [False, True, False, True, False, True]
    (_, usual) = plain.step(2000)
    (_, reported) = mixed.step(2000)
    np.testing.assert_array_equal(usual[:, ::2], reported[:, ::2])
    assert not np.array_equal(usual[:, 1], reported[:, 1], equal_nan=True)
    assert (mixed.truth.vx[:, 1::2] == 0.0).any()  # drivers of rough vehicles stop now and then
    assert (mixed.truth.vx[:, ::2] > 0.0).all()


def test_rough_fleet_on_hills_is_independent_of_blocks_and_number() -> None:
    whole, parts, one = (SimulatedFleet("hills", n, 5, 100.0, rough=1.0) for n in (4, 4, 1))
    _, signals = whole.step(600)
    pieces = [parts.step(n)[1] for n in (1, 7, 92, 300, 200)]
    np.testing.assert_array_equal(np.concatenate(pieces), signals)
    np.testing.assert_array_equal(one.step(600)[1][:, 0], signals[:, 0])


def test_the_road_under_a_car_is_smooth() -> None:
    fleet = SimulatedFleet("hills", 6, 5, 100.0, rough=0.5)
    fleet.step(3000)
    slope = fleet.truth.slope
    speed = np.abs(fleet.truth.vx)
    driven = np.maximum(speed[1:], 1.0) / 100.0
    assert np.ptp(slope) > 0.06
    # Change of slope per metre. At 10 m/s, .03 would change a_x by 3 m/s^2 within a second.
    assert (np.abs(np.diff(slope, axis=0)) / driven).max() < 0.03


def test_torque_is_missing_in_about_half_of_a_rough_fleet() -> None:
    missing = [
        misalignment_row(ROUGH_FLEET.mounted, 2, k)[Misaligned.TORQUELESS] for k in range(300)
    ]
    assert 0.4 < np.mean(missing) < 0.6


def test_a_town_by_number_is_the_drawn_one_and_another_number_another_town() -> None:
    one = scenario_named("hills-20000")
    other = scenario_named("hills-20001")
    assert one == scenario_named("hills-20000")
    assert one.background != other.background
    assert one.relief != other.relief
    ice = min(one.patches, key=lambda patch: patch.mu)
    assert 0.1 <= ice.mu < 0.2 < 0.78 <= one.background
    with pytest.raises(InputError, match="^scenario: .*hills-SEED"):
        scenario_named("hills-x")


def test_unknown_roads_and_slopes_no_road_has_are_refused() -> None:
    with pytest.raises(InputError, match="^road: .*hilly"):
        simulate_manoeuvre("straight", setup=DriveSetup(road="moonscape"))
    with pytest.raises(InputError, match="^slope: "):
        simulate_manoeuvre("straight", setup=DriveSetup(slope=0.3))
    with pytest.raises(InputError, match="^slope: "):
        Wave(0.05, length=0.0)
    with pytest.raises(InputError, match="^rough: "):
        SimulatedFleet("test", 1, 0, 100.0, rough=1.5)
