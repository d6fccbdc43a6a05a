"""Tests of the calibration. The test puts errors into a simulated car's sensors; the calibration
must find them from the car's drives and correct them.
"""

from __future__ import annotations

import itertools
import json
from pathlib import Path

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest

from edge_agent.calibration.learn import (
    ERRORS,
    learn_calibration,
    one_drive,
    surer_values,
    weigh_estimates,
)
from edge_agent.cli import main
from edge_agent.inputs.correct import Corrector, correct_log
from schemas.errors import InputError
from schemas.numeric import FloatArray
from schemas.signals import CHANNELS, S
from schemas.vehicle import Calibration, Vehicle, load_vehicle
from tests.benchmarks.inputs.planted import Recorded, drives, offset_columns, scale_columns

Output = pytest.CaptureFixture[str]
OFF = {"ax": 0.5, "yaw_rate": 0.012, "steer_offset": 0.012, "radius_fl": 0.012}


@pytest.fixture(scope="module")
def smooth() -> Recorded:
    """Return a simulated drive of three minutes on level ground in a car with well
    mounted sensors.
    """
    return drives(1, 31, rough=False, seconds=180)[0]


def spoil_drive(drive: Recorded) -> Recorded:
    for spoil in (
        offset_columns([S.AX], OFF["ax"]),
        offset_columns([S.YAW_RATE], OFF["yaw_rate"]),
        offset_columns([S.DELTA, S.DELTA + 1], OFF["steer_offset"]),
        scale_columns([S.OMEGA], 1.0 + 4.0 / 3.0 * OFF["radius_fl"]),
    ):
        drive = spoil(drive)
    return drive


def parts(drive: Recorded, count: int) -> list[tuple[FloatArray, FloatArray]]:
    size = len(drive.t) // count
    return [(drive.t[k * size :][:size], drive.signals[k * size :][:size]) for k in range(count)]


def test_planted_errors_are_learned_within_their_standard_deviation(smooth: Recorded) -> None:
    before = learn_calibration(parts(smooth, 3), smooth.vehicle)
    after = learn_calibration(parts(spoil_drive(smooth), 3), smooth.vehicle)
    assert after.drives == 3
    for name, off in OFF.items():
        one = getattr(before, name)
        other = getattr(after, name)
        assert other[0] - one[0] == pytest.approx(off, abs=2.0 * other[1]), name
        assert abs(one[0]) < 3.0 * one[1], name
        assert 0.0 < other[1] < off


def test_more_drives_are_surer(smooth: Recorded) -> None:
    few, many = (learn_calibration(parts(smooth, count), smooth.vehicle) for count in (1, 3))
    assert few.ax is not None
    assert many.ax is not None
    assert many.ax[1] < few.ax[1]


def test_correction_removes_the_learned_errors(smooth: Recorded) -> None:
    bad = spoil_drive(smooth)
    calibration = learn_calibration(parts(bad, 3), bad.vehicle)
    corrected = correct_log(
        bad.t, bad.signals, bad.vehicle.model_copy(update={"calibration": calibration})
    )
    for channel, off in (
        (S.AX, OFF["ax"]),
        (S.YAW_RATE, OFF["yaw_rate"]),
        (S.DELTA, OFF["steer_offset"]),
    ):
        left = np.nanmedian(corrected[:, channel] - smooth.signals[:, channel])
        assert abs(left) < 0.35 * off
    assert correct_log(bad.t, bad.signals, bad.vehicle) is bad.signals


def test_uncertain_calibration_is_drawn_to_the_usual_value(smooth: Recorded) -> None:
    few, many = (
        weigh_estimates([{"steer_gain": 1.2}] * count, smooth.vehicle) for count in (1, 30)
    )
    assert few is not None
    assert many is not None
    assert few.steer_gain is not None
    assert many.steer_gain is not None
    assert 1.0 < few.steer_gain[0] < many.steer_gain[0] < 1.2
    assert few.steer_gain[1] < ERRORS["steer_gain"].usual


