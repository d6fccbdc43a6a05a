"""Tests of the delays of sensors. The bicycle model and the correlation over time shifts must equal
their definitions, and a known delay must be found.
"""

from __future__ import annotations

import numpy as np

from edge_agent.inputs.doctor.drive import RATE_HZ, find_median, median_of_others, sum_windows
from edge_agent.inputs.doctor.lags import (
    SLOWEST,
    _bicycle_yaw_rate,
    correlate_by_spectra,
    find_lags,
)
from schemas.numeric import FloatArray
from schemas.signals import CHANNELS, S
from schemas.vehicle import Vehicle, load_vehicle

CAR = load_vehicle("class:compact")


def integrate_step_by_step(speed: FloatArray, steering: FloatArray, car: Vehicle) -> FloatArray:
    """Return the yaw rate of the bicycle model, computed sample by sample: the linear equations of
    each step of the trapezoidal rule are solved one after the other.
    """
    a = car.cg_to_front_axle
    b = car.cg_to_rear_axle
    c_f, c_r = (4.0 * car.cornering_stiffness * arm / (a + b) for arm in (b, a))
    half = 0.5 / RATE_HZ
    motion = np.zeros(2)
    before = 0.0
    found = np.full(len(speed), np.nan)
    for k, (v, delta) in enumerate(zip(speed, steering, strict=True)):
        if not (v > SLOWEST and abs(delta) < 1.0):
            motion = np.zeros(2)
            before = 0.0
            continue
        system = np.array(
            [
                [-(c_f + c_r) / car.mass, b * c_r - a * c_f],
                [b * c_r - a * c_f, -(a * a * c_f + b * b * c_r)],
            ]
        )
        system /= [[v, car.mass * v], [car.yaw_inertia * v, car.yaw_inertia * v]]
        system[0, 1] -= v
        force = np.array([c_f / car.mass, a * c_f / car.yaw_inertia]) * half * (before + delta)
        right = motion + half * (system @ motion) + force
        motion = np.linalg.solve(np.eye(2) - half * system, right)
        before = delta
        found[k] = motion[1]
    return found


def test_sums_of_windows_equal_a_convolution_and_keep_errors_local() -> None:
    x = np.random.default_rng(0).normal(size=200)
    for width in (1, 2, 3, 25, 64, 101, 200):
        np.testing.assert_allclose(
            sum_windows(x, width), np.convolve(x, np.ones(width), "same"), atol=1e-12
        )
    spoiled = x.copy()
    spoiled[90] = 1e38
    np.testing.assert_array_equal(sum_windows(spoiled, 25)[:78], sum_windows(x, 25)[:78])
    np.testing.assert_array_equal(sum_windows(spoiled, 25)[103:], sum_windows(x, 25)[103:])


def test_medians_equal_their_definition() -> None:
    wheels = np.round(np.random.default_rng(0).normal(size=(101, 4)), 1)  # with equal values
    for count in (1, 2, 100, 101):
        assert find_median(wheels[:count, 0]) == np.median(wheels[:count, 0])
    others = [np.median(np.delete(wheels, i, axis=1), axis=1) for i in range(4)]
    np.testing.assert_array_equal(median_of_others(wheels), np.stack(others, axis=1))


def test_bicycle_model_equals_integration_step_by_step() -> None:
    rng = np.random.default_rng(0)
    n = 3000
    speed = np.abs(20.0 + np.cumsum(rng.normal(0.0, 0.5, n)))
    steering = 0.1 * np.sin(np.arange(n) / 40.0) + 0.01 * rng.normal(size=n)
    speed[500:520] = 0.0
    steering[[900, 1200, 1201]] = np.nan
    speed[1500:1600] = 60.0
    expected = integrate_step_by_step(speed, steering, CAR)
    found = _bicycle_yaw_rate(speed, steering, CAR)
    assert np.array_equal(np.isnan(found), np.isnan(expected))
    assert np.nanmax(np.abs(found - expected)) < 1e-12 * np.nanmax(np.abs(expected))


def test_correlation_by_spectra_equals_that_of_each_shift() -> None:
    rng = np.random.default_rng(1)
    n = 700
    most = 25
    left, right = rng.normal(size=(2, n))
    left[300:340] = np.nan
    right[[5, 200, 201, 690]] = np.nan
    among = rng.random(n) < 0.8
    among[: most + 1] = False
    among[n - most - 1 :] = False
    found = correlate_by_spectra(left, right, among, most)
    for k in range(-most, most + 1):
        other = np.roll(right, k)
        both = among & np.isfinite(left) & np.isfinite(other)
        assert abs(found[k + most] - np.corrcoef(left[both], other[both])[0, 1]) < 1e-10
    assert np.isnan(correlate_by_spectra(left, np.ones(n), among, most)).all(), "no variation"


def test_late_wheels_are_found_and_a_straight_drive_gives_no_finding() -> None:
    t = np.arange(0.0, 60.0, 0.01)
    yaw_rate = 0.2 * np.sin(t) + 0.1 * np.sin(2.3 * t + 1.0)
    late = 0.12
    signals = np.full((len(t), len(CHANNELS)), np.nan)
    signals[:, S.YAW_RATE] = yaw_rate
    turns = np.interp(t - late, t, yaw_rate)
    for wheel, track in enumerate((CAR.track_front,) * 2 + (CAR.track_rear,) * 2):
        side = (-0.5, 0.5)[wheel % 2] * track
        signals[:, S.OMEGA + wheel] = (15.0 + side * turns) / CAR.wheel_radius
    lags = find_lags(t, signals, CAR)
    assert list(lags) == ["wheel_lag"], "without a steering angle"
    assert abs(lags["wheel_lag"] - late - 0.013) < 0.002, "later by the lead of a sound car"
    assert find_lags(t, signals, CAR, names=["steer_lag"]) == {}
    signals[:, S.OMEGA : S.OMEGA + 4] = 15.0 / CAR.wheel_radius
    assert find_lags(t, signals, CAR) == {}
