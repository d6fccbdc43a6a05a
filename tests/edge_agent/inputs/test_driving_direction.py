"""Tests of the direction of travel of a car whose wheel-speed sensors do not report it."""

from __future__ import annotations

import math
from itertools import pairwise

import numpy as np
import pytest

from edge_agent.app.estimator_factory import bank_of
from edge_agent.inputs.driving_direction import DrivingDirection, sign_wheels
from edge_agent.lab.simulation import DriveSetup, simulate_manoeuvre
from edge_agent.lab.simulation.manoeuvres import MANOEUVRES, Manoeuvre, Moment, hold, smooth_step
from schemas.numeric import FloatArray
from schemas.signals import S
from schemas.vehicle import Vehicle
from tests.edge_agent.estimators.drives import signals_of

RATE_HZ = 100.0
LAP_S = 22.0  # [s] from standstill to standstill
SPEED_M_S = 3.0


def park(now: Moment) -> tuple[float, float]:
    """Return the controls (road-wheel angle, acceleration) for a turn to the left, a turn to the
    right, and a stop, again and again.
    """
    lap = now.t % LAP_S
    left = smooth_step((lap - 2.0) / 1.5) - smooth_step((lap - 9.0) / 1.5)
    right = smooth_step(lap - 12.0) - smooth_step(lap - 16.0)
    return 0.4 * (left - right), -2.0 if lap > 17.0 else min(hold(now), 1.5)


@pytest.fixture
def parking(
    monkeypatch: pytest.MonkeyPatch, request: pytest.FixtureRequest
) -> tuple[FloatArray, Vehicle]:
    """Return the signals (T, 18) and the vehicle of three laps of `park` on a dry road."""
    monkeypatch.setitem(MANOEUVRES, "park", Manoeuvre(park, SPEED_M_S, 3.0 * LAP_S, 0.9, "parking"))
    log, known = simulate_manoeuvre("park", seed=5, setup=DriveSetup(vehicle=request.param))
    return signals_of(log), known


def with_second_lap_backwards(signals: FloatArray) -> FloatArray:
    """Return the signals with the second lap played backwards: the car drives it in reverse. This
    changes the sign of the speeds, but not of the accelerations.
    """
    begin, end = (round(lap * LAP_S * RATE_HZ) for lap in (1, 2))
    backwards = signals.copy()
    backwards[begin:end] = signals[begin:end][::-1]
    backwards[begin:end, S.YAW_RATE] *= -1.0
    backwards[begin:end, S.OMEGA : S.OMEGA + 4] *= -1.0
    return backwards


def times_of(signals: FloatArray) -> FloatArray:
    return np.arange(len(signals)) / RATE_HZ


def without_signs(signals: FloatArray) -> FloatArray:
    sizes = signals.copy()
    sizes[:, S.OMEGA : S.OMEGA + 4] = np.abs(signals[:, S.OMEGA : S.OMEGA + 4])
    return sizes


def upper_ends(signals: FloatArray, vehicle: Vehicle) -> FloatArray:
    bank = bank_of("aco-fckf", [vehicle])
    return bank.advance(times_of(signals)[:, None], signals[:, None]).mu_upper[:, 0]


@pytest.mark.parametrize("parking", ["small", "sedan", "van"], indirect=True)
def test_a_car_in_reverse_on_a_dry_road_is_not_on_ice(parking: tuple[FloatArray, Vehicle]) -> None:
    signals, vehicle = parking
    backwards = with_second_lap_backwards(signals)
    measured = without_signs(backwards)
    signed = sign_wheels(times_of(measured), measured, vehicle)
    assert upper_ends(signed, vehicle)[100:].min() > 0.8
    assert upper_ends(measured, vehicle).min() < 0.3  # what the sensors alone would report
    fast = np.abs(backwards[:, S.OMEGA]) * vehicle.wheel_radius > 1.0
    assert np.array_equal(np.sign(signed[fast, S.OMEGA]), np.sign(backwards[fast, S.OMEGA]))


@pytest.mark.parametrize("parking", ["sedan"], indirect=True)
def test_a_car_that_drives_forwards_is_left_alone(parking: tuple[FloatArray, Vehicle]) -> None:
    signals, vehicle = parking
    t = times_of(signals)
    assert sign_wheels(t, signals, vehicle) is signals
    coarse = signals.copy()
    coarse[:, S.OMEGA : S.OMEGA + 4][coarse[:, S.OMEGA : S.OMEGA + 4] < 3.0] = 0.0  # below 1 m/s
    assert sign_wheels(t, coarse, vehicle) is coarse
    rolling = signals[500:1500]
    assert sign_wheels(t[500:1500], rolling, vehicle) is rolling


@pytest.mark.parametrize("parking", ["sedan"], indirect=True)
def test_speeds_with_sign_are_left_alone(parking: tuple[FloatArray, Vehicle]) -> None:
    signals, vehicle = parking
    backwards = with_second_lap_backwards(signals)
    assert np.nanmin(sign_wheels(times_of(signals), backwards, vehicle)[:, S.OMEGA]) == np.nanmin(
        backwards[:, S.OMEGA]
    )


@pytest.mark.parametrize("parking", ["sedan"], indirect=True)
def test_blocks_of_any_length_give_the_same_signs(parking: tuple[FloatArray, Vehicle]) -> None:
    signals, vehicle = parking
    measured = without_signs(with_second_lap_backwards(signals))
    t = times_of(measured)
    whole = sign_wheels(t, measured, vehicle)
    direction = DrivingDirection(vehicle)
    ends = [0, 1, 40, 2200, 2231, len(t)]
    parts = [direction.advance(t[a:b], measured[a:b]) for a, b in pairwise(ends)]
    assert np.array_equal(np.concatenate(parts), whole, equal_nan=True)
    assert not math.isclose(np.nanmin(whole[:, S.OMEGA]), np.nanmin(measured[:, S.OMEGA]))