def test_the_driven_axle_is_not_taken_for_a_smaller_one() -> None:
    """Slip makes the driven wheels look smaller. If the vehicle file names the driven axle, the
    errors of the learned radii must be smaller than without this entry. Without this entry, the
    stated uncertainty must be larger.
    """
    drive = drives(3, 32, rough=False, seconds=300)[2]  # a van with rear-wheel drive
    assert drive.vehicle.drive_split_front == 0.0
    unsaid = drive.vehicle.model_copy(update={"drive_split_front": None})
    known, blind = (
        [one_drive(*part, vehicle) for part in parts(drive, 3)]
        for vehicle in (drive.vehicle, unsaid)
    )
    ours = weigh_estimates(known, drive.vehicle)
    theirs = weigh_estimates(blind, unsaid)
    for name in ("radius_fl", "radius_fr", "radius_rl", "radius_rr"):
        right, wrong = (
            abs(float(np.median([part[name] for part in estimates])))
            for estimates in (known, blind)
        )
        assert right < 0.6 * wrong
        assert wrong < getattr(theirs, name)[1]
        assert getattr(theirs, name)[1] > getattr(ours, name)[1]


def test_torque_determines_its_gain_times_the_mass() -> None:
    drive = drives(1, 33, rough=False, seconds=180)[0]
    assert np.isfinite(drive.signals[:, S.TORQUE]).any()
    torques = [S.TORQUE + wheel for wheel in range(4)]
    laden = drive.vehicle.model_copy(update={"mass": drive.vehicle.mass / 1.1})
    plain, more, heavy = (
        learn_calibration(parts(one, 3), vehicle).force_gain
        for one, vehicle in (
            (drive, drive.vehicle),
            (scale_columns(torques, 1.1)(drive), drive.vehicle),
            (drive, laden),
        )
    )
    assert plain is not None
    assert more is not None
    assert heavy is not None
    assert abs(plain[0] - 1.0) < 0.08
    for gained in (more, heavy):
        assert gained[0] - plain[0] == pytest.approx(0.1, abs=0.02)
    vehicle = drive.vehicle.model_copy(
        update={"calibration": Calibration(drives=1, force_gain=(1.1, 0.01))}
    )
    corrected = correct_log(drive.t, scale_columns(torques, 1.1)(drive).signals, vehicle)
    assert np.allclose(corrected[:, torques], drive.signals[:, torques], equal_nan=True)
    unsaid = drive.signals.copy()
    unsaid[:, torques] = np.nan
    assert learn_calibration([(drive.t, unsaid)], drive.vehicle).force_gain is None


WHEELS_AND_STEERING = {
    "wheel_lag": range(S.OMEGA, S.OMEGA + 4),
    "steer_lag": range(S.DELTA, S.DELTA + 4),
}
LATE = 8  # [samples] delay


def late(drive: Recorded, channels: range) -> Recorded:
    signals = drive.signals.copy()
    signals[LATE:, channels] = drive.signals[:-LATE, channels]
    return drive._replace(signals=signals)


@pytest.mark.parametrize("name", WHEELS_AND_STEERING)
def test_a_late_device_is_known_by_its_turns_and_the_others_wait_for_it(
    smooth: Recorded, name: str
) -> None:
    seconds = float(smooth.t[LATE] - smooth.t[0])
    bad = late(smooth, WHEELS_AND_STEERING[name])
    before, after = (learn_calibration(parts(one, 3), smooth.vehicle) for one in (smooth, bad))
    one = getattr(before, name)
    other = getattr(after, name)
    assert other[0] - one[0] == pytest.approx(seconds, abs=2.0 * other[1])
    assert abs(one[0]) < 3.0 * one[1]
    known = Calibration.model_validate({"drives": 1, name: (seconds, 0.001)})
    vehicle = bad.vehicle.model_copy(update={"calibration": known})
    corrected = correct_log(bad.t, bad.signals, vehicle)
    both = [
        *WHEELS_AND_STEERING["wheel_lag"],
        *WHEELS_AND_STEERING["steer_lag"],
        S.AX,
        S.AY,
        S.YAW_RATE,
    ]
    assert np.array_equal(corrected[LATE:, both], smooth.signals[:-LATE, both], equal_nan=True)


def test_waiting_is_causal_and_blocks_may_be_cut_anywhere(smooth: Recorded) -> None:
    known = Calibration(
        drives=1, wheel_lag=(0.013, 0.001), steer_lag=(-0.041, 0.001), ax=(0.2, 0.01)
    )
    vehicle = smooth.vehicle.model_copy(update={"calibration": known})
    t = smooth.t[:300]
    signals = smooth.signals[:300]
    whole = correct_log(t, signals, vehicle)
    assert not np.array_equal(whole[50:, S.AX], signals[50:, S.AX] - 0.2)
    assert np.array_equal(correct_log(t[:150], signals[:150], vehicle), whole[:150], equal_nan=True)
    corrector = Corrector(vehicle)
    cuts = [0, 1, 2, 9, 10, 150, 300]
    parted = [corrector.advance(t[a:b], signals[a:b]) for a, b in itertools.pairwise(cuts)]
    assert np.array_equal(np.concatenate(parted), whole, equal_nan=True)


