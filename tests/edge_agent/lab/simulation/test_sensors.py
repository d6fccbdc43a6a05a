"""Tests of simulated sensors: their errors must have the statistics that the table of sensor errors
states.
"""

from __future__ import annotations

import numpy as np
import pyarrow as pa
import pytest

from edge_agent.lab.simulation import (
    FAULTS,
    PRESETS,
    SENSORS,
    DriveSetup,
    Fault,
    simulate_manoeuvre,
)
from edge_agent.lab.simulation.counter_rng import key_of, normal, uniform
from edge_agent.lab.simulation.faults import apply_faults
from edge_agent.lab.simulation.place import GOTHENBURG
from edge_agent.lab.simulation.presets import KNOWN
from schemas.errors import InputError
from schemas.numeric import FloatArray
from schemas.signals import CHANNELS


def column(log: pa.Table, name: str) -> FloatArray:
    return np.asarray(log[name].to_numpy(zero_copy_only=False), dtype=np.float64)


def error(log: pa.Table, name: str) -> FloatArray:
    return column(log, name) - column(log, f"true_{name}")


def test_hashed_numbers_are_normal_and_uniform_and_streams_are_unrelated() -> None:
    key = key_of(1, 2)
    other = key_of(2, 1)
    a = np.array([normal(key, k) for k in range(40_000)])
    b = np.array([normal(other, k) for k in range(40_000)])
    u = np.array([uniform(key, k) for k in range(40_000)])
    assert abs(a.mean()) < 0.02
    assert a.std() == pytest.approx(1.0, abs=0.02)
    assert np.mean(a**4) == pytest.approx(3.0, abs=0.15)
    assert abs(np.corrcoef(a, b)[0, 1]) < 0.02
    assert abs(np.corrcoef(a[1:], a[:-1])[0, 1]) < 0.02
    np.testing.assert_allclose(np.histogram(u, 10, (0, 1))[0], 4000, rtol=0.06)
    assert ((u > 0) & (u < 1)).all()


def test_ideal_sensors_measure_the_true_values() -> None:
    log, vehicle = simulate_manoeuvre("sine", setup=DriveSetup(sensors="ideal"))
    for name in ("ax", "ay", "yaw_rate"):
        np.testing.assert_array_equal(error(log, name), 0.0)
    assert vehicle == PRESETS["sedan"].vehicle


def test_white_noise_has_the_size_of_the_table() -> None:
    log, _ = simulate_manoeuvre("straight", duration_s=60.0)
    for name, std in (("ax", 0.05), ("ay", 0.05), ("yaw_rate", 0.002)):
        assert error(log, name).std() == pytest.approx(std, rel=0.05)
    for name, std in (("delta_fl", 0.001), ("omega_rr", 0.03), ("torque_rl", 2.0)):
        late = column(log, name)[3000:]
        assert (np.diff(late) / np.sqrt(2.0)).std() == pytest.approx(std, rel=0.1)


def test_offsets_and_gain_are_constant_in_a_drive_and_vary_between_drives() -> None:
    logs = [simulate_manoeuvre("pulses", seed=seed)[0] for seed in range(30)]
    exact, _ = simulate_manoeuvre("pulses", setup=DriveSetup(sensors="ideal"))
    offsets = np.array([error(log, "ax").mean() for log in logs])
    assert offsets.std() == pytest.approx(0.03, rel=0.4)
    torque = column(exact, "torque_fl")
    gains = np.array([column(log, "torque_fl") @ torque / (torque @ torque) for log in logs])
    assert gains.std() == pytest.approx(0.03, rel=0.4)
    halves = [error(log, "ax")[:1500].mean() - error(log, "ax")[1500:].mean() for log in logs]
    assert np.abs(halves).max() < 0.01


def test_position_has_ten_hertz_and_errors_of_metres() -> None:
    log, _ = simulate_manoeuvre("straight", duration_s=30.0)
    latitude, longitude, yaw = (column(log, name) for name in ("latitude", "longitude", "yaw"))
    fixes = np.isfinite(latitude)
    assert np.flatnonzero(fixes).tolist() == list(range(0, 3000, 10))
    assert (np.isfinite(yaw) == fixes).all()
    x, y = GOTHENBURG.from_latlon(latitude[fixes], longitude[fixes])
    off = np.hypot(x - column(log, "true_x")[fixes], y - column(log, "true_y")[fixes])
    assert 0.3 < off.mean() < 6.0
    assert log["latitude"].null_count == 3000 - 300


def test_metres_and_degrees_convert_both_ways() -> None:
    x = np.array([0.0, 200.0, -3e3])
    y = np.array([0.0, -150.0, 4e3])
    np.testing.assert_allclose(
        GOTHENBURG.from_latlon(*GOTHENBURG.to_latlon(x, y)), (x, y), atol=1e-6
    )
    latitude, longitude = GOTHENBURG.to_latlon(x, y)
    assert latitude[1] < latitude[0]  # y points north
    assert longitude[1] > longitude[0]  # x points east


def test_a_rolling_body_lets_gravity_into_the_accelerometer() -> None:
    level, _ = simulate_manoeuvre("constant-radius", setup=DriveSetup(sensors="mems"))
    leaky, _ = simulate_manoeuvre("constant-radius", setup=DriveSetup(sensors="mems-leak"))
    leak = (column(leaky, "ay") - column(level, "ay"))[-500:].mean() / column(level, "true_ay")[
        -500:
    ].mean()
    assert leak == pytest.approx(PRESETS["sedan"].roll_leak, rel=0.05)


def test_vehicle_files_are_wrong_by_a_few_per_cent_in_listed_fields() -> None:
    truth = PRESETS["sedan"].vehicle
    reported = [simulate_manoeuvre("straight", duration_s=0.1, seed=seed)[1] for seed in range(200)]
    for name in type(truth).model_fields:
        values = [getattr(vehicle, name) for vehicle in reported]
        if name in KNOWN:
            assert np.std(np.array(values) / getattr(truth, name)) == pytest.approx(
                KNOWN[name], rel=0.2
            )
        else:
            assert set(values) == {getattr(truth, name)}


@pytest.mark.parametrize("kind", FAULTS)
def test_planted_fault_changes_only_its_channel_in_its_period(kind: str) -> None:
    t = np.arange(300) / 100.0
    signals = np.random.default_rng(0).normal(size=(300, len(CHANNELS)))
    faulty = apply_faults(t, signals, (Fault(kind, "ay", 1.0, 2.0, size=5.0),))
    changed = ~((faulty == signals) | (np.isnan(faulty) & np.isnan(signals)))
    assert changed.any()
    assert set(np.flatnonzero(changed.any(axis=0))) == {CHANNELS.index("ay")}
    assert set(np.flatnonzero(changed.any(axis=1))) <= set(range(100, 200))


def test_a_fault_may_name_the_four_wheels_at_once() -> None:
    log, _ = simulate_manoeuvre(
        "straight", duration_s=1.0, setup=DriveSetup(faults=(Fault("missing", "torque"),))
    )
    assert [n for n in CHANNELS if log[n].null_count == 100] == [
        "torque_fl",
        "torque_fr",
        "torque_rl",
        "torque_rr",
    ]


def test_unknown_faults_channels_and_sensors_are_refused_with_the_choice() -> None:
    with pytest.raises(InputError, match="spike"):
        Fault("gremlin", "ay")
    with pytest.raises(InputError, match="yaw_rate"):
        Fault("stuck", "tyre_pressure")
    with pytest.raises(InputError, match=next(iter(SENSORS))):
        simulate_manoeuvre("straight", setup=DriveSetup(sensors="perfect"))
