"""Tests of `edge-agent import`. A drive in any format must become the same log, the clocks of its
sources must be aligned, and damaged files must cause no crash.
"""

from __future__ import annotations

import json
import os
import re
from collections.abc import Callable
from datetime import timedelta
from pathlib import Path
from typing import Any

import can
import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest

from edge_agent.cli import main
from edge_agent.inputs.bring_in import PROVENANCE, read_source
from edge_agent.inputs.profile import FOLDER, Profile, load_profile, shipped_profiles
from edge_agent.inputs.readers.dbc import read_dbc
from schemas.errors import InputError
from schemas.numeric import FloatArray
from tests.edge_agent.inputs import formats
from tests.edge_agent.inputs.formats import BLF, NMEA, VEHICLE

Output = pytest.CaptureFixture[str]
FIRST = 1500  # [frames] six seconds


def bring(
    out: Path, *sources: Path, more: tuple[str, ...] = ("--profile", "toyota"), code: int = 0
) -> pa.Table:
    words = ["import", *map(str, sources), *more, "--vehicle", str(VEHICLE), "--out", str(out)]
    assert main(words) == code
    return pq.read_table(out)


def column(table: pa.Table, name: str) -> FloatArray:
    return np.array(table[name].to_pylist(), dtype=float)


@pytest.fixture(scope="module")
def some() -> list[can.Message]:
    return formats.frames(FIRST)


def test_the_real_minute_becomes_a_log_in_si_with_its_provenance(tmp_path: Path) -> None:
    table = bring(tmp_path / "drive.parquet", BLF, NMEA)
    assert table.num_rows == 5999
    speed = column(table, "omega_fl") * 0.345
    fixes = np.isfinite(column(table, "gnss_speed"))
    assert fixes.sum() == 579
    assert np.corrcoef(speed[fixes], column(table, "gnss_speed")[fixes])[0, 1] > 0.995
    second = np.ones(100) / 100
    turning, lateral = (np.convolve(column(table, n), second, "valid") for n in ("yaw_rate", "ay"))
    assert np.corrcoef(speed[99:] * turning, lateral)[0, 1] > 0.7, "a_y and v r have one sign"
    assert str(table["timestamp"][0]).startswith("2018-08-02 16:14:48")
    provenance = json.loads(table.schema.metadata[PROVENANCE])
    assert provenance["sources"] == ["rav4.blf", "rav4.nmea"]
    assert provenance["channels"]["ax"]["jitter_s"] > 1e-3, "arrival in bursts was straightened"


WRITERS: dict[str, Callable[[Path, list[can.Message]], Path]] = {
    "asc": lambda folder, some: formats.as_log(folder / "a.asc", some),
    "candump": lambda folder, some: formats.as_log(folder / "a.log", some),
    "trc": lambda folder, some: formats.as_log(folder / "a.trc", some),
    "mf4": lambda folder, some: formats.as_mf4(folder / "a.mf4", some),
    "mcap": lambda folder, some: formats.as_bag(folder / "bag", some),
    "sqlite": lambda folder, some: formats.as_bag(folder / "bag", some, "sqlite3"),
}


@pytest.mark.parametrize("kind", WRITERS)
def test_one_drive_is_one_log_in_every_format(
    tmp_path: Path, some: list[can.Message], kind: str
) -> None:
    whole = bring(tmp_path / "blf.parquet", formats.as_log(tmp_path / "a.blf", some))
    other = bring(tmp_path / "other.parquet", WRITERS[kind](tmp_path, some))
    assert whole.num_rows > 500
    assert [n for n in other.column_names if n[0] != "t"] == [
        n for n in whole.column_names if n[0] != "t"
    ]
    # A TRC file stores times in ms with at most four digits.
    close = 1e-3 if kind == "trc" else 1e-9
    for name in whole.column_names[1:]:
        assert np.allclose(
            column(whole, name), column(other, name), rtol=0, atol=close, equal_nan=True
        ), name


@pytest.mark.parametrize("mark", [",", ";"])
def test_a_log_as_csv_is_the_same_log(tmp_path: Path, some: list[can.Message], mark: str) -> None:
    whole = bring(tmp_path / "blf.parquet", formats.as_log(tmp_path / "a.blf", some), NMEA)
    text = formats.as_csv(tmp_path / "a.csv", tmp_path / "blf.parquet", mark=mark)
    other = bring(tmp_path / "csv.parquet", text, more=())
    for name in set(whole.column_names) - {"gnss_speed"}:
        assert whole[name].equals(other[name]), name