def test_two_drives_that_disagree_are_less_sure(smooth: Recorded) -> None:
    alike = weigh_estimates([{"yaw_rate": 0.01}, {"yaw_rate": 0.01}], smooth.vehicle)
    apart = weigh_estimates([{"yaw_rate": 0.0}, {"yaw_rate": 0.02}], smooth.vehicle)
    assert alike is not None
    assert apart is not None
    assert apart.yaw_rate is not None
    assert alike.yaw_rate is not None
    assert apart.yaw_rate[1] > 1.5 * alike.yaw_rate[1]
    assert apart.yaw_rate[0] < 0.5 * alike.yaw_rate[0], "drawn to the usual value"


def test_surer_value_of_two_calibrations_is_kept() -> None:
    one = Calibration(drives=3, ax=(0.3, 0.05), ay=(0.1, 0.2))
    other = Calibration(drives=9, ax=(0.2, 0.1), yaw_rate=(0.01, 0.001))
    both = surer_values(one, other)
    assert both == Calibration(drives=9, ax=(0.3, 0.05), ay=(0.1, 0.2), yaw_rate=(0.01, 0.001))
    assert surer_values(None, other) == other
    assert surer_values(one, None) == one


def test_standing_car_teaches_no_calibration(smooth: Recorded) -> None:
    still = np.zeros_like(smooth.signals[:3000])
    with pytest.raises(InputError, match="enough excitation"):
        learn_calibration([(smooth.t[:3000], still)], smooth.vehicle)


def write(path: Path, drive: Recorded) -> str:
    columns = {"t": pa.array(drive.t)}
    columns |= {
        name: pa.array(drive.signals[:, i], from_pandas=True) for i, name in enumerate(CHANNELS)
    }
    pq.write_table(pa.table(columns), path)
    return str(path)


@pytest.mark.campaign
def test_a_calibrated_file_is_written_read_and_heeded(
    smooth: Recorded, tmp_path: Path, capsys: Output
) -> None:
    log = write(tmp_path / "a.parquet", spoil_drive(smooth))
    copy = write(tmp_path / "copy.parquet", spoil_drive(smooth))
    car = tmp_path / "car.json"
    better = tmp_path / "better.json"
    car.write_text(smooth.vehicle.model_dump_json(exclude_none=True))
    assert main(["calibrate", log, log, "--vehicle", str(car), "--out", str(better)]) == 2
    assert "is given twice" in capsys.readouterr().err
    assert main(["calibrate", log, copy, "--vehicle", str(car), "--out", log]) == 2
    assert "out: " in capsys.readouterr().err
    assert main(["calibrate", log, copy, "--vehicle", str(car), "--out", str(better)]) == 0
    assert "steer_offset" in capsys.readouterr().out
    learned = load_vehicle(better)
    assert learned.calibration is not None
    assert learned.model_copy(update={"calibration": None}) == load_vehicle(car)
    estimates = []
    for number, file in enumerate((car, better)):
        out = tmp_path / f"{number}.parquet"
        assert main(
            ["replay", log, "--vehicle", str(file), "--estimator", "ckf", "--out", str(out)]
        ) in (0, 3)
        estimates.append(pq.read_table(out))
    assert not estimates[0].equals(estimates[1])
    wrong = write(tmp_path / "b.parquet", scale_columns([S.AY], -1.0)(smooth))
    assert main(["calibrate", wrong, "--vehicle", str(car), "--out", str(better)]) == 2
    assert "ay sign" in capsys.readouterr().err
    assert main(["calibrate", wrong, "--vehicle", str(car), "--out", str(better), "--trust"]) == 0


def test_an_old_file_reads_and_an_unknown_quantity_is_refused(
    smooth: Recorded, tmp_path: Path
) -> None:
    old = json.loads(smooth.vehicle.model_dump_json(exclude_none=True))
    assert Vehicle.model_validate(old).calibration is None
    (tmp_path / "car.json").write_text(
        json.dumps(old | {"calibration": {"version": 1, "drives": 1, "az": [0, 1]}})
    )
    with pytest.raises(InputError, match="az"):
        load_vehicle(tmp_path / "car.json")
