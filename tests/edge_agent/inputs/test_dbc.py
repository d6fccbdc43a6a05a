"""Tests of CAN decoding. Every frame must be decoded exactly as by the library cantools. A small
error in a CAN database must not prevent the decoding of the rest.
"""

from __future__ import annotations

from pathlib import Path

import cantools
import numpy as np
import pytest

from edge_agent.inputs.profile import FOLDER, load_profile, shipped_profiles
from edge_agent.inputs.readers.dbc import LONGEST, Bytes, parse_dbc, read_dbc
from schemas.errors import InputError
from tests.edge_agent.inputs.formats import frames

MADE = 300  # random frames of each message


def oracle_of(path: Path) -> list[cantools.database.can.Message]:
    database = cantools.database.load_file(path)
    assert isinstance(database, cantools.database.can.Database)
    return database.messages


def frames_of(message: cantools.database.can.Message, data: list[bytes]) -> list[dict[str, float]]:
    return [
        dict(message.decode_simple(frame, decode_choices=False))  # type: ignore[arg-type]
        for frame in data
    ]


def columns(data: list[bytes]) -> Bytes:
    return np.frombuffer(b"".join(frame.ljust(LONGEST, b"\0") for frame in data), np.uint8).reshape(
        -1, LONGEST
    )


@pytest.mark.parametrize("name", [name for name in shipped_profiles() if load_profile(name)[0].dbc])
def test_frames_of_shipped_profiles_decode_exactly_like_cantools(name: str) -> None:
    profile, folder = load_profile(name)
    assert profile.dbc is not None
    ours = read_dbc(folder / profile.dbc)
    oracle = oracle_of(folder / profile.dbc)
    rng = np.random.default_rng(1)
    compared = 0
    for message in oracle:
        data = [rng.bytes(message.length) for _ in range(MADE)]
        decoded = frames_of(message, data)
        ours_of = ours[message.name]
        for signal, values in ours_of.decode(columns(data), list(ours_of.signals)).items():
            assert [float(row[signal]) for row in decoded] == values.tolist(), signal
            compared += 1
    assert compared >= len(profile.needed_signals())
    assert profile.needed_signals() <= {f"{m.name}.{s.name}" for m in oracle for s in m.signals}


def test_recorded_frames_decode_as_by_cantools() -> None:
    ours = read_dbc(FOLDER / "toyota.dbc")
    oracle = oracle_of(FOLDER / "toyota.dbc")
    recorded = frames()
    for message in oracle:
        data = [bytes(m.data) for m in recorded if m.arbitration_id == message.frame_id]
        assert len(data) == 4974
        decoded = frames_of(message, data)
        for signal, values in (
            ours[message.name].decode(columns(data), list(ours[message.name].signals)).items()
        ):
            assert [float(row[signal]) for row in decoded] == values.tolist(), signal


def test_multiplexed_signal_is_missing_when_not_selected() -> None:
    text = (
        'BO_ 5 M: 4 X\n SG_ S M : 0|8@1+ (1,0) [0|0] "" X\n SG_ A m1 : 8|8@1+ (2,0) [0|0] "" X\n'
        ' SG_ B m2 : 8|8@1- (1,1) [0|0] "" X\n'
    )
    message = parse_dbc(text)["M"]
    found = message.decode(columns([bytes([1, 7, 0, 0]), bytes([2, 255, 0, 0])]), ["A", "B"])
    assert np.array_equal(found["A"], [14.0, np.nan], equal_nan=True)
    assert np.array_equal(found["B"], [np.nan, 0.0], equal_nan=True)


def test_lines_that_make_no_sense_are_left_out_and_the_rest_is_read() -> None:
    text = (
        "junk\nBO_ 2147483653 A: 8 X\n"
        ' SG_ odd name : 0|8@1+ (1,0) [0|0] "" X\n SG_ T : 60|9@1+ (1,0) [0|0] "" X\n'
        ' SG_ N : 0|0@1+ (1,0) [0|0] "" X\n SG_ F : 8|8@1+ (nan,0) [0|0] "" X\n'
        'CM_ "SG_"\n SG_ Z : 0|8@1+ (1,0) \n'
    )
    message = parse_dbc(text)["A"]
    assert (message.identifier, message.extended) == (5, True)
    assert list(message.signals) == ["odd_name"]


def test_a_file_without_messages_is_refused(tmp_path: Path) -> None:
    (tmp_path / "no.dbc").write_bytes(b"\xff\xfe\0")
    with pytest.raises(InputError, match="no message"):
        read_dbc(tmp_path / "no.dbc")