def test_profile_draft_from_names_of_a_measurement_file_and_a_bag(
    tmp_path: Path, capsys: Output
) -> None:
    import asammdf

    t = np.arange(300) / 100.0
    mdf = asammdf.MDF(version="4.10")
    for name, unit, value in (
        ("LongAcc", "g", 0.1),
        ("LatAcc", "m/s²", 0.2),
        ("YawRate", "°/s", 3.0),
        ("WheelSpeed_FL", "km/h", 36.0),
        ("SteeringWheelAngle", "deg", 16.0),
    ):
        mdf.append(asammdf.Signal(np.full(300, value), t, name=name, unit=unit))
    mdf.save(tmp_path / "lab.mf4")
    mdf.close()
    vehicle = json.loads(VEHICLE.read_text()) | {"steering_ratio": 16.0}
    (tmp_path / "car.json").write_text(json.dumps(vehicle))
    out = tmp_path / "lab.parquet"
    words = ["--vehicle", str(tmp_path / "car.json"), "--out", str(out)]
    assert main(["import", str(tmp_path / "lab.mf4"), *words]) == 1
    table = pq.read_table(out)
    means = {name: float(np.mean(column(table, name))) for name in table.column_names[1:]}
    expected = {
        "ax": 0.980665,
        "ay": 0.2,
        "yaw_rate": np.radians(3),
        "omega_fl": 10 / 0.345,
        "delta_fl": np.radians(1),
    }
    assert {name: means[name] for name in expected} == pytest.approx(expected, rel=1e-2)
    assert "drafted from names" in capsys.readouterr().out
    Profile.model_validate_json((tmp_path / "lab.profile.json").read_text())


