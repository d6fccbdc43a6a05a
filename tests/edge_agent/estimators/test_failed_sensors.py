"""Tests that a wheel speed sensor that fails while the car drives is left out, so that a dry road
is not called icy, and that wheels which really lock or spin on ice still count.
"""

from __future__ import annotations

import numpy as np
import pytest

from edge_agent.app.estimator_factory import bank_of
from edge_agent.estimators.estimates import Estimates
from edge_agent.lab.simulation import DriveSetup, simulate_manoeuvre
from schemas.numeric import FloatArray
from schemas.signals import Health
from schemas.thresholds import CALLED_SHARE
from schemas.vehicle import Vehicle
from tests.edge_agent.estimators.drives import OMEGA, signals_of

DRY = 0.85
ICE = 0.15
FAILS = 300  # sample (at 3 s) at which the sensor fails


def record(name: str, mu: float, vehicle: str = "small") -> tuple[FloatArray, FloatArray, Vehicle]:
    """Return times, signals and vehicle file of a drive on a road of friction `mu`."""
    setup = DriveSetup(vehicle=vehicle, sensors="rough")
    log, known = simulate_manoeuvre(name, mu=mu, seed=11, setup=setup)
    return log["t"].to_numpy(), signals_of(log), known


def estimate(t: FloatArray, signals: FloatArray, known: Vehicle) -> Estimates:
    """Return the estimates of one drive."""
    return bank_of("aco-fckf", [known]).advance(t[:, None], signals[:, None])


def spoil(signals: FloatArray, fault: str, *wheels: int) -> FloatArray:
    """Return the signals with failed sensors: "frozen" at the last reading, "dead" (zero from FAILS
    on), or "always dead".
    """
    spoilt = signals.copy()
    for wheel in wheels:
        speed = spoilt[:, OMEGA][:, wheel]
        if fault == "frozen":
            speed[FAILS:] = speed[FAILS]
        else:
            speed[FAILS if fault == "dead" else 0 :] = 0.0
    return spoilt


@pytest.mark.parametrize("wheel", range(4))
@pytest.mark.parametrize("fault", ["frozen", "dead", "always dead"])
@pytest.mark.parametrize("name", ["pulses", "double-lane-change"])
def test_a_failed_wheel_sensor_does_not_look_like_ice(name: str, fault: str, wheel: int) -> None:
    t, signals, known = record(name, DRY)
    estimates = estimate(t, spoil(signals, fault, wheel), known)
    after = slice(FAILS, None)
    assert np.mean(estimates.p_slippery[after] > CALLED_SHARE) == 0.0
    assert np.mean(estimates.mu_upper[after] < DRY) < 0.05
    if name == "pulses" or fault != "frozen":  # at constant speed a frozen reading stays right
        assert np.mean(estimates.health[after] & int(Health.NO_WHEEL_SPEED) != 0) > 0.5


@pytest.mark.parametrize("wheels", [(0, 1), (2, 3), (0, 3)])
@pytest.mark.parametrize("fault", ["frozen", "dead"])
def test_two_sensors_that_fail_at_once_do_not_look_like_ice(
    fault: str, wheels: tuple[int, int]
) -> None:
    t, signals, known = record("pulses", DRY)
    estimates = estimate(t, spoil(signals, fault, *wheels), known)
    assert np.mean(estimates.p_slippery[FAILS:] > CALLED_SHARE) == 0.0
    assert np.mean(estimates.mu_upper[FAILS:] < DRY) < 0.05
    t, signals, known = record("pulses", ICE)
    estimates = estimate(t, spoil(signals, fault, *wheels), known)
    assert np.mean(estimates.mu_upper[FAILS + 200 :] < 0.4) > 0.8


@pytest.mark.parametrize("fault", ["frozen", "dead", "always dead"])
def test_ice_is_found_with_a_failed_wheel_sensor(fault: str) -> None:
    t, signals, known = record("pulses", ICE)
    estimates = estimate(t, spoil(signals, fault, 1), known)
    assert np.mean(estimates.mu_upper[FAILS + 200 :] < 0.4) > 0.9
    assert np.mean(estimates.mu_lower[FAILS:] > ICE + 0.05) < 0.05


def test_failed_sensor_is_found_if_the_wheels_are_read_in_turn() -> None:
    t, signals, known = record("pulses", DRY)
    spoilt = spoil(signals, "frozen", 0)
    for wheel in range(4):
        unread = np.arange(len(t)) % 4 != wheel
        spoilt[unread, OMEGA.start + wheel] = np.nan
    estimates = estimate(t, spoilt, known)
    assert np.mean(estimates.p_slippery[FAILS:] > CALLED_SHARE) == 0.0
    assert np.mean(estimates.mu_upper[FAILS:] < DRY) < 0.05


@pytest.mark.parametrize(("name", "brakes"), [("braking", True), ("acceleration", False)])
def test_wheels_that_lock_or_spin_are_not_left_out(name: str, brakes: bool) -> None:
    t, signals, known = record(name, ICE)
    if brakes:  # one wheel has no anti-lock control and locks within .1 s
        lock = slice(FAILS - 150, FAILS - 140)
        signals[lock, OMEGA.start] *= np.linspace(1.0, 0.0, 10)
        signals[lock.stop :, OMEGA.start] = 0.0
    estimates = estimate(t, signals, known)
    assert not np.any(estimates.health & int(Health.NO_WHEEL_SPEED))
    assert np.mean(estimates.mu_upper[FAILS:] < 0.4) > 0.95


@pytest.mark.parametrize(("hold", "step"), [(10, 0.0), (20, 0.0), (5, 0.9), (1, 0.9)])
@pytest.mark.parametrize(("name", "mu"), [("pulses", DRY), ("acceleration", ICE)])
def test_coarse_or_slow_wheel_speed_has_not_failed(
    name: str, mu: float, hold: int, step: float
) -> None:
    t, signals, known = record(name, mu, "van")
    slow = signals.copy()
    for wheel in range(4):  # the bus sends the wheels one after the other
        rows = np.maximum((np.arange(len(t)) + wheel) // hold * hold - wheel, 0)
        slow[:, OMEGA.start + wheel] = signals[rows, OMEGA.start + wheel]
    if step:
        slow[:, OMEGA] = np.round(slow[:, OMEGA] / step) * step
    estimates = estimate(t, slow, known)
    assert np.mean(estimates.health & int(Health.NO_WHEEL_SPEED) != 0) < 0.01
