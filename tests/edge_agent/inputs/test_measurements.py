"""Tests of measurements in MDF 4 files, as recorders of test cars write them: several groups,
texts between numbers, units of the conversion, local time.
"""

from __future__ import annotations

import datetime
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any, TypeAlias

import numpy as np
import pytest
from numpy.typing import NDArray

from edge_agent.inputs.bring_in import read_source
from edge_agent.inputs.readers.dbc import parse_dbc
from edge_agent.inputs.recording import Recording
from tests.edge_agent.inputs import formats

asammdf = pytest.importorskip("asammdf")
Library: TypeAlias = Any  # objects of asammdf, which has no types
T = np.arange(50) * 0.01
START = datetime.datetime(2026, 1, 15, 7, 30, tzinfo=datetime.UTC)
NOT_JOINED = "a.mf4: in several groups at the same time or in other units, the first is used: ax"
START_NS = int(START.timestamp()) * 1_000_000_000


def write_mdf(path: Path, fill: Callable[[Library], None]) -> Path:
    """Write a measurement whose groups `fill` appends, with the date START."""
    with asammdf.MDF(version="4.10") as mdf:
        mdf.header.start_time = START
        fill(mdf)
        mdf.save(path, overwrite=True)
    return path


def read_mdf(path: Path, fill: Callable[[Library], None]) -> Recording:
    return read_source(write_mdf(path, fill), None, None)


def make_signal(
    values: NDArray[Any], t: NDArray[Any] = T, name: str = "ax", unit: str = "g", **more: Library
) -> Library:
    return asammdf.Signal(np.asarray(values), t, name=name, unit=unit, **more)


def test_parts_of_a_channel_in_several_groups_are_joined(tmp_path: Path) -> None:
    def fill(mdf: Library) -> None:
        mdf.append([make_signal(T + 9.0, T + 9.0)])
        mdf.append([make_signal(T, T)])

    recording = read_mdf(tmp_path / "a.mf4", fill)
    assert np.allclose(recording.signals["ax"].t, np.concatenate([T, T + 9.0]))
    assert np.allclose(recording.signals["ax"].values, recording.signals["ax"].t)
    assert recording.notes == []


def test_channel_in_two_groups_at_the_same_time_is_noted(tmp_path: Path) -> None:
    def fill(mdf: Library) -> None:
        mdf.append([make_signal(T)])
        mdf.append([make_signal(T + 1.0, T + 0.1)])

    recording = read_mdf(tmp_path / "a.mf4", fill)
    assert np.allclose(recording.signals["ax"].values, T)
    assert recording.notes == [NOT_JOINED]


def test_parts_of_a_channel_in_different_units_are_not_joined(tmp_path: Path) -> None:
    def fill(mdf: Library) -> None:
        mdf.append([make_signal(T)])
        mdf.append([make_signal(9.81 * T, T + 9.0, unit="m/s^2")])

    recording = read_mdf(tmp_path / "a.mf4", fill)
    assert np.allclose(recording.signals["ax"].values, T)
    assert recording.signals["ax"].unit == "g"
    assert recording.notes == [NOT_JOINED]


def test_text_between_numbers_is_missing_and_states_are_numbers(tmp_path: Path) -> None:
    linear = {"a": 0.01, "b": 0.0}
    absent = {"lower_0": 65535.0, "upper_0": 65535.0, "text_0": b"SNA", "default_addr": linear}
    states = {"val_0": 0, "text_0": b"off", "val_1": 1, "text_1": b"active"}
    rule = asammdf.blocks.conversion_utils.from_dict

    def fill(mdf: Library) -> None:
        raw = np.full(50, 7000, "u2")
        raw[10:20] = 65535
        mdf.append([make_signal(raw, name="wheel", unit="km/h", conversion=rule(dict(absent)))])
        gone = np.full(50, 65535, "u2")
        mdf.append([make_signal(gone, name="gone", unit="km/h", conversion=rule(dict(absent)))])
        flag = (np.arange(50) >= 25).astype("u1")
        mdf.append([make_signal(flag, name="ABS_Active", unit="", conversion=rule(dict(states)))])

    signals = read_mdf(tmp_path / "a.mf4", fill).signals
    wheel = signals["wheel"].values
    assert np.flatnonzero(np.isnan(wheel)).tolist() == list(range(10, 20))
    assert np.nanmax(np.abs(wheel - 70.0)) < 1e-9
    assert np.isnan(signals["gone"].values).all()
    assert signals["ABS_Active"].values.sum() == 25.0


