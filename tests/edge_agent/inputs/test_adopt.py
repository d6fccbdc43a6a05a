"""Tests of corrections in the replay of a log. The signal doctor (automatic check of the signals)
must find delayed sensors, and rear wheels with equal speeds, which show a locked differential. The
replay must then correct the delays and remove the slip that the locked differential causes in
turns. It must also scale wheel speeds to given radii, and leave a drive with exact sensors
unchanged.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import pytest

from edge_agent.inputs.correct import correct_log
from edge_agent.inputs.doctor.adopt import adopt_measured, align_devices
from edge_agent.inputs.doctor.lift import is_on_lift
from edge_agent.inputs.signal_log import SignalLog
from edge_agent.lab.simulation.presets import PRESETS
from schemas.numeric import FloatArray
from schemas.signals import CHANNELS, S
from tests.benchmarks.inputs.planted import DELTA, IMU, OMEGA, Recorded, drives

RATE_HZ = 100


@pytest.fixture(scope="module")
def drive() -> Recorded:
    """Return a simulated drive of two and a half minutes in a car with exact sensors."""
    return drives(1, 31, rough=False)[0]


def log_of(drive: Recorded) -> SignalLog:
    return SignalLog(drive.t, drive.signals, None, None, None)


def late(signals: FloatArray, columns: Sequence[int], seconds: float) -> FloatArray:
    samples = round(seconds * RATE_HZ)
    moved = signals.copy()
    moved[samples:, columns] = signals[:-samples, columns]
    return moved


def test_exact_drive_is_left_as_it_is(drive: Recorded) -> None:
    log = log_of(drive)
    adopted = adopt_measured(log, drive.vehicle)
    assert adopted.log is log
    assert adopted.vehicle is drive.vehicle
    assert adopted.notes == []


@pytest.mark.parametrize(("device", "columns"), [("steering", DELTA[:2]), ("wheels", OMEGA)])
def test_late_device_is_measured_and_corrected(
    drive: Recorded, device: str, columns: Sequence[int]
) -> None:
    wrong = replace(log_of(drive), signals=late(drive.signals, columns, 0.15))
    adopted = adopt_measured(wrong, drive.vehicle)
    assert [note.split()[4] for note in adopted.notes] == [device]
    assert adopted.diagnosis.is_passed
    rows = slice(1000, -1000)
    before = np.nanmean(np.abs(wrong.signals[rows][:, columns] - drive.signals[rows][:, columns]))
    after = np.nanmean(
        np.abs(adopted.log.signals[rows][:, columns] - drive.signals[rows][:, columns])
    )
    assert after < 0.35 * before


def test_alignment_moves_readings_back_by_their_delay(drive: Recorded) -> None:
    moved = align_devices(drive.t, late(drive.signals, IMU, 0.2), {"imu": 0.2})
    rows = slice(100, -100)
    assert np.nanmax(np.abs(moved[rows][:, IMU] - drive.signals[rows][:, IMU])) < 1e-9
    assert np.array_equal(moved[rows][:, OMEGA], drive.signals[rows][:, OMEGA], equal_nan=True)


def test_locked_rear_axle_is_recognised_and_freed(drive: Recorded) -> None:
    signals = drive.signals.copy()
    mean = signals[:, OMEGA[2:]].mean(axis=1)
    signals[:, OMEGA[2]] = mean
    signals[:, OMEGA[3]] = mean
    adopted = adopt_measured(replace(log_of(drive), signals=signals), drive.vehicle)
    assert adopted.vehicle.rear_axle_locked
    apart = adopted.log.signals[:, OMEGA[3]] - adopted.log.signals[:, OMEGA[2]]
    true = drive.signals[:, OMEGA[3]] - drive.signals[:, OMEGA[2]]
    assert np.nanstd(apart - true) < 0.3 * np.nanstd(true)


def test_radius_of_an_axle_scales_its_wheels_and_torques(drive: Recorded) -> None:
    vehicle = drive.vehicle.model_copy(
        update={"wheel_radius_rear": 1.04 * drive.vehicle.wheel_radius}
    )
    scaled = correct_log(drive.t, drive.signals, vehicle)
    assert np.allclose(scaled[:, OMEGA[2:]], 1.04 * drive.signals[:, OMEGA[2:]], equal_nan=True)
    assert np.array_equal(scaled[:, OMEGA[:2]], drive.signals[:, OMEGA[:2]], equal_nan=True)
    torques = slice(S.TORQUE + 2, S.TORQUE + 4)
    assert np.allclose(scaled[:, torques], drive.signals[:, torques] / 1.04, equal_nan=True)


@pytest.mark.parametrize("driven", [(2,), (0, 2)])
def test_car_on_a_lift_is_recognised_and_its_speed_is_zero(driven: tuple[int, ...]) -> None:
    t = np.arange(0.0, 20.0, 0.01)
    rng = np.random.default_rng(5)
    signals = np.full((len(t), len(CHANNELS)), np.nan)
    signals[:, [S.AX, S.AY]] = 0.1 + rng.normal(0.0, 0.05, (len(t), 2))
    signals[:, S.YAW_RATE] = rng.normal(0.0, 0.002, len(t))
    signals[:, S.DELTA : S.DELTA + 2] = 0.0
    signals[:, OMEGA] = 0.0
    for first in driven:
        signals[:, S.OMEGA + first : S.OMEGA + first + 2] = (40.0 + 30.0 * np.sin(0.5 * t))[:, None]
    vehicle = PRESETS["sedan"].vehicle
    adopted = adopt_measured(SignalLog(t, signals, None, None, None), vehicle)
    assert [(fault.channel, fault.kind) for fault in adopted.diagnosis.findings] == [
        ("omega", "lift")
    ]
    assert not adopted.log.signals[:, OMEGA].any()
    on_road = signals.copy()
    on_road[:, S.AX] += vehicle.wheel_radius * 15.0 * np.cos(0.5 * t)
    assert all(
        fault.kind != "lift"
        for fault in adopt_measured(
            replace(adopted.log, signals=on_road), vehicle
        ).diagnosis.findings
    )


@pytest.mark.parametrize(("north_m_s", "lifted"), [(0.1, True), (15.0, False)])
def test_car_whose_position_moves_is_not_on_a_lift(north_m_s: float, *, lifted: bool) -> None:
    t = np.arange(0.0, 20.0, 0.01)
    signals = np.full((len(t), len(CHANNELS)), np.nan)
    signals[:, [S.AX, S.AY]] = 0.0  # in g instead of m/s^2, they seem to be at rest
    signals[:, S.YAW_RATE] = 0.0
    signals[:, OMEGA] = (40.0 + 30.0 * np.sin(0.5 * t))[:, None]
    signals[:, S.LATITUDE] = 59.0 + np.degrees(north_m_s * t / 6_378_137.0)
    signals[:, S.LONGITUDE] = 18.0
    assert is_on_lift(t, signals, PRESETS["sedan"].vehicle) == lifted
