"""Tests of a live trip. Nothing may be published before the signals have passed the signal doctor
(a check for sensor faults). The next trip must use the calibration that the previous one learned.
"""

from __future__ import annotations

import logging
from collections.abc import Generator
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from edge_agent.app.trip import LEAST_S, LOOK_S, Trip, state_path_for
from edge_agent.inputs.block import Block
from edge_agent.inputs.profile import Profile
from schemas.numeric import FloatArray
from schemas.signals import S
from tests.benchmarks.inputs.planted import Recorded, drives, offset_columns, scale_columns
from tests.waiting import until

PROFILE = Profile(name="p", channels={})
ROWS = 10


@pytest.fixture(scope="module")
def smooth() -> Recorded:
    return drives(1, 31, rough=False, seconds=150)[0]


def source(drive: Recorded) -> Generator[Block]:
    for first in range(0, len(drive.t), ROWS):
        t = drive.t[first : first + ROWS, None]
        yield Block(t, np.rint(t * 1e9).astype(np.int64), drive.signals[first : first + ROWS, None])


def drive_trip(trip: Trip, drive: Recorded) -> tuple[list[bool], list[Block]]:
    """Pass the samples of a recorded drive through a live trip, block by block. Wait for each
    result of the signal doctor (a check for sensor faults). Return two lists with one item per
    block: True if its records may be published, and the block as the estimator received it.
    """
    admitted = []
    blocks = []
    for block in trip.corrected_blocks(source(drive), lambda: np.full(ROWS, np.nan)):
        if trip._examination is not None:
            trip._examination.result()
        admitted.append(trip.is_admitted())
        blocks.append(block)
    trip.learn_rest()
    if trip._examination is not None:
        trip._examination.result()
    trip.close()
    return admitted, blocks


def delayed_by(rows: int, late: FloatArray, raw: FloatArray) -> bool:
    return np.allclose(late[rows:], raw[: len(raw) - rows], rtol=0.0, atol=1e-12, equal_nan=True)


def test_no_record_is_admitted_before_the_doctor_has_passed(
    smooth: Recorded, tmp_path: Path
) -> None:
    trip = Trip(smooth.vehicle, PROFILE, tmp_path / "car.json")
    assert trip.health_problems()
    admitted, blocks = drive_trip(trip, smooth)
    first = admitted.index(True)
    assert LOOK_S - 1.0 <= blocks[first].t[0, 0] <= 4.0 * LOOK_S
    assert all(admitted[first:])
    assert not trip.health_problems()


def test_faulty_trip_is_not_admitted_and_teaches_no_calibration(
    smooth: Recorded, tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    path = tmp_path / "car.json"
    trip = Trip(smooth.vehicle, PROFILE, path)
    admitted, _ = drive_trip(trip, scale_columns([S.AY], -1.0)(smooth))
    assert not any(admitted)
    assert "ay sign" in trip.health_problems()[0]
    assert "ay sign" in caplog.text
    assert not path.exists()
    trusted = Trip(smooth.vehicle, PROFILE, path, trusted=True)
    assert all(drive_trip(trusted, scale_columns([S.AY], -1.0)(smooth))[0])
    assert not path.exists(), "what is trusted is not for that reason learned from"


@pytest.mark.campaign
def test_calibration_learned_on_a_trip_applies_from_the_next_trip(
    smooth: Recorded, tmp_path: Path
) -> None:
    path = tmp_path / "car.json"
    bad = offset_columns([S.YAW_RATE], 0.012)(smooth)
    for count in range(1, 4):
        trip = Trip(bad.vehicle, PROFILE, path)
        assert trip.is_admitted() == (count > 1), "the doctor's word is remembered"
        known = trip.vehicle.calibration
        assert (0 if known is None else known.drives) == count - 1
        _, blocks = drive_trip(trip, bad)
        got = np.concatenate([block.signals[:, 0, S.YAW_RATE] for block in blocks])
        raw = bad.signals[:, S.YAW_RATE]
        offset = 0.0 if known is None or known.yaw_rate is None else known.yaw_rate[0]
        waited = [rows for rows in range(11) if delayed_by(rows, got + offset, raw)]
        assert waited, (
            "each row is a reading of the log, less the offset, at most a tenth of a second old"
        )
        assert count > 1 or waited[0] == 0, "nothing is known yet"
    assert offset == pytest.approx(0.012, abs=0.004)


def test_new_fault_revokes_the_admission_by_the_doctor(smooth: Recorded, tmp_path: Path) -> None:
    path = tmp_path / "car.json"
    drive_trip(Trip(smooth.vehicle, PROFILE, path), smooth)
    broken = Trip(smooth.vehicle, PROFILE, path)
    assert broken.is_admitted()
    drive_trip(broken, scale_columns([S.AY], -1.0)(smooth))
    assert not Trip(smooth.vehicle, PROFILE, path).is_admitted()


def test_other_car_or_damaged_state_file_is_not_admitted(
    smooth: Recorded, tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    path = tmp_path / "car.json"
    drive_trip(Trip(smooth.vehicle, PROFILE, path), smooth)
    assert Trip(smooth.vehicle, PROFILE, path).is_admitted()
    heavier = smooth.vehicle.model_copy(update={"mass": 2.0 * smooth.vehicle.mass})
    assert not Trip(heavier, PROFILE, path).is_admitted()
    assert not Trip(smooth.vehicle, PROFILE.model_copy(update={"name": "q"}), path).is_admitted()
    for text in ("", "{}", "[" * 100_000, '{"version": 9}', path.read_text()[:-20]):
        path.write_text(text)
        caplog.clear()
        assert not Trip(smooth.vehicle, PROFILE, path).is_admitted()
        assert "learning starts again" in caplog.text


def test_short_trip_teaches_nothing_and_a_full_disk_is_survived(
    smooth: Recorded, tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    path = tmp_path / "car.json"
    rows = round(0.9 * LEAST_S * 100)
    drive_trip(Trip(smooth.vehicle, PROFILE, path), replace_rows(smooth, rows))
    assert Trip(smooth.vehicle, PROFILE, path).vehicle.calibration is None
    with caplog.at_level(logging.WARNING):
        drive_trip(Trip(smooth.vehicle, PROFILE, tmp_path / "nowhere" / "car.json"), smooth)
    assert "cannot be written" in caplog.text


def replace_rows(drive: Recorded, rows: int) -> Recorded:
    return drive._replace(t=drive.t[:rows], signals=drive.signals[:rows])


def test_doctor_runs_next_to_the_live_loop(smooth: Recorded, tmp_path: Path) -> None:
    trip = Trip(smooth.vehicle, PROFILE, tmp_path / "car.json")
    for block in trip.corrected_blocks(source(smooth), lambda: np.full(ROWS, np.nan)):
        replace(block)  # stands for the main loop, which does not wait for the doctor
    until(lambda: trip._examination is not None and trip._examination.done())
    assert trip.is_admitted()
    trip.close()


def test_state_file_is_next_to_the_outbox() -> None:
    assert state_path_for(Path("/var/lib/gripmap/spool.sqlite"), "car-one") == Path(
        "/var/lib/gripmap/spool.car-one.json"
    )
