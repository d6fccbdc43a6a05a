"""Tests of the default estimator at walking pace: wheels that spin on ice, and starts on a dry
road.
"""

from __future__ import annotations

import numpy as np
import pytest

from edge_agent.app.estimator_factory import bank_of
from edge_agent.estimators.estimates import Estimates
from edge_agent.lab.evaluation.batch import DriveSet, simulate_realistic
from edge_agent.lab.evaluation.scenarios import OTHERS, PAPERS
from edge_agent.lab.seeds import FIGURES
from edge_agent.lab.simulation import DriveSetup, simulate_manoeuvre
from schemas.numeric import FloatArray
from tests.edge_agent.estimators.drives import TORQUE, signals_of


def start(mu: float, vehicle: str, seed: int) -> tuple[Estimates, FloatArray]:
    """Simulate a car that accelerates from walking pace without torque signals. Return the
    estimates and the true speed (T,) [m/s].
    """
    log, known = simulate_manoeuvre(
        "acceleration",
        mu=mu,
        speed=0.6,
        seed=seed,
        duration_s=5.0,
        setup=DriveSetup(sensors="rough", vehicle=vehicle),
    )
    signals = signals_of(log)
    signals[:, TORQUE] = np.nan
    estimates = bank_of("aco-fckf", [known]).advance(log["t"].to_numpy()[:, None], signals[:, None])
    return estimates, log["true_vx"].to_numpy()


@pytest.fixture(scope="module")
def lane_changes() -> DriveSet:
    """Lane changes of a car that accelerates from 4 to 40 km/h on a dry road."""
    return simulate_realistic((PAPERS | OTHERS)["001.gaining.dlc"], [FIGURES + 6])


@pytest.mark.parametrize("vehicle", ["van", "sedan"])
def test_wheels_that_spin_on_ice_are_noticed_below_three_metres_per_second(vehicle: str) -> None:
    for seed in range(5, 9):
        estimates, speed = start(0.15, vehicle, seed)
        slow = speed < 3.0
        assert estimates.p_slippery[slow, 0][-1] > 0.95
        assert estimates.mu_upper[slow, 0][-1] < 0.4


@pytest.mark.parametrize("vehicle", ["van", "sedan"])
def test_a_start_on_a_dry_road_is_not_slippery(vehicle: str) -> None:
    for seed in range(5, 9):
        estimates, _ = start(0.8, vehicle, seed)
        assert estimates.mu_upper[:, 0].min() > 0.8
        assert estimates.p_slippery[200:, 0].max() < 0.1


def test_nothing_is_learned_about_friction_at_standstill() -> None:
    estimates, speed = start(0.15, "van", 5)
    standing = speed < 1.0
    assert np.ptp(estimates.mu_upper[standing, 0][50:]) < 0.02


def test_a_node_that_was_wrong_at_walking_pace_does_not_win_later(lane_changes: DriveSet) -> None:
    (vehicle,) = lane_changes.vehicles
    estimates = bank_of("aco-fckf", [vehicle]).advance(lane_changes.t, lane_changes.signals)
    # A refund of penalties that had never reduced a probability gave .34.
    assert estimates.mu_upper.min() > 0.8


def test_no_penalty_is_charged_at_walking_pace(
    lane_changes: DriveSet,
) -> None:
    (vehicle,) = lane_changes.vehicles
    bank = bank_of("aco-fckf", [vehicle])
    slow = int(np.searchsorted(lane_changes.t[:, 0], 1.0))
    bank.advance(lane_changes.t[:slow], lane_changes.signals[:slow])
    assert lane_changes.truth["true_vx"][:slow].max() < 1.5
    assert not bank.memory("penalty").any()


def turn_at_corners(mu: float, sensors: str, slope: float, seed: int) -> tuple[Estimates, float]:
    """Simulate turns at street corners. Return the estimates, and the largest error of v_y
    [m/s].
    """
    setup = DriveSetup(sensors=sensors, slope=slope)
    log, known = simulate_manoeuvre("street-corners", mu=mu, seed=seed, setup=setup)
    estimates = bank_of("aco-fckf", [known]).advance(
        log["t"].to_numpy()[:, None], signals_of(log)[:, None]
    )
    return estimates, float(np.abs(estimates.vy[:, 0] - log["true_vy"].to_numpy()).max())


@pytest.mark.parametrize("sensors", ["mems", "rough"])
@pytest.mark.parametrize("slope", [0.08, -0.08])
def test_a_turn_at_a_street_corner_on_a_hill_is_slippery_only_on_ice(
    slope: float, sensors: str
) -> None:
    for seed in range(4):
        estimates, error = turn_at_corners(0.85, sensors, slope, seed)
        # In the turn the slope becomes a bank. If the filter assumes the same bank as before, v_y
        # is wrong by up to .48.
        assert error < 0.15
        assert estimates.p_slippery.max() < 0.9
        estimates, _ = turn_at_corners(0.15, sensors, slope, seed)
        assert estimates.p_slippery.max() > 0.95
