"""Tests of simulated fleets. Results must not depend on the number of vehicles or on the division
into blocks of samples. Cars must stay on the road, and use much friction where the scenario intends
it.
"""

from __future__ import annotations

import numpy as np
import pytest
from scipy.spatial import cKDTree

from edge_agent.lab.simulation import SCENARIOS, SimulatedFleet
from edge_agent.lab.simulation.fleet import Truth
from edge_agent.lab.simulation.friction import ICE
from edge_agent.lab.simulation.roads import LanePoint
from schemas.errors import InputError
from schemas.numeric import FloatArray
from schemas.signals import CHANNELS, S


@pytest.fixture(scope="module")
def drive() -> tuple[SimulatedFleet, FloatArray, FloatArray, Truth]:
    """Simulate two minutes of the demonstration scenario with thirty vehicles and ideal sensors.
    Return the fleet, the times (T, N), the signals (T, N, 18), and the true states.
    """
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("edge_agent.lab.simulation.fleet.ORDINARY", "ideal")
        fleet = SimulatedFleet("demo", 30, seed=11, rate_hz=50.0)
    t, signals = fleet.step(120 * 50)
    return fleet, t, signals, fleet.truth


def test_a_vehicle_drives_the_same_alone_and_among_thirty() -> None:
    alone = SimulatedFleet("demo", 1, 5, 100.0)
    many = SimulatedFleet("demo", 30, 5, 100.0)
    _, one = alone.step(2000)
    _, all_of_them = many.step(2000)
    np.testing.assert_array_equal(one[:, 0], all_of_them[:, 0])
    assert alone.vehicles[0] == many.vehicles[0]


def test_blocks_of_any_length_give_the_same_samples() -> None:
    whole = SimulatedFleet("test", 4, 5, 100.0)
    parts = SimulatedFleet("test", 4, 5, 100.0)
    t, signals = whole.step(500)
    pieces = [parts.step(n) for n in (1, 7, 92, 300, 100)]
    np.testing.assert_array_equal(np.concatenate([p[0] for p in pieces]), t)
    np.testing.assert_array_equal(np.concatenate([p[1] for p in pieces]), signals)


def test_another_seed_is_another_day() -> None:
    first, second = (SimulatedFleet("test", 3, seed, 100.0) for seed in (1, 2))
    assert not np.array_equal(first.step(100)[1], second.step(100)[1], equal_nan=True)
    assert first.vehicles != second.vehicles


def test_signals_have_the_shape_of_the_contract(
    drive: tuple[SimulatedFleet, FloatArray, FloatArray, Truth],
) -> None:
    fleet, t, signals, truth = drive
    assert signals.shape == (6000, 30, len(CHANNELS))
    assert t.shape == truth.x.shape == (6000, 30)
    assert truth.mu_wheel.shape == truth.utilisation.shape == (6000, 30, 4)
    assert t[0, 0] == 0.0
    assert t[-1, -1] == pytest.approx(119.98)
    assert fleet.names[0] == "sim-001"
    assert [vehicle.name for vehicle in fleet.vehicles] == fleet.names


def test_ideal_signals_are_those_of_the_truth(
    drive: tuple[SimulatedFleet, FloatArray, FloatArray, Truth],
) -> None:
    fleet, t, signals, truth = drive
    x, y = fleet.scenario.from_latlon(signals[::5, :, S.LATITUDE], signals[::5, :, S.LONGITUDE])
    np.testing.assert_allclose(x, truth.x[::5], atol=1e-4)
    np.testing.assert_allclose(y, truth.y[::5], atol=1e-4)
    assert np.isnan(signals[1::5, :, S.LATITUDE]).all()
    assert np.isfinite(signals[..., : S.LATITUDE]).all()
    turned = np.diff(truth.yaw, axis=0) * fleet.rate_hz
    np.testing.assert_allclose(turned, signals[:-1, :, S.YAW_RATE], atol=0.1)
    ground = fleet.scenario.friction(t, truth.x, truth.y)
    # In the other samples the wheels may be on two surfaces.
    assert np.mean(np.abs(ground - truth.mu_wheel.mean(axis=2)) < 0.01) > 0.85


def test_everybody_stays_on_the_road(
    drive: tuple[SimulatedFleet, FloatArray, FloatArray, Truth],
) -> None:
    fleet, _, _, truth = drive
    lanes = fleet.scenario.network.points[:, [LanePoint.X, LanePoint.Y]]
    off = np.asarray(cKDTree(lanes).query(np.column_stack([truth.x.ravel(), truth.y.ravel()]))[0])
    assert np.quantile(off, 0.99) < 1.5
    assert off.max() < 8.0  # vehicles slide on black ice
    assert (truth.vx > 0.0).all()


