"""Tests that a long turn in which nothing changes does not determine the friction. On a dry road,
the upper end of the interval stays above the true friction, although the vehicle file states a
wrong steering ratio. Ice in the same turns is found.
"""

from __future__ import annotations

import numpy as np
import pytest

from edge_agent.app.estimator_factory import bank_of
from edge_agent.estimators.estimates import Estimates
from edge_agent.lab.simulation import DriveSetup, simulate_manoeuvre
from schemas.signals import S
from tests.edge_agent.estimators.drives import signals_of

# Manoeuvre, and measured over true steering angle.
TURNS = [
    ("constant-radius", 1.0),
    ("low-turn", 1.0),
    ("street-corners", 1.0),
    ("street-corners", 1.08),
    ("parking-ramp", 1.0),
    ("parking-ramp", 0.92),
    ("parking-ramp", 1.08),
]
DRY = 0.85
ICE = 0.15  # in each turn the cars slide on it


def turn(name: str, gain: float, mu: float, vehicle: str, seed: int, seconds: float) -> Estimates:
    """Return the estimates of a drive: a circle of 40 m radius at 40 km/h or of 8 m at 13 km/h,
    or several turns at a street corner.
    """
    log, known = simulate_manoeuvre(
        name, mu=mu, seed=seed, duration_s=seconds, setup=DriveSetup(vehicle=vehicle)
    )
    signals = signals_of(log)
    signals[:, S.DELTA : S.DELTA + 2] *= gain
    return bank_of("aco-fckf", [known]).advance(log["t"].to_numpy()[:, None], signals[:, None])


@pytest.mark.parametrize("vehicle", ["small", "sedan", "van"])
@pytest.mark.parametrize(("name", "gain"), TURNS)
def test_turn_on_a_dry_road_does_not_exclude_the_true_friction(
    name: str, gain: float, vehicle: str
) -> None:
    for seed in (801, 802):
        estimates = turn(name, gain, DRY, vehicle, seed, seconds=40.0)
        assert np.mean(estimates.mu_upper < DRY) < 0.02
        assert np.mean(estimates.mu_lower > DRY) < 0.02


@pytest.mark.parametrize("vehicle", ["small", "sedan", "van"])
@pytest.mark.parametrize(("name", "gain"), TURNS)
def test_ice_in_the_same_turn_is_found(name: str, gain: float, vehicle: str) -> None:
    for seed in (801, 802):
        estimates = turn(name, gain, ICE, vehicle, seed, seconds=12.0)
        assert np.mean(estimates.mu_upper[500:] < 0.45) > 0.8
        assert np.mean(estimates.mu_lower[500:] > ICE) < 0.02
