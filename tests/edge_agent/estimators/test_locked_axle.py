"""Tests of the default estimator in a car with a locked rear axle. In a turn, its rear wheels slip
in opposite directions and turn the car back. The filter must not take this moment for a slippery
road, and must still find ice.
"""

from __future__ import annotations

from dataclasses import replace
from functools import cache

import numpy as np
import pyarrow as pa
import pytest

from edge_agent.app.estimator_factory import bank_of
from edge_agent.inputs.correct import correct_log
from edge_agent.lab.simulation import PRESETS, DriveSetup, simulate_manoeuvre
from schemas.numeric import FloatArray
from schemas.signals import CHANNELS
from schemas.thresholds import SLIPPERY_MU
from schemas.vehicle import Vehicle

SETTLED_S = 3.0


def locked_setup() -> DriveSetup:
    """Return a setup with a car that drives its locked rear axle."""
    car = PRESETS["sedan"]
    changes = {"rear_axle_locked": True, "drive_split_front": 0.0}
    return DriveSetup(vehicle=replace(car, vehicle=car.vehicle.model_copy(update=changes)))


@cache
def turn(name: str, speed: float, mu: float) -> tuple[pa.Table, Vehicle]:
    """Return log and vehicle of a manoeuvre of the locked car at `speed` [m/s] on friction `mu`."""
    return simulate_manoeuvre(
        name, mu=mu, speed=speed, seed=1, duration_s=10.0, setup=locked_setup()
    )


def run(log: pa.Table, vehicle: Vehicle) -> tuple[FloatArray, FloatArray]:
    """Return the error of v_y (T,) [m/s] and the interval of the friction (T, 2) after the first
    seconds of a log.
    """
    t = log["t"].to_numpy()
    signals = np.stack([log[c].to_numpy(zero_copy_only=False) for c in CHANNELS], axis=-1)
    signals = correct_log(t, signals.astype(float), vehicle)
    estimate = bank_of("aco-fckf", [vehicle]).advance(t[:, None], signals[:, None])
    settled = t > SETTLED_S
    error = np.asarray(estimate.vy)[:, 0] - log["true_vy"].to_numpy()
    interval = np.stack([estimate.mu_lower[:, 0], estimate.mu_upper[:, 0]], axis=-1)
    return error[settled], interval[settled]


def test_locked_rear_wheels_turn_as_one_and_widen_the_turn() -> None:
    log, _ = turn("j-turn", 8.0, 0.9)
    free = simulate_manoeuvre("j-turn", mu=0.9, speed=8.0, seed=1, duration_s=10.0)[0]
    settled = log["t"].to_numpy() > SETTLED_S
    rear = log["omega_rr"].to_numpy() - log["omega_rl"].to_numpy()
    front = log["omega_fr"].to_numpy() - log["omega_fl"].to_numpy()
    assert abs(np.mean(rear[settled])) < 0.05 * abs(np.mean(front[settled]))
    locked_rate, free_rate = (
        np.mean(one["true_yaw_rate"].to_numpy()[settled]) for one in (log, free)
    )
    assert 0.3 * free_rate < locked_rate < 0.95 * free_rate


@pytest.mark.parametrize(("name", "speed"), [("j-turn", 8.0), ("constant-radius", 14.0)])
def test_moment_of_a_locked_axle_is_not_taken_for_ice(name: str, speed: float) -> None:
    """Check turns on dry road: without the moment in the filter, the first is called slippery all
    the time, and the intervals of both do not contain the friction.
    """
    log, vehicle = turn(name, speed, 0.9)
    error, interval = run(log, vehicle)
    assert np.sqrt(np.mean(error**2)) < 0.05
    assert not np.any(interval[:, 1] < SLIPPERY_MU)
    assert np.mean((interval[:, 0] <= 0.9) & (interval[:, 1] >= 0.9)) > 0.95


@pytest.mark.parametrize(
    ("name", "speed", "mu"), [("low-turn", 8.0, 0.2), ("sine", 8.0, 0.15), ("slalom", 8.0, 0.25)]
)
def test_ice_is_found_with_a_locked_axle(name: str, speed: float, mu: float) -> None:
    error, interval = run(*turn(name, speed, mu))
    assert np.sqrt(np.mean(error**2)) < 0.05
    assert np.mean(interval[:, 1] < SLIPPERY_MU) > 0.9
    assert np.mean((interval[:, 0] <= mu) & (mu <= interval[:, 1])) > 0.9
