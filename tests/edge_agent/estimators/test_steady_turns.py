"""Tests that a long turn in which nothing changes does not determine the friction. On a dry road,
the upper end of the interval stays above the true friction. Ice in the same turns is found.
"""

from __future__ import annotations

import numpy as np
import pytest

from edge_agent.app.estimator_factory import bank_of
from edge_agent.estimators.estimates import Estimates
from edge_agent.lab.simulation import DriveSetup, simulate_manoeuvre
from tests.edge_agent.estimators.drives import signals_of

TURNS = ["constant-radius", "low-turn", "street-corners"]
DRY = 0.85


def turn(name: str, mu: float, vehicle: str, seed: int, seconds: float = 40.0) -> Estimates:
    """Return the estimates of a drive: a circle of 40 m radius at 40 km/h, or several turns
    at a street corner.
    """
    log, known = simulate_manoeuvre(
        name, mu=mu, seed=seed, duration_s=seconds, setup=DriveSetup(vehicle=vehicle)
    )
    return bank_of("aco-fckf", [known]).advance(
        log["t"].to_numpy()[:, None], signals_of(log)[:, None]
    )


@pytest.mark.parametrize("vehicle", ["small", "sedan", "van"])
@pytest.mark.parametrize("name", TURNS)
def test_a_turn_on_a_dry_road_leaves_its_friction_possible(name: str, vehicle: str) -> None:
    for seed in (801, 802):
        estimates = turn(name, DRY, vehicle, seed)
        assert np.mean(estimates.mu_upper < DRY) < 0.02
        assert np.mean(estimates.mu_lower > DRY) < 0.02


@pytest.mark.parametrize("vehicle", ["small", "sedan", "van"])
@pytest.mark.parametrize("name", TURNS)
def test_ice_in_the_same_turn_is_found(name: str, vehicle: str) -> None:
    for seed in (801, 802):
        estimates = turn(name, 0.2, vehicle, seed, seconds=12.0)
        assert np.mean(estimates.mu_upper[500:] < 0.45) > 0.6
        assert np.mean(estimates.mu_lower[500:] > 0.2) < 0.02