def test_the_fleet_moves_and_covers_the_network(
    drive: tuple[SimulatedFleet, FloatArray, FloatArray, Truth],
) -> None:
    fleet, _, _, truth = drive
    assert 7.0 < truth.vx.mean() < 13.0
    lanes = fleet.scenario.network.points[:, [LanePoint.X, LanePoint.Y]]
    cells = {(round(x / 10), round(y / 10)) for x, y in lanes}
    seen = {
        (round(x / 10), round(y / 10))
        for x, y in zip(truth.x[::5].ravel(), truth.y[::5].ravel(), strict=True)
    }
    assert len(cells & seen) / len(cells) > 0.95


def test_tyres_are_excited_and_most_of_all_where_it_is_slippery(
    drive: tuple[SimulatedFleet, FloatArray, FloatArray, Truth],
) -> None:
    _, _, _, truth = drive
    used = truth.utilisation.max(axis=2)
    mu = truth.mu_wheel.mean(axis=2)
    assert truth.utilisation.max() <= 1 + 1e-9
    share = [
        float((used[(mu > low) & (mu < high)] > 0.6).mean())
        for low, high in ((0.8, 1), (0.3, 0.4), (0.1, 0.25))
    ]
    assert 0.03 < share[0] < share[1] < share[2] < 0.95


def test_ice_is_under_the_wheels_only_after_it_appeared(
    drive: tuple[SimulatedFleet, FloatArray, FloatArray, Truth],
) -> None:
    fleet, t, _, truth = drive
    (event,) = fleet.scenario.events
    in_event = (np.abs(truth.x - event.x) < event.length / 2 - 3) & (
        np.abs(truth.y - event.y) < event.width / 2 - 2
    )
    assert (truth.mu_wheel[in_event & (t < event.start)] > 0.8).all()
    assert (truth.mu_wheel[in_event & (t >= event.start)] == ICE).all()
    assert (in_event & (t >= event.start)).any(axis=0).sum() >= 3


def test_patchy_sensors_fall_silent_now_and_then() -> None:
    fleet = SimulatedFleet("test", 20, 0, 50.0)
    _, signals = fleet.step(3000)
    silent = np.isnan(signals[..., : S.LATITUDE]).mean()
    assert 0.0005 < silent < 0.006


@pytest.mark.parametrize(
    ("field", "arguments"),
    [
        ("scenario", ("moon", 3, 0, 100.0)),
        ("vehicles", ("test", 0, 0, 100.0)),
        ("rate_hz", ("test", 1, 0, 0.0)),
        ("seed", ("test", 1, -1, 100.0)),
    ],
)
def test_bad_arguments_are_refused_by_name(
    field: str, arguments: tuple[str, int, int, float]
) -> None:
    with pytest.raises(InputError, match=f"^{field}: "):
        SimulatedFleet(*arguments)


def test_a_block_needs_at_least_one_sample() -> None:
    with pytest.raises(InputError, match="^steps: "):
        SimulatedFleet(SCENARIOS["test"], 1, 0, 100.0).step(0)


def test_warned_driver_slows_down_only_for_the_stretch() -> None:
    """A warned driver must slow down for the slippery stretch, and only there. The test compares
    drives of the same driver from the same start, with and without a warning.
    """
    speeds = []
    for warned in (False, True):
        fleet = SimulatedFleet("demo", 1, 3, 50.0)
        fleet.step(500)
        before = fleet.truth.vx[-1, 0]
        if warned:
            fleet.warn(0, (40.0, 80.0), 4.0, 0.15)
        fleet.step(1500)
        speeds.append(fleet.truth.vx[:, 0])
    free, careful = speeds
    assert before > 6.0
    assert careful.min() < 5.0
    assert careful.min() < free.min() - 1.0
    assert careful[1000:].max() > 6.0, "the stretch is passed"
    assert np.array_equal(free[:75], careful[:75]), "nobody reacts before his reaction time"


def test_predicted_path_of_a_driver_is_the_driven_one() -> None:
    fleet = SimulatedFleet("demo", 3, 3, 50.0)
    fleet.step(100)
    routes = [fleet.scenario.from_latlon(*fleet.route_ahead(k, 200.0)) for k in range(3)]
    fleet.step(500)
    for k, (x, y) in enumerate(routes):
        off = np.hypot(fleet.truth.x[:, k, None] - x, fleet.truth.y[:, k, None] - y).min(axis=1)
        driven = np.hypot(*np.diff([fleet.truth.x[:, k], fleet.truth.y[:, k]])).cumsum()
        assert off[1:][driven < 150.0].max() < 3.0
