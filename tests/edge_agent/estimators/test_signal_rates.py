"""Tests that signals with fewer readings than the log has rows (NaN between them), and lost rows,
neither hide ice nor report it on a dry road, and that the speed stays right.
"""

from __future__ import annotations

import numpy as np
import pytest

from edge_agent.app.estimator_factory import bank_of
from edge_agent.lab.simulation import DriveSetup, simulate_manoeuvre
from schemas.numeric import FloatArray
from schemas.signals import S
from tests.edge_agent.estimators.drives import signals_of

DRY = 0.85
ICE = 0.15
CARS = [("small", 811), ("sedan", 812), ("van", 813)]
ROWS_HZ = 100
FIRST = 300  # number of samples (3 s) that are not judged
GROUPS = {
    "inertial": slice(S.AX, S.YAW_RATE + 1),
    "yaw rate": slice(S.YAW_RATE, S.YAW_RATE + 1),
    "steering": slice(S.DELTA, S.DELTA + 4),
    "wheel speeds": slice(S.OMEGA, S.OMEGA + 4),
    "torques": slice(S.TORQUE, S.TORQUE + 4),
}


def lose_rows(signals: FloatArray) -> None:
    """Drop 30 % of the rows at random, as a bad connection does."""
    signals[np.random.default_rng(1).random(len(signals)) < 0.3] = np.nan


def thin(signals: FloatArray, group: str, rate: int) -> None:
    """Keep `rate` readings per second of a group of channels."""
    missing = np.arange(len(signals)) % (ROWS_HZ // rate) != 0
    signals[missing, GROUPS[group]] = np.nan


@pytest.mark.parametrize("group", [*GROUPS, "rows"])
@pytest.mark.parametrize("manoeuvre", ["stop-and-go", "pulses"])
@pytest.mark.parametrize("mu", [DRY, ICE])
def test_slow_signals_leave_estimates_right(mu: float, manoeuvre: str, group: str) -> None:
    false_grip = []
    for vehicle, seed in CARS:
        log, known = simulate_manoeuvre(
            manoeuvre, mu=mu, seed=seed, setup=DriveSetup(vehicle=vehicle)
        )
        signals = signals_of(log)
        if group == "rows":
            lose_rows(signals)
        else:
            thin(signals, group, rate=10)
        t = log["t"].to_numpy()[:, None]
        estimates = bank_of("aco-fckf", [known]).advance(t, signals[:, None])
        lower = estimates.mu_lower[FIRST:, 0]
        upper = estimates.mu_upper[FIRST:, 0]
        false_grip.append(np.mean(lower > mu + 0.05))
        assert np.mean(upper < mu - 0.05) < 0.06
        assert np.mean(upper < 0.45) > 0.7 if mu == ICE else np.all(upper > 0.45)
        error = estimates.vx[FIRST:, 0] - log["true_vx"].to_numpy()[FIRST:]
        assert np.sqrt(np.mean(error**2)) < 0.5
    assert np.mean(false_grip) < 0.01
