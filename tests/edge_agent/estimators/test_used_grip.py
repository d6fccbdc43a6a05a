"""Tests of the reported grip in use (the part of the friction that the tyres use, as a friction
value). It must follow the acceleration and never exceed the limit of a tyre. Torque known on one
axle only must not harm the speed estimate.
"""

from __future__ import annotations

from functools import cache

import numpy as np
import pyarrow as pa
import pytest

from edge_agent.app.estimator_factory import bank_of
from edge_agent.estimators import Estimates
from edge_agent.estimators.friction_mixture.block.used_grip import MOST_USED
from edge_agent.lab.simulation import DriveSetup, simulate_manoeuvre
from schemas.numeric import FloatArray
from schemas.signals import S
from schemas.thresholds import GRAVITY
from schemas.vehicle import Vehicle
from tests.edge_agent.estimators.drives import TORQUE, drive, signals_of

FRONT = slice(S.TORQUE, S.TORQUE + 2)
REAR = slice(S.TORQUE + 2, S.TORQUE + 4)
WORSE = 1.1  # largest ratio of the two speed errors, in addition to SLACK_M_S
SLACK_M_S = 0.02


@cache
def stop(mu: float, seed: int) -> tuple[pa.Table, Vehicle]:
    """Simulate a stop with anti-lock brakes. Return the log and the vehicle data."""
    return simulate_manoeuvre("braking", mu=mu, seed=seed, setup=DriveSetup(sensors="mems"))


def speed_error(mu: float, missing: slice, *, engine_only: bool = False) -> float:
    """Return the RMS error of the estimated v_x [m/s] in three stops on a road of friction `mu`,
    without the signals in the columns `missing`. If `engine_only`, the torque signals contain drive
    torque but no brake torque.
    """
    squares = []
    for seed in range(1, 4):
        log, vehicle = stop(mu, seed)
        signals = signals_of(log)
        signals[:, missing] = np.nan
        if engine_only:
            signals[:, TORQUE] = np.maximum(signals[:, TORQUE], 0.0)
        t = log["t"].to_numpy()
        estimates = bank_of("aco-fckf", [vehicle]).advance(t[:, None], signals[:, None])
        error = estimates.vx[:, 0] - log["true_vx"].to_numpy()
        squares.append(np.mean(error[t > 1.0] ** 2))
    return float(np.sqrt(np.mean(squares)))


def drive_without_torque(name: str, mu: float) -> tuple[FloatArray, Estimates]:
    """Simulate a manoeuvre and delete its torque signals. Return the remaining signals (T, 18) and
    the estimates from them.
    """
    t, signals, vehicle = drive(name, mu)
    signals = signals.copy()
    signals[:, TORQUE] = np.nan
    return signals, bank_of("aco-fckf", [vehicle]).advance(t[:, None], signals[:, None])


@pytest.mark.parametrize("name", ["braking", "slalom"])
@pytest.mark.parametrize("mu", [0.3, 0.9])
def test_grip_in_use_is_near_the_acceleration_and_never_beyond_a_tyre(name: str, mu: float) -> None:
    signals, estimates = drive_without_torque(name, mu)
    used = estimates.mu_utilised[:, 0]
    reached = np.percentile(np.hypot(signals[:, S.AX], signals[:, S.AY]), 90) / GRAVITY
    assert used.max() <= MOST_USED
    assert 0.7 * reached < np.percentile(used, 90) < 1.4 * reached


@pytest.mark.parametrize("missing", [FRONT, REAR])
@pytest.mark.parametrize("mu", [0.3, 0.8])
def test_torque_of_one_axle_helps_the_speed_of_a_stop(missing: slice, mu: float) -> None:
    assert speed_error(mu, missing) < WORSE * speed_error(mu, TORQUE) + SLACK_M_S


@pytest.mark.parametrize("missing", [FRONT, REAR])
@pytest.mark.parametrize("mu", [0.3, 0.8])
def test_torque_of_an_engine_does_not_harm_the_speed_of_a_stop(missing: slice, mu: float) -> None:
    alone = speed_error(mu, missing, engine_only=True)
    assert alone < WORSE * speed_error(mu, TORQUE) + SLACK_M_S