@pytest.mark.parametrize(("own", "expected"), [("", "km/h"), ("m/s", "m/s")])
def test_unit_of_the_conversion_is_used_where_the_channel_has_none(
    tmp_path: Path, own: str, expected: str
) -> None:
    def fill(mdf: Library) -> None:
        rule = asammdf.blocks.conversion_utils.from_dict({"a": 0.01, "b": 0.0})
        mdf.append([make_signal(np.full(50, 7000, "u2"), name="wheel", unit="", conversion=rule)])
        channel = mdf.groups[0].channels[1]
        channel.unit = own
        channel.conversion.unit = "km/h"

    wheel = read_mdf(tmp_path / "a.mf4", fill).signals["wheel"]
    assert wheel.unit == expected
    assert np.allclose(wheel.values, 70.0)


def test_invalid_samples_are_left_out(tmp_path: Path) -> None:
    def fill(mdf: Library) -> None:
        mdf.append([make_signal(T, invalidation_bits=(T > 0.1) & (T < 0.2))])

    values = read_mdf(tmp_path / "a.mf4", fill).signals["ax"].values
    assert not np.any((values > 0.1) & (values < 0.2))
    assert len(values) == 41


def test_group_over_an_angle_is_left_out_with_a_note(tmp_path: Path) -> None:
    def fill(mdf: Library) -> None:
        mdf.append([make_signal(T, name="pressure")])
        mdf.groups[0].channels[0].sync_type = 2
        mdf.append([make_signal(T)])

    recording = read_mdf(tmp_path / "a.mf4", fill)
    assert recording.signals.keys() == {"ax"}
    assert recording.notes == ["a.mf4: 1 groups without time left out"]


@pytest.mark.parametrize("zone", ["America/New_York", "Asia/Tokyo"])
def test_local_time_does_not_depend_on_the_zone_of_this_machine(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, zone: str
) -> None:
    def fill(mdf: Library) -> None:
        mdf.append([make_signal(T)])
        mdf.header.time_flags = 1
        mdf.header.abs_time = START_NS

    path = write_mdf(tmp_path / "a.mf4", fill)
    monkeypatch.setenv("TZ", zone)
    time.tzset()
    try:
        recording = read_source(path, None, None)
    finally:
        monkeypatch.undo()
        time.tzset()
    assert recording.start_ns == START_NS
    assert not recording.has_zone
    assert recording.notes == ["a.mf4: its date has no time zone; taken as UTC"]


def test_frames_that_begin_late_keep_their_date(tmp_path: Path) -> None:
    frames = formats.frames(200)
    path = formats.as_mf4(tmp_path / "a.mf4", frames)
    late = tmp_path / "late.mf4"
    with asammdf.MDF(path) as mdf:
        rows = mdf.get("CAN_DataFrame", group=0, raw=True)
        begun = asammdf.Signal(rows.samples, rows.timestamps + 120.0, name="CAN_DataFrame")
    write_mdf(late, lambda mdf: mdf.append(begun, common_timebase=True))
    identifier = frames[0].arbitration_id
    database = parse_dbc(f'BO_ {identifier} M: 8 X\n SG_ S : 0|8@1+ (1,0) [0|0] "" X\n')
    recording = read_source(late, None, database)
    assert recording.start_ns == pytest.approx(START_NS + 120 * 10**9, abs=1000)
    assert recording.signals["M.S"].t[0] == 0.0
