"""Tests with files of other programs. Each file must be read with the right units, or refused with
the right reason.
"""

from __future__ import annotations

import json
import logging
from pathlib import Path

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest

from edge_agent.cli import main
from edge_agent.inputs.bring_in import read_source
from edge_agent.inputs.readers.dbc import parse_dbc
from edge_agent.inputs.readers.tabular import read_table
from schemas.errors import InputError

VBO = """File created on 01/09/2020 at 10:15:00

[header]
satellites
time
latitude
longitude
velocity kmh
heading
Indicated_Longitudinal_Acceleration
Wheel_Speed_FL

[channel units]
g
km/h

[comments]
Log rate 100 Hz

[column names]
sats time lat long velocity heading LongAcc Wheel_Speed_FL

[data]
010 101559.98 +03610.50000 -01080.30000 036.0 090.0 +1.0E-01 +3.6E+01
010 101559.99 +03610.50000 -01080.30000 036.0 090.0 +1.0E-01 +3.6E+01
010 101600.00 +03610.50000 -01080.30000 036.0 090.0 +1.0E-01 +3.6E+01
"""
CSV_OF_VBO = """sats,time,lat,long,velocity,heading,LongAcc
10,101559.98,3610.5,-1080.3,36.0,90.0,0.1
10,101600.00,3610.5,-1080.3,36.0,90.0,0.1
"""
GVRET = """Time Stamp,ID,Extended,Dir,Bus,LEN,D1,D2,D3,D4,D5,D6,D7,D8
1000000,000000AA,false,Rx,0,2,10,27,
1010000,000000AA,false,Rx,0,2,11,27,
"""
TRACE = """  Number  Time  ID  Size  Data
     1)      10.0  00AA  2  10 27
     2)      20.0  00AA  2  11 27
"""
RACECHRONO = """This file is created using RaceChrono v7.0.6 ( http://racechrono.com/ ).
Format,3
Session title,"Track"

timestamp,fragment_id,elapsed_time,speed,speed,lateral_acc
unix time,,s,m/s,m/s,G
,,,100: gps,calc,
1600000000.00,0,0.0,10.0,10.1,0.1
1600000000.10,0,0.1,10.2,10.3,0.2
"""
DATABASE = parse_dbc('BO_ 170 Wheels: 2 X\n SG_ Speed : 0|16@1+ (0.01,0) [0|0] "km/h" X\n')


def write(path: Path, text: str) -> Path:
    path.write_text(text)
    return path


@pytest.mark.parametrize(
    ("name", "text"), [("a.vbo", VBO), ("a.txt", VBO), ("a.csv", VBO), ("b.csv", CSV_OF_VBO)]
)
def test_vbo_is_recognised_with_its_own_units(tmp_path: Path, name: str, text: str) -> None:
    recording = read_source(write(tmp_path / name, text), None, None)
    assert recording.signals["latitude"].values[0] == pytest.approx(60.175)
    assert recording.signals["longitude"].values[0] == pytest.approx(18.005)
    assert recording.signals["speed"].unit == "km/h"
    assert recording.signals["LongAcc"].unit == "g"
    assert recording.signals["LongAcc"].t[-1] == pytest.approx(0.02), "hhmmss, over the full minute"
    assert recording.notes


@pytest.mark.parametrize(("name", "text"), [("a.csv", GVRET), ("a.trc", TRACE)])
def test_can_frames_in_text_are_decoded(tmp_path: Path, name: str, text: str) -> None:
    recording = read_source(write(tmp_path / name, text), None, DATABASE)
    speed = recording.signals["Wheels.Speed"]
    assert np.allclose(speed.values, [100.0, 100.01])
    assert np.allclose(speed.t, [0.0, 0.01])


def test_row_of_units_below_the_names_is_named(tmp_path: Path) -> None:
    source = write(tmp_path / "a.csv", "Time,ax\ns,m/s²\n0.0,1.0\n0.1,2.0\n")
    with pytest.raises(InputError, match="Time: has the value 's', .*; write .* no row of units"):
        read_source(source, None, None)


def test_can_frames_in_text_need_a_database(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="dbc"):
        read_source(write(tmp_path / "a.csv", GVRET), None, None)


