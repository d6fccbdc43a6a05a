"""Tests of the default estimator on sloping roads, and with sensors that are misaligned or not
synchronous. It must not take any of these for ice.
"""

from __future__ import annotations

import numpy as np
import pytest

from edge_agent.adaptation.memberships import Memberships
from edge_agent.estimators import Estimates, create
from schemas.numeric import FloatArray
from schemas.signals import Health, S
from tests.edge_agent.estimators.drives import OMEGA, TORQUE, drive, drive_over_joints

GRAVITY = 9.81
PRIOR_WIDTH = 0.9 * 1.15
DELTA = slice(S.DELTA, S.DELTA + 2)


def run(t: FloatArray, signals: FloatArray, vehicle: object) -> Estimates:
    bank = create("fckf", [vehicle], memberships=Memberships())  # type: ignore[list-item]
    return bank.advance(t[:, None], signals[:, None])


def without_torque(signals: FloatArray) -> FloatArray:
    changed = signals.copy()
    changed[:, TORQUE] = np.nan
    return changed


def at_rest(seconds: float, ax: float, torque: float) -> tuple[FloatArray, FloatArray]:
    rng = np.random.default_rng(3)
    t = np.arange(0.0, seconds, 0.01)
    signals = np.zeros((len(t), 18))
    signals[:, :3] = rng.normal(0.0, (0.05, 0.05, 0.002), (len(t), 3))
    signals[:, S.AX] += ax
    signals[:, TORQUE] = torque
    return t, signals


@pytest.mark.parametrize("torque", [0.0, np.nan])
def test_car_standing_on_a_slope_learns_nothing_about_friction(torque: float) -> None:
    vehicle = drive("straight", 0.85)[2]
    estimates = run(*at_rest(40.0, 0.05 * GRAVITY, torque), vehicle)
    assert np.abs(estimates.vx).max() < 0.2
    assert (estimates.mu_upper - estimates.mu_lower).min() > 0.8 * PRIOR_WIDTH


def test_a_car_that_starts_after_it_stood_is_not_held_back() -> None:
    t, signals, vehicle = drive("acceleration", 0.85)
    rest, still = at_rest(5.0, 0.3, 0.0)
    go = signals.copy()
    go[:, S.AX] += 0.3
    go[:, OMEGA] -= go[:1, OMEGA]  # the wheel speeds start at 0, as after a standstill
    estimates = run(
        np.concatenate([rest, t - t[0] + 5.0]), np.concatenate([still, without_torque(go)]), vehicle
    )
    gained = vehicle.wheel_radius * (go[-50:, OMEGA].mean())
    assert abs(estimates.vx[-50:].mean() - gained) < 0.1 * gained


def test_slope_without_torque_is_no_ice_and_agreeing_wheels_give_speed() -> None:
    t, signals, vehicle = drive("straight", 0.85, seconds=20.0)
    climbing = without_torque(signals)
    climbing[:, S.AX] += 0.07 * GRAVITY
    estimates = run(t, climbing, vehicle)
    rolling = vehicle.wheel_radius * climbing[:, OMEGA].mean(axis=1)
    assert np.abs(estimates.vx[200:, 0] - rolling[200:]).max() < 0.3
    assert estimates.mu_upper.min() > 0.7


def test_joints_in_the_road_are_no_ice() -> None:
    estimates = run(*drive_over_joints())
    assert estimates.mu_upper[50:].min() > 0.7


def test_no_upper_end_lies_below_the_grip_in_use_even_beyond_the_grid() -> None:
    vehicle = drive("straight", 0.85)[2]
    t = np.arange(0.0, 4.0, 0.01)
    ax = np.where(t > 1.0, -1.3 * GRAVITY, 0.0)
    speed = 50.0 + np.cumsum(ax) * 0.01
    signals = np.zeros((len(t), 18))
    signals[:, S.AX] = ax
    signals[:, OMEGA] = (speed * np.where(t > 1.0, 0.95, 1.0) / vehicle.wheel_radius)[:, None]
    estimates = run(t, without_torque(signals), vehicle)
    assert estimates.mu_upper[150:, 0].min() > 1.28
    assert (estimates.mu_upper >= estimates.mu).all()


def test_driven_axle_is_found_without_torque_and_friction_is_right() -> None:
    t, signals, vehicle = drive("firm-acceleration", 0.85)
    estimates = run(t, without_torque(signals), vehicle)
    assert estimates.mu_lower[-1, 0] < 0.85 < estimates.mu_upper[-1, 0]
    # The measurement raised the lower bound above that of the prior.
    assert estimates.mu_lower[-1, 0] > 0.3


def test_late_steering_contradicts_the_model_and_restores_the_prior() -> None:
    t, signals, vehicle = drive("sine", 0.85, seconds=30.0)
    late = signals.copy()
    late[:, DELTA] = np.roll(signals[:, DELTA], 80, axis=0) + 0.1 * np.sin(5.0 * t)[:, None]
    estimates = run(t, late, vehicle)
    assert estimates.health[-1, 0] & Health.CONTRADICTION
    assert (estimates.mu_upper - estimates.mu_lower)[-1, 0] > 0.8 * PRIOR_WIDTH
    assert not (run(t, signals, vehicle).health & Health.CONTRADICTION).any()


@pytest.mark.parametrize("road", [0.85, 0.7])
def test_belief_in_ice_from_wrong_steering_does_not_hide_the_contradiction(road: float) -> None:
    t, signals, vehicle = drive("sine", road, seconds=30.0)
    wrong = signals.copy()
    wrong[:, DELTA] = np.roll(signals[:, DELTA], 40, axis=0) + 0.15 * np.sin(3.0 * t)[:, None]
    estimates = run(t, wrong, vehicle)
    assert estimates.mu_upper.min() < 0.5
    assert estimates.health[-1, 0] & Health.CONTRADICTION


def test_a_wheel_speed_that_is_decoded_wrong_is_refused() -> None:
    t, signals, vehicle = drive("slalom", 0.3, seconds=8.0)
    wrong = signals.copy()
    silent = signals.copy()
    hit = np.random.default_rng(5).random(len(t)) < 0.7
    wrong[hit, S.OMEGA] += 142.0 / vehicle.wheel_radius
    silent[hit, S.OMEGA] = np.nan
    estimates = run(t, wrong, vehicle)
    assert np.array_equal(estimates.vx, run(t, silent, vehicle).vx)
    assert (estimates.health[hit] & Health.OUTLIER).all()