def test_sensor_topics_of_a_bag_keep_their_own_stamps(tmp_path: Path) -> None:
    from rosbags.rosbag2 import StoragePlugin, Writer
    from rosbags.typesys import Stores, get_typestore

    types = get_typestore(Stores.ROS2_HUMBLE)
    header, time, vector, quaternion, imu = (
        types.types[name]
        for name in (
            "std_msgs/msg/Header",
            "builtin_interfaces/msg/Time",
            "geometry_msgs/msg/Vector3",
            "geometry_msgs/msg/Quaternion",
            "sensor_msgs/msg/Imu",
        )
    )
    with Writer(tmp_path / "bag", version=9, storage_plugin=StoragePlugin.MCAP) as writer:
        topic = writer.add_connection("/imu", "sensor_msgs/msg/Imu", typestore=types)
        for k in range(200):
            ns = 10**18 + k * 10_000_000
            message = imu(
                header(time(ns // 10**9, ns % 10**9), ""),
                quaternion(0, 0, 0, 1),
                np.zeros(9),
                vector(0, 0, 0.01 * k),
                np.zeros(9),
                vector(1.0, 2.0, 9.81),
                np.zeros(9),
            )
            late = ns + (k % 7) * 3_000_000
            writer.write(topic, late, types.serialize_cdr(message, "sensor_msgs/msg/Imu"))
    table = bring(tmp_path / "imu.parquet", tmp_path / "bag", more=(), code=1)
    assert set(table.column_names) == {"timestamp", "ax", "ay", "yaw_rate"}
    assert np.allclose(np.diff(column(table, "yaw_rate")), 0.01, atol=1e-9)


def test_gpsd_reports_are_the_same_fixes_as_sentences(
    tmp_path: Path, some: list[can.Message]
) -> None:
    from edge_agent.inputs.readers.gnss import read_gnss

    fixes = read_gnss(NMEA)
    assert fixes.start_ns is not None
    lines = ['{"class":"VERSION","release":"3.22"}']
    for k, t in enumerate(fixes.signals["latitude"].t):
        when = np.datetime64(fixes.start_ns + round(t * 1e9), "ns").astype("datetime64[ms]")
        one = {name: series.values[k] for name, series in fixes.signals.items()}
        report = {
            "class": "TPV",
            "mode": 3,
            "time": f"{when}Z",
            "lat": one["latitude"],
            "lon": one["longitude"],
        }
        lines.append(json.dumps(report | {"speed": one["speed"], "track": one["course"]}))
    (tmp_path / "a.gpsd").write_text("\n".join([*lines, '{"class":"TPV"', "\0"]))
    again = read_gnss(tmp_path / "a.gpsd")
    assert again.start_ns == fixes.start_ns
    assert again.notes == ["a.gpsd: 1 lines left out: broken, or earlier than a line before"]
    for name, series in fixes.signals.items():
        assert np.allclose(series.values, again.signals[name].values)
        assert np.allclose(series.t, again.signals[name].t)


def test_log_in_local_time_is_aligned_to_the_date_of_its_receiver(
    tmp_path: Path, some: list[can.Message], capsys: Output
) -> None:
    for message in some:
        message.timestamp -= timedelta(hours=7).total_seconds()
    try:
        log = formats.as_log(tmp_path / "local.log", some)
    finally:
        for message in some:
            message.timestamp += timedelta(hours=7).total_seconds()
    table = bring(tmp_path / "drive.parquet", log, NMEA)
    assert str(table["timestamp"][0]).startswith("2018-08-02 16:14:48")
    assert "time zone" in capsys.readouterr().out
    assert np.isfinite(column(table, "gnss_speed")).sum() > 40


def test_clocks_that_do_not_meet_are_an_error_with_its_remedy(
    tmp_path: Path, some: list[can.Message], capsys: Output
) -> None:
    text = NMEA.read_text().replace(",020818,", ",030918,").splitlines()
    for k, line in enumerate(text):
        body = line[1 : line.index("*")]
        total = 0
        for byte in body.encode():
            total ^= byte
        text[k] = f"${body}*{total:02X}"
    (tmp_path / "late.nmea").write_text("\n".join(text))
    log = formats.as_log(tmp_path / "a.blf", some)
    arguments = [
        "import",
        str(log),
        str(tmp_path / "late.nmea"),
        "--profile",
        "toyota",
        "--vehicle",
        str(VEHICLE),
    ]
    assert main([*arguments, "--out", str(tmp_path / "o.parquet")]) == 2
    out = ["--out", str(tmp_path / "o.parquet"), "--clock"]
    shift = re.search("--clock (late.nmea=-27648..), or", capsys.readouterr().err)
    assert shift is not None
    assert main([*arguments, *out, "late.nmea=-2000000"]) == 2
    assert "its clock is 7648" in capsys.readouterr().err
    assert main([*arguments, *out, shift[1]]) == 0


def test_note_states_that_a_log_was_cut_off(tmp_path: Path, capsys: Output) -> None:
    whole = BLF.read_bytes()
    for name, size in (("whole", len(whole)), ("cut", len(whole) // 2)):
        path = tmp_path / f"{name}.blf"
        path.write_bytes(whole[:size])
        bring(tmp_path / f"{name}.parquet", path)
        note = f"note: {name}.blf: cut off, {size} of {len(whole)} bytes are left"
        assert (note in capsys.readouterr().out) == (name == "cut")


def test_positions_alone_are_no_drive(tmp_path: Path, capsys: Output) -> None:
    assert main(["import", str(NMEA), "--out", str(tmp_path / "o.parquet")]) == 2
    assert "error: source: has only positions; add a recording" in capsys.readouterr().err


def test_a_rim_speed_without_a_radius_is_an_error(
    tmp_path: Path, some: list[can.Message], capsys: Output
) -> None:
    log = formats.as_log(tmp_path / "a.blf", some)
    assert (
        main(["import", str(log), "--profile", "toyota", "--out", str(tmp_path / "o.parquet")]) == 2
    )
    assert "radius" in capsys.readouterr().err


def test_import_refuses_an_ending_other_than_parquet(tmp_path: Path, capsys: Output) -> None:
    assert main(["import", str(BLF), "--out", str(tmp_path / "a.csv")]) == 2
    assert capsys.readouterr().err.startswith("error: out: a.csv has no known ending; ")


def test_advised_command_quotes_a_path_with_spaces(tmp_path: Path, capsys: Output) -> None:
    path = tmp_path / "my drive.csv"
    path.write_text("t,ax\n")
    assert main(["check", str(path), "--vehicle", "class:suv"]) == 2
    log = path.with_suffix(".parquet")
    assert f"edge-agent import '{path}' --out '{log}'" in capsys.readouterr().err


def test_the_shipped_profiles_are_listed(capsys: Output) -> None:
    assert main(["import", "--list"]) == 0
    assert {line.split()[0] for line in capsys.readouterr().out.splitlines()} == set(
        shipped_profiles()
    )
    assert main(["import", "--list", "--json"]) == 0
    assert set(json.loads(capsys.readouterr().out)) == set(shipped_profiles())


def test_another_database_and_a_named_draft(tmp_path: Path, some: list[can.Message]) -> None:
    (tmp_path / "p.dbc").write_text(
        (FOLDER / "toyota.dbc").read_text().replace("(0.244,-125)", "(0.488,-250)")
    )
    log = formats.as_log(tmp_path / "a.blf", some)
    plain = bring(tmp_path / "a.parquet", log)
    other = bring(
        tmp_path / "b.parquet", log, more=("--profile", "toyota", "--dbc", str(tmp_path / "p.dbc"))
    )
    assert np.allclose(2.0 * column(plain, "yaw_rate"), column(other, "yaw_rate"), equal_nan=True)
    arguments = [
        "import",
        str(log),
        "--dbc",
        str(FOLDER / "toyota.dbc"),
        "--out",
        str(tmp_path / "c.parquet"),
    ]
    vehicle = json.loads(VEHICLE.read_text()) | {"steering_ratio": 16.88}
    (tmp_path / "car.json").write_text(json.dumps(vehicle))
    assert (
        main(
            [
                *arguments,
                "--vehicle",
                str(tmp_path / "car.json"),
                "--draft",
                str(tmp_path / "d" / "p.json"),
            ]
        )
        == 0
    )
    drafted, _ = load_profile(str(tmp_path / "d" / "p.json"))
    assert set(drafted.channels) == set(load_profile("toyota")[0].channels)


@pytest.mark.parametrize(
    ("change", "named"),
    [
        ({"version": 2}, "version"),
        ({"channels": {"speed": {"signal": "x"}}}, "speed"),
        ({"channels": {"ax": {"signal": "x", "unit": "deg"}}}, "deg"),
        ({"channels": {"ax": {"signal": "x", "factor": 2}}}, "factor"),
        ({"steering_ratio": 0.1}, "steering_ratio"),
    ],
)
def test_a_profile_is_checked(tmp_path: Path, change: dict[str, Any], named: str) -> None:
    (tmp_path / "p.json").write_text(
        json.dumps({"version": 1, "name": "p", "channels": {}} | change)
    )
    with pytest.raises(InputError, match=named):
        load_profile(str(tmp_path / "p.json"))


def test_a_validity_bit_and_a_sign_bit_are_heeded(tmp_path: Path) -> None:
    t = np.arange(5) / 10.0
    pq.write_table(
        pa.table({"t": t, "r": [1.0] * 5, "s": [0, 1, 0, 1, None], "ok": [0, 0, 1, 1, 0]}),
        tmp_path / "a.parquet",
    )
    channel = {
        "signal": "r",
        "unit": "deg/s",
        "sign": {"signal": "s"},
        "valid": {"ok": [0]},
        "scale": 2.0,
        "offset": 0.5,
    }
    (tmp_path / "p.json").write_text(
        json.dumps({"version": 1, "name": "p", "channels": {"yaw_rate": channel}})
    )
    profile = ("--profile", str(tmp_path / "p.json"))
    table = bring(tmp_path / "o.parquet", tmp_path / "a.parquet", more=profile, code=1)
    two = np.radians(2.0)
    assert np.allclose(
        column(table, "yaw_rate"), [two + 0.5, 0.5 - two, np.nan, np.nan, np.nan], equal_nan=True
    )


def broken(data: bytes, kind: str, rng: np.random.Generator) -> bytes:
    """Return the bytes `data` of a file, damaged as a failing or hostile recorder may damage it.

    If `kind` is "cut", the file ends early. If it is "full", eight bytes have all bits set.
    Otherwise 20 bytes are random.
    """
    if kind == "cut":
        return data[: int(rng.integers(len(data)))]
    if kind == "full":
        place = int(rng.integers(len(data) - 8))
        return data[:place] + b"\xff" * 8 + data[place + 8 :]
    changed = bytearray(data)
    for place in rng.integers(len(data), size=20):
        changed[place] = int(rng.integers(256))
    return bytes(changed)


@pytest.mark.parametrize(
    "kind", ["blf", "asc", "log", "trc", "mf4", "mcap", "csv", "parquet", "nmea"]
)
@pytest.mark.filterwarnings("ignore")
def test_hostile_file_gives_one_clear_error_or_its_valid_readings(
    tmp_path: Path, kind: str
) -> None:
    few = formats.frames(60)
    rng = np.random.default_rng(5)
    good = tmp_path / f"good.{kind}"
    if kind in ("csv", "parquet"):
        bring(tmp_path / "good.parquet", formats.as_log(tmp_path / "g.blf", few))
        formats.as_csv(tmp_path / "good.csv", tmp_path / "good.parquet")
    elif kind == "mcap":
        good = next(formats.as_bag(tmp_path / "bag", few).glob("*.mcap"))
    elif kind == "mf4":
        formats.as_mf4(good, few)
    elif kind == "nmea":
        good.write_text("".join(NMEA.read_text().splitlines(keepends=True)[:20]))
    else:
        formats.as_log(good, few)
    data = good.read_bytes()
    bad = tmp_path / f"bad.{kind}"
    refused = 0
    profile, database = (
        (None, None)
        if kind in ("csv", "parquet", "nmea")
        else (load_profile("toyota")[0], read_dbc(FOLDER / "toyota.dbc"))
    )
    for k in range(3 if kind == "mf4" else 24):  # each file is read in a process of its own
        bad.write_bytes(broken(data, ("cut", "full", "changed")[k % 3], rng))
        try:
            read_source(bad, profile, database)
        except InputError:
            refused += 1
    assert refused > 0 or kind in ("nmea", "asc", "log", "trc", "csv"), "text is read line by line"


def test_pipe_that_nobody_writes_to_is_refused(tmp_path: Path) -> None:
    os.mkfifo(tmp_path / "a.csv")
    with pytest.raises(InputError, match="is not a file"):
        read_source(tmp_path / "a.csv", None, None)


def test_blocks_of_a_measurement_in_a_circle_are_refused(tmp_path: Path) -> None:
    import struct

    path = formats.as_mf4(tmp_path / "a.mf4", formats.frames(60))
    data = bytearray(path.read_bytes())
    group = struct.unpack_from("<Q", data, 64 + 24)[0]  # position of the first data group
    struct.pack_into("<Q", data, group + 24, group)  # its link to the next group points to itself
    path.write_bytes(bytes(data))
    with pytest.raises(InputError, match="circle"):
        read_source(path, load_profile("toyota")[0], read_dbc(FOLDER / "toyota.dbc"))


@pytest.mark.filterwarnings("ignore")
@pytest.mark.parametrize("part", ["*.db3", "metadata.yaml"])
def test_hostile_bag_folder_gives_a_clear_error_or_its_valid_readings(
    tmp_path: Path, part: str
) -> None:
    folder = formats.as_bag(tmp_path / "bag", formats.frames(60), "sqlite3")
    rng = np.random.default_rng(6)
    refused = 0
    file = next(folder.glob(part))
    data = file.read_bytes()
    profile = load_profile("toyota")[0]
    database = read_dbc(FOLDER / "toyota.dbc")
    assert read_source(folder, profile, database).signals
    for k in range(18):
        file.write_bytes(broken(data, ("cut", "full", "changed")[k % 3], rng))
        try:
            read_source(folder, profile, database)
        except InputError:
            refused += 1
    assert refused > 0


def test_hostile_database_or_profile_gives_a_clear_error_or_valid_parts(
    tmp_path: Path,
) -> None:
    rng = np.random.default_rng(7)
    refused = 0
    dbc = (FOLDER / "toyota.dbc").read_bytes()
    profile = (FOLDER / "toyota.json").read_bytes()
    for k in range(60):
        kind = ("cut", "full", "changed")[k % 3]
        (tmp_path / "p.dbc").write_bytes(broken(dbc, kind, rng))
        (tmp_path / "p.json").write_bytes(broken(profile, kind, rng))
        for read in (
            lambda: read_dbc(tmp_path / "p.dbc"),
            lambda: load_profile(str(tmp_path / "p.json")),
        ):
            try:
                read()
            except InputError:
                refused += 1
    assert 20 < refused < 120
    (tmp_path / "p.dbc").write_bytes(
        b"BO_ 1 A: 8 X\n" + b' SG_ S : 0|8@1+ (1,0) [0|0] "" X\n' * 200_000
    )
    assert len(read_dbc(tmp_path / "p.dbc")["A"].signals) == 1
    (tmp_path / "p.json").write_bytes(b'{"channels":' * 50_000)
    with pytest.raises(InputError):
        load_profile(str(tmp_path / "p.json"))