def test_racechrono_keeps_units_and_sources(tmp_path: Path) -> None:
    recording = read_source(write(tmp_path / "a.csv", RACECHRONO), None, None)
    assert recording.start_ns == 1_600_000_000_000_000_000
    assert recording.signals["lateral_acc"].unit == "G"
    assert np.allclose(recording.signals["speed"].values, [10.0, 10.2])
    assert np.allclose(recording.signals["speed calc"].values, [10.1, 10.3])


@pytest.mark.parametrize("title", ["# time(s)", "INS_time_sec", "Time [s]", "gps_timestamp"])
def test_a_column_of_time_is_found_by_its_word(tmp_path: Path, title: str) -> None:
    recording = read_source(
        write(tmp_path / "a.csv", f"{title},ax\n0.0,1.0\n0.1,2.0\n"), None, None
    )
    assert np.allclose(recording.signals["ax"].t, [0.0, 0.1])


def test_an_openpilot_log_is_refused_with_a_way_out(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="openpilot"):
        read_source(write(tmp_path / "rlog.zst", "x"), None, None)


def test_a_draft_without_known_signals_is_an_error_that_lists_them(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    source = write(tmp_path / "a.csv", "time,foo,bar\n0.0,1.0,2.0\n0.1,2.0,3.0\n")
    assert main(["import", str(source), "--out", str(tmp_path / "o.parquet")]) == 2
    stderr = capsys.readouterr().err
    assert "bar, foo" in stderr
    assert not list(tmp_path.glob("*.profile.json"))


def test_an_unfinished_measurement_is_read(tmp_path: Path) -> None:
    asammdf = pytest.importorskip("asammdf")
    whole = tmp_path / "whole.mf4"
    with asammdf.MDF(version="4.10") as file:
        t = np.arange(5) * 0.1
        file.append([asammdf.Signal(np.arange(5.0), t, name="ax", unit="m/s^2")])
        file.save(whole)
    data = bytearray(whole.read_bytes())
    data[:8] = b"UnFinMF "
    (tmp_path / "cut.mf4").write_bytes(data)
    recording = read_source(tmp_path / "cut.mf4", None, None)
    assert np.allclose(recording.signals["ax"].values, np.arange(5.0))


def test_info_messages_of_the_can_library_are_disabled(tmp_path: Path) -> None:
    read_source(
        write(tmp_path / "a.trc", ";$FILEVERSION=1.1\n1)  10.0  Rx  00AA  2  10 27\n"),
        None,
        DATABASE,
    )
    assert not logging.getLogger("can").isEnabledFor(logging.INFO)


@pytest.mark.parametrize(
    ("title", "first", "step", "dated"),
    [
        ("time [msec]", 0, 10, False),
        ("time [µs]", 0, 10_000, False),
        ("Time (Seconds)", 0, 0.01, False),
        ("time", 1_700_000_000_000, 10, True),
        ("Timestamp", 1_700_000_000_000_000_000, 10_000_000, True),
        ("timestamp", 1_700_000_000_000, 10, True),
        ("timestamp", 1_500_000_000, 10_000_000, False),
        ("timestamp_ns", 1_500_000_000, 10_000_000, False),
        ("t", 1_700_000_000.5, 0.01, True),
    ],
)
def test_a_time_column_has_its_stated_unit_or_that_of_a_date(
    tmp_path: Path, title: str, first: float, step: float, *, dated: bool
) -> None:
    text = f"{title},ax\n{first},1.0\n{first + step},2.0\n"
    recording = read_source(write(tmp_path / "a.csv", text), None, None)
    assert np.diff(recording.signals["ax"].t) == pytest.approx([0.01], rel=1e-4)
    assert (recording.start_ns is not None) == dated


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("time [lap],ax\n0,1.0\n1,2.0\n", "'lap', which is not a unit of time.*time_unit"),
        ('t,lat\n0,"57,7"\n', "has no column of numbers except the time: lat .'57,7'.; write"),
        ("t,ax\n,1.0\n0.01,2.0\n", "t: is missing at row 0"),
        ("t,ax\ninf,1.0\n0.01,2.0\n", "t: is missing at row 0"),
        ("t,ax\n0.0,1.0\n,2.0\n", "t: is missing at row 1"),
        ("t,ax\n0.0,1.0\ninf,2.0\n", "t: is missing at row 1"),
        ("t,ax\n1.0,1.0\n0.9,2.0\n", "t: goes back at row 1; sort"),
        ("t,ax\n86399.9,1.0\n0.0,2.0\n", "t: goes back at row 1; add 86400 s"),
    ],
)
def test_an_unknown_unit_or_a_missing_time_is_named(
    tmp_path: Path, text: str, message: str
) -> None:
    with pytest.raises(InputError, match=message):
        read_source(write(tmp_path / "a.csv", text), None, None)


