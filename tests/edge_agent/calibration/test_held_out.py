"""Tests of the validation of a calibration on drives that were not used for learning. If a group of
corrections makes the estimates of these drives worse, it must be left out.
"""

from __future__ import annotations

import numpy as np
import pytest

from edge_agent.calibration.held_out import (
    Drive,
    Prediction,
    is_worse,
    learn_validated,
    restrict_groups,
    split_folds,
)
from edge_agent.calibration.learn import trace_steering
from edge_agent.inputs.doctor.drive import prepare_drive
from schemas.errors import InputError
from schemas.signals import S
from schemas.vehicle import Calibration, Vehicle
from tests.benchmarks.inputs.planted import Recorded, drives, offset_columns


@pytest.fixture(scope="module")
def drive() -> Recorded:
    """Return a simulated drive of two minutes in a car whose accelerometer is tilted."""
    return offset_columns([S.AX], 0.5)(drives(1, 31, rough=False, seconds=120)[0])


def offset_judge(vehicle: Vehicle, drive: Drive) -> Prediction:
    """Return a made-up score of the calibration in a vehicle file. It replaces the prediction error
    on a real drive. A calibrated offset of a_x improves the score; calibrated wheel radii make it
    worse.
    """
    known = vehicle.calibration
    if known is None:
        return Prediction(0.0, 0.0)
    likelihood = (1.0 if known.ax is not None else 0.0) - (
        1.0 if known.radius_fl is not None else 0.0
    )
    return Prediction(likelihood, 0.0)


def test_group_that_makes_held_out_drives_worse_is_left_out(drive: Recorded) -> None:
    half = len(drive.t) // 2
    both = [(drive.t[:half], drive.signals[:half]), (drive.t[half:], drive.signals[half:])]
    found = learn_validated(both, drive.vehicle, offset_judge)
    assert found.calibration.ax is not None
    assert found.calibration.ax[0] == pytest.approx(0.5, abs=3.0 * found.calibration.ax[1])
    assert found.calibration.radius_fl is None
    assert found.refused == ["radii"]
    assert found.score_with.log_likelihood > found.score_without.log_likelihood


def test_calibration_is_empty_if_no_group_helps(drive: Recorded) -> None:
    def refuse(vehicle: Vehicle, drive: Drive) -> Prediction:
        return Prediction(0.0 if vehicle.calibration is None else -1.0, 0.0)

    found = learn_validated([(drive.t, drive.signals)], drive.vehicle, refuse)
    assert found.calibration == Calibration(drives=1)
    assert found.score_with == found.score_without


def test_short_single_drive_cannot_be_validated(drive: Recorded) -> None:
    short = (drive.t[:3500], drive.signals[:3500])
    assert split_folds([short]) == []
    with pytest.raises(InputError, match="too short to hold out a part"):
        learn_validated([short], drive.vehicle, offset_judge)


def test_longer_contradiction_is_worse_whatever_the_likelihood() -> None:
    assert is_worse([Prediction(5.0, 0.1)], [Prediction(0.0, 0.0)])
    assert not is_worse([Prediction(0.0, 0.0)], [Prediction(0.0, 0.1)])


def test_prediction_that_was_not_measured_counts_as_worse() -> None:
    good = Prediction(0.0, 0.0)
    for unmeasured in (Prediction(np.nan, 0.0), Prediction(5.0, np.nan)):
        assert is_worse([good, unmeasured], [good, good])
        assert is_worse([unmeasured, good], [good, good])


def test_restriction_keeps_the_groups_that_are_named() -> None:
    known = Calibration(drives=2, ax=(0.1, 0.1), radius_fl=(0.01, 0.001), steer_gain=(1.0, 0.1))
    assert restrict_groups(known, ["radii"]) == Calibration(drives=2, radius_fl=(0.01, 0.001))


def test_understeer_and_gain_of_the_steering_are_traced_together(drive: Recorded) -> None:
    signals = drive.signals.copy()
    plain = trace_steering(prepare_drive(drive.t, signals, drive.vehicle))
    v = drive.vehicle.wheel_radius * np.nanmean(signals[:, S.OMEGA : S.OMEGA + 4], axis=1)
    compliance = 0.002 * np.where(np.isfinite(v), v, 0.0) * signals[:, S.YAW_RATE]
    signals[:, S.DELTA : S.DELTA + 2] += compliance[:, None]
    soft = trace_steering(prepare_drive(drive.t, signals, drive.vehicle))
    assert soft["understeer"] - plain["understeer"] == pytest.approx(
        0.002, abs=2.0 * soft["understeer_std"]
    )
    assert soft["understeer"] - plain["understeer"] > 0.001
    assert abs(soft["steer_gain"] - plain["steer_gain"]) < 2.0 * soft["steer_gain_std"]