def test_a_profile_states_the_unit_and_a_date_needs_none(tmp_path: Path) -> None:
    lap = write(tmp_path / "a.csv", "time [lap],ax\n0,1.0\n10,2.0\n")
    assert read_table(lap, "time", "ms").signals["ax"].t[1] == pytest.approx(0.01)
    text = "time (UTC),ax\n2024-05-01T10:00:00.00Z,1.0\n2024-05-01T10:00:00.01Z,2.0\n"
    dated = read_table(write(tmp_path / "b.csv", text))
    assert dated.signals["ax"].t[1] == pytest.approx(0.01)
    assert dated.start_ns == 1_714_557_600_000_000_000


@pytest.mark.parametrize("zone", ["", "Z"])
def test_times_with_a_decimal_comma_are_read(tmp_path: Path, zone: str) -> None:
    text = f"time;ax\n2024-05-01T10:00:00,00{zone};1,5\n2024-05-01T10:00:00,01{zone};2,5\n"
    found = read_table(write(tmp_path / "a.csv", text))
    assert found.signals["ax"].t.tolist() == [0.0, 0.01]
    assert found.signals["ax"].values.tolist() == [1.5, 2.5]
    assert found.start_ns == 1_714_557_600_000_000_000


@pytest.mark.parametrize(
    ("times", "note"),
    [
        (("0", "10", "20"), "time: a row every 10 s; if not"),
        (("2024-05-01 10:00:00.00", "2024-05-01 10:00:00.01"), "time has no time zone; taken as"),
        (("2024-05-01 10:00:00.00Z", "2024-05-01 10:00:00.01Z"), None),
        (("0.0", "0.01", "0.02"), None),
    ],
)
def test_assumed_unit_or_zone_of_times_is_noted(
    tmp_path: Path, times: tuple[str, ...], note: str | None
) -> None:
    text = "\n".join(["time,ax", *(f"{time},1.0" for time in times)])
    notes = read_table(write(tmp_path / "a.csv", text)).notes
    assert notes == [] if note is None else notes[0].startswith(f"a.csv: {note}")


def test_columns_with_the_same_name_are_all_kept(tmp_path: Path) -> None:
    text = "t,speed [km/h],speed [m/s],ax,ax\n0.0,36.0,10.0,1.0,3.0\n0.01,36.0,10.0,1.0,3.0\n"
    signals = read_source(write(tmp_path / "a.csv", text), None, None).signals
    assert signals["speed [km/h]"].unit == "km/h"
    assert signals["speed [m/s]"].values[0] == pytest.approx(10.0)
    assert signals["ax"].values[0] == pytest.approx(1.0)
    assert signals["ax 4"].values[0] == pytest.approx(3.0)


def test_decimal_commas_with_empty_cells_are_numbers(tmp_path: Path) -> None:
    text = "t;ax;latitude\n0,00;1,5;\n0,01;1,25;48,5\n"
    for mark in (";", "\t"):
        path = write(tmp_path / "a.csv", text.replace(";", mark))
        recording = read_source(path, None, None)
        assert np.allclose(recording.signals["ax"].values, [1.5, 1.25])
        assert np.allclose(recording.signals["latitude"].values, [np.nan, 48.5], equal_nan=True)


@pytest.mark.parametrize("encoding", ["utf-8-sig", "utf-16", "cp1252"])
def test_table_in_another_encoding_is_read(tmp_path: Path, encoding: str) -> None:
    path = tmp_path / "a.csv"
    path.write_bytes("t,yaw_rate [°/s]\n0.0,1.0\n0.1,2.0\n".encode(encoding))
    assert read_source(path, None, None).signals["yaw_rate"].unit == "°/s"


def test_table_that_ends_within_a_row_is_read_and_noted(tmp_path: Path) -> None:
    path = write(tmp_path / "a.csv", "t,ax,ay\n0.0,1.0,0.0\n0.1,1.0,0.0\n0.2,1.")
    recording = read_source(path, None, None)
    assert np.allclose(recording.signals["ax"].t, [0.0, 0.1])
    assert recording.notes == ["a.csv: 1 incomplete rows left out"]


def test_table_with_a_preamble_is_refused_with_its_columns(tmp_path: Path) -> None:
    path = write(tmp_path / "a.csv", "Car 7\nt,ax,ay\n0.0,1.0,0.0\n0.1,1.0,0.0\n")
    with pytest.raises(InputError, match="a row has 3 columns, the first line has 1"):
        read_source(path, None, None)


def test_table_with_another_separator_is_refused(tmp_path: Path) -> None:
    path = write(tmp_path / "a.csv", "t|ax|ay\n0.0|1.0|0.0\n0.1|1.0|0.0\n")
    with pytest.raises(InputError, match="has one column, 't|ax|ay'; separate its columns by"):
        read_source(path, None, None)


def test_column_that_is_not_only_numbers_is_noted(tmp_path: Path) -> None:
    path = write(tmp_path / "a.csv", "t,ax,ay\n0.0,1.0,-\n0.1,1.0,0.5\n")
    recording = read_source(path, None, None)
    assert recording.signals.keys() == {"ax"}
    assert recording.notes == ["a.csv: left out, not only numbers: ay ('-')"]


@pytest.mark.parametrize("time", ["0.0", "2026-11-29T10:00:00.0Z"])
def test_positions_in_degrees_are_not_taken_for_racelogic(tmp_path: Path, time: str) -> None:
    text = f"time,latitude,longitude,satellites\n{time},48.0,11.0,8\n"
    recording = read_source(write(tmp_path / "a.csv", text), None, None)
    assert recording.signals["longitude"].values[0] == 11.0


def test_a_cut_frame_does_not_remove_its_signal(tmp_path: Path) -> None:
    text = "(1.00) can0 0AA#1027\n(1.01) can0 0AA#1127\n(1.02) can0 0AA#11\n"
    recording = read_source(write(tmp_path / "a.log", text), None, DATABASE)
    values = recording.signals["Wheels.Speed"].values
    assert np.allclose(values, [100.0, 100.01, np.nan], equal_nan=True)


def test_a_clock_that_was_set_back_is_refused(tmp_path: Path) -> None:
    times = [1.0, 1.01, 1.02, 1.03, 1.005, 1.015, 1.025]
    lines = [f"({time:.3f}) can0 0AA#1027" for time in times]
    with pytest.raises(InputError, match="set back at 1.030 s; cut the log there"):
        read_source(write(tmp_path / "a.log", "\n".join(lines)), None, DATABASE)
    parts = [*lines[4:], *(line.replace("(1.", "(0.") for line in lines[:4])]
    assert len(read_source(write(tmp_path / "b.log", "\n".join(parts)), None, DATABASE).signals)


def test_import_keeps_a_draft_that_was_edited(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    text = "t,ax,ay\n0.0,1.0,0.0\n0.1,1.0,0.0\n"
    command = ["import", str(write(tmp_path / "a.csv", text)), "--out", str(tmp_path / "o.parquet")]
    assert [main(command), main(command)] == [1, 1]
    draft = tmp_path / "o.profile.json"
    edited = draft.read_text().replace('"signal": "ax"', '"signal": "ax", "unit": "g"')
    draft.write_text(edited)
    assert main(command) == 2
    assert "use it with --profile" in capsys.readouterr().err
    assert draft.read_text() == edited


def test_a_unit_that_is_not_known_is_noted(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    text = "t,ax [mg],air_temperature [F]\n0.0,100,23\n0.1,100,23\n"
    out = tmp_path / "o.parquet"
    main(["import", str(write(tmp_path / "a.csv", text)), "--out", str(out)])
    stdout = capsys.readouterr().out
    assert "note: ax: its unit 'mg' is unknown; taken as m/s^2" in stdout
    assert "note: no source has a date; replay --publish needs --start" in stdout
    assert pq.read_table(out)["air_temperature"][0].as_py() == pytest.approx(-5.0)


def test_import_names_each_missing_wheel(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    text = "t,ax,ay,yaw_rate,delta_fr,omega_fl\n0.0,1,1,1,1,1\n0.1,1,1,1,1,1\n"
    source = write(tmp_path / "a.csv", text)
    assert main(["import", str(source), "--out", str(tmp_path / "o.parquet")]) == 1
    assert "no reading of omega_fr, omega_rl, omega_rr: check" in capsys.readouterr().err


def test_import_names_a_misspelt_signal_of_the_profile(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    text = "t,AccX,AccY\n0.0,1,1\n0.1,1,1\n"
    source = write(tmp_path / "a.csv", text)
    profile = tmp_path / "own.json"
    channels = {"ax": {"signal": "AccXX"}, "ay": {"signal": "AccY"}}
    profile.write_text(json.dumps({"version": 1, "name": "own", "channels": channels}))
    main(["import", str(source), "--profile", str(profile), "--out", str(tmp_path / "o.parquet")])
    stdout = capsys.readouterr().out
    assert "note: ax: no recording has the signal AccXX; did you mean AccX?" in stdout
    assert "note: ay" not in stdout


def test_a_clock_that_jumps_by_years_is_refused(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    dbc = 'BO_ 170 I: 2 X\n SG_ ax : 0|16@1+ (0.01,0) [0|0] "m/s^2" X\n'
    write(tmp_path / "a.dbc", dbc)
    times = [0.0, 0.01, *(1.7e9 + 0.01 * k for k in range(20))]
    log = write(tmp_path / "a.log", "\n".join(f"({time:.2f}) can0 0AA#1027" for time in times))
    more = ["--dbc", str(tmp_path / "a.dbc"), "--out", str(tmp_path / "o.parquet")]
    assert main(["import", str(log), *more]) == 2
    assert "cut it into shorter recordings" in capsys.readouterr().err


def test_a_suffix_in_capitals_is_parquet(tmp_path: Path) -> None:
    pq.write_table(pa.table({"t": [0.0, 0.01], "ax": [1.0, 2.0]}), tmp_path / "a.PARQUET")
    assert read_source(tmp_path / "a.PARQUET", None, None).signals["ax"].values[1] == 2.0


@pytest.mark.parametrize(
    ("options", "message"),
    [
        (("--draft", "a.csv"), "draft: a.csv is one of the recordings"),
        (("--draft", "out.parquet"), "draft: out.parquet is the signal log"),
        (("--clock", "a.csv=nan"), "clock: 'a.csv=nan' is not a time shift"),
        (("--clock", "b.csv=0.1"), "clock: b.csv is not one of the recordings"),
    ],
)
def test_import_does_not_overwrite_a_recording_or_ignore_a_clock(
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
    options: tuple[str, str],
    message: str,
) -> None:
    monkeypatch.chdir(tmp_path)
    text = "t,ax,ay\n0.0,1.0,0.0\n0.01,1.0,0.0\n"
    path = write(Path("a.csv"), text)
    assert main(["import", "a.csv", "--out", "out.parquet", *options]) != 0
    assert message in capsys.readouterr().err
    assert path.read_text() == text
    assert not Path("out.parquet").exists()


def test_log_that_ends_within_a_line_is_read_and_noted(tmp_path: Path) -> None:
    header = "date Mon Jan 1 00:00:00 2026\nbase hex timestamps absolute\n"
    frame = "   {:.6f} 1  AA   Rx   d 8 01 02 03 04 05 06 07 08\n"
    text = header + "".join(frame.format(0.01 * k) for k in range(10))
    whole = read_source(write(tmp_path / "a.asc", text), None, DATABASE)
    cut = read_source(write(tmp_path / "b.asc", text + "   0.1"), None, DATABASE)
    assert whole.notes == []
    assert cut.notes == ["b.asc: cut off, its last line is incomplete"]
    assert {name: len(one.t) for name, one in cut.signals.items()} == {
        name: len(one.t) for name, one in whole.signals.items()
    }


@pytest.mark.parametrize("name", ["a.asc", "a.log"])
def test_log_without_frames_is_refused(tmp_path: Path, name: str) -> None:
    with pytest.raises(InputError, match="holds no CAN frame"):
        read_source(write(tmp_path / name, ""), None, DATABASE)


def test_database_of_a_bag_without_metadata_is_refused(tmp_path: Path) -> None:
    with pytest.raises(InputError, match=r"has no metadata.yaml next to it; run ros2 bag reindex"):
        read_source(write(tmp_path / "a.db3", ""), None, None)
