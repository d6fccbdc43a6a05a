"""Tests of the agent's commands: advice about files that are no signal logs, output that cannot be
written, and the exit code when something is left to do.
"""

from __future__ import annotations

import json
import math
import re
import resource
import sqlite3
from contextlib import closing
from pathlib import Path

import pyarrow as pa
import pyarrow.csv as pacsv
import pyarrow.parquet as pq
import pytest

from edge_agent.cli import main
from edge_agent.publish.batching import Draft
from edge_agent.publish.outbox import Outbox
from edge_agent.publish.spool_file import SpoolFile
from schemas import tables
from schemas.signals import per_wheel
from schemas.wire import Kind
from tests.edge_agent.service import Router, Service
from tests.ports import free_ports

Output = pytest.CaptureFixture[str]
DRIVE = ["simulate", "slalom", "--duration", "1"]


def write_drive(path: Path) -> list[str]:
    """Simulate a drive, write its log and `car.json` next to it, and return the words that replay
    needs.
    """
    car = path.with_name("car.json")
    assert main([*DRIVE, "--out", str(path), "--vehicle-out", str(car)]) == 0
    return ["replay", str(path), "--vehicle", str(car), "--estimator", "ckf"]


@pytest.mark.parametrize("ending", ["csv", "parquet"])
@pytest.mark.parametrize("command", ["check", "replay", "import"])
def test_estimates_given_as_a_log_are_recognised(
    tmp_path: Path, capsys: Output, ending: str, command: str
) -> None:
    path = tmp_path / f"estimates.{ending}"
    table = pa.table({name: [0.0, 0.1] for name in tables.ESTIMATES_SCHEMA.names})
    if ending == "csv":
        pacsv.write_csv(table, path)
    else:
        pq.write_table(table, path)
    out = tmp_path / ("out.parquet" if command == "import" else "out.html")
    words = [command, str(path), "--out", str(out)]
    assert main(words) == 2
    stderr = capsys.readouterr().err
    assert stderr == (
        f"error: log: {path} contains estimates, not signals; give the signal log from which they "
        "were estimated\n"
    )


def test_a_log_as_csv_comes_with_the_command_that_converts_it(
    tmp_path: Path, capsys: Output
) -> None:
    path = tmp_path / "d.csv"
    out = tmp_path / "d.parquet"
    replay = write_drive(path)
    command = f"edge-agent import {path} --out {out}"
    assert command in capsys.readouterr().err
    assert main(["check", str(path)]) == 2
    assert command in capsys.readouterr().err
    assert main([*replay, "--out", str(tmp_path / "e.parquet")]) == 2
    assert command in capsys.readouterr().err
    assert main(command.split()[1:]) == 0
    assert {"ax", "omega_fl"} <= set(pq.read_schema(out).names)


def test_folder_and_damaged_log_get_fitting_advice(tmp_path: Path, capsys: Output) -> None:
    assert main(["check", str(tmp_path)]) == 2
    assert f"log: {tmp_path} is a folder; name the logs in it" in capsys.readouterr().err
    path = tmp_path / "cut.parquet"
    path.write_bytes(b"PAR1\n")
    assert main(["check", str(path)]) == 2
    assert capsys.readouterr().err.endswith("; copy it again, or import its recording again\n")


def test_full_disk_is_one_line_and_leaves_no_file(tmp_path: Path, capsys: Output) -> None:
    replay = write_drive(tmp_path / "d.parquet")
    car = ["--vehicle", str(tmp_path / "car.json")]
    before = set(tmp_path.iterdir())
    commands = [
        *([*replay, "--out", str(tmp_path / f"x.{ending}")] for ending in ("csv", "html", "svg")),
        ["check", str(tmp_path / "d.parquet"), *car, "--out", str(tmp_path / "page.html")],
        [*DRIVE, "--out", str(tmp_path / "other.parquet")],
    ]
    capsys.readouterr()
    size = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (1000, size[1]))
    try:
        for command in commands:
            assert main(command) == 1
            assert "error: disk: File too large; free some space" in capsys.readouterr().err
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, size)
    assert set(tmp_path.iterdir()) == before


def test_import_without_a_channel_that_replay_needs_returns_1(
    tmp_path: Path, capsys: Output
) -> None:
    """A column without a reading counts as missing, and the warning lists unused signals."""
    path = tmp_path / "little.csv"
    wheels = ",".join(per_wheel("omega"))
    rows = "".join(f"0.{k},1,0,5,50,50,50,,0\n" for k in range(3))
    path.write_text(f"t,ax,ay,gier,{wheels},delta_fl\n{rows}")
    assert main(["import", str(path), "--out", str(tmp_path / "little.parquet")]) == 1
    stderr = capsys.readouterr().err
    profile = tmp_path / "little.profile.json"
    assert "no reading of yaw_rate, omega_rr: check and replay refuse" in stderr
    assert f"--profile {profile}" in stderr
    assert stderr.endswith("signals without a channel: gier\n")
    assert main(["check", str(tmp_path / "little.parquet"), "--vehicle", "class:suv"]) == 2


def test_failed_import_leaves_no_file(tmp_path: Path, capsys: Output) -> None:
    """The wheel radius is missing, then the disk is full."""
    path = tmp_path / "d.csv"
    path.write_text("t,ax,WheelSpeed_FL [km/h]\n0.0,1,9\n0.1,1,9\n")
    command = ["import", str(path), "--out", str(tmp_path / "d.parquet")]
    assert main(command) == 2
    assert "give the wheel's radius" in capsys.readouterr().err
    size = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (100, size[1]))
    try:
        assert main([*command, "--vehicle", "class:suv"]) == 2
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, size)
    assert "error: out: cannot write" in capsys.readouterr().err
    assert [one.name for one in tmp_path.iterdir()] == ["d.csv"]


def test_replay_names_every_format_and_refuses_a_folder_without_files(
    tmp_path: Path, capsys: Output
) -> None:
    replay = write_drive(tmp_path / "d.parquet")
    capsys.readouterr()
    assert main([*replay, "--out", str(tmp_path / "x.nosuch")]) == 2
    assert capsys.readouterr().err.endswith(
        "use one of .parquet, .csv, .mcap, .html, .png, .svg, .pdf\n"
    )
    for name in ("x.parquet", "x.html"):
        assert main([*replay, "--out", f"/proc/{name}"]) == 2
        assert capsys.readouterr().err == (
            f"error: out: cannot write /proc/{name} (No such file or directory); name a file in a "
            "writable folder\n"
        )


@pytest.mark.parametrize("latitude", [math.nan, 127.0])
def test_log_without_a_position_is_not_published(
    tmp_path: Path, capsys: Output, latitude: float
) -> None:
    path = tmp_path / "d.parquet"
    replay = write_drive(path)
    table = pq.read_table(path)
    place = table.column_names.index("latitude")
    values = pa.array([latitude] * table.num_rows)
    pq.write_table(table.set_column(place, "latitude", values), path)
    out = tmp_path / "e.parquet"
    assert main([*replay, "--out", str(out), "--publish", "--trust", "--name", "car-one"]) == 2
    assert f"latitude: {path} has no position, so there is nothing" in capsys.readouterr().err
    assert not out.exists()


def test_connect_replaces_the_router_and_unsent_records_are_reported(
    tmp_path: Path, capsys: Output
) -> None:
    """Nothing listens at the router given by `--connect`, so all records stay in the outbox, whose
    path is printed at the start and at the end; the exit code is 1.
    """
    spool = tmp_path / "spool.sqlite"
    config = tmp_path / "agent.json"
    config.write_text(json.dumps({"zenoh": {"connect": ["tcp/host:1"]}, "spool": str(spool)}))
    endpoint = f"tcp/127.0.0.1:{free_ports(1)[0]}"
    words = ["--config", str(config), "--connect", endpoint, "--estimator", "ckf"]
    assert main(["fleet", "--vehicles", "1", "--duration", "1", *words]) == 1
    seen = capsys.readouterr()
    left = json.loads(seen.out.splitlines()[-1])["unsettled"]
    assert left > 0
    assert f"no session at {endpoint} yet" in seen.err
    assert f"records wait in {spool} until they are acknowledged" in seen.err
    assert re.search(rf"^{left} records without acknowledgement stay in {spool};", seen.err, re.M)


@pytest.mark.parametrize("command", ["fleet", "replay"])
def test_records_lost_by_a_full_outbox_are_reported(
    tmp_path: Path, capsys: Output, command: str
) -> None:
    config = tmp_path / "agent.json"
    config.write_text(json.dumps({"spool": str(tmp_path / "spool.sqlite"), "spool_mb": 1e-5}))
    words = ["fleet", "--vehicles", "1", "--duration", "1", "--estimator", "ckf"]
    if command == "replay":
        log = tmp_path / "d.parquet"
        words = [*write_drive(log), "--out", str(tmp_path / "e.parquet"), "--publish", "--trust"]
    endpoint = f"tcp/127.0.0.1:{free_ports(1)[0]}"
    assert main([*words, "--config", str(config), "--connect", endpoint]) == 1
    seen = capsys.readouterr()
    counts = json.loads(seen.out.splitlines()[-1])
    assert counts["unsettled"] == 0
    assert f"{counts['dropped']} records are lost, because" in seen.err


def test_drive_within_its_unpublished_ends_is_reported(tmp_path: Path, capsys: Output) -> None:
    config = tmp_path / "agent.json"
    config.write_text(json.dumps({"spool": str(tmp_path / "spool.sqlite"), "trip_end_s": 60.0}))
    words = [*write_drive(tmp_path / "d.parquet"), "--out", str(tmp_path / "e.parquet")]
    words += ["--config", str(config), "--connect", f"tcp/127.0.0.1:{free_ports(1)[0]}"]
    assert main([*words, "--publish", "--trust", "--name", "car-one"]) == 0
    assert (
        "note: nothing was published: the ends of a trip are not published (trip_end_m 0, "
        "trip_end_s 60)"
    ) in capsys.readouterr().err


def test_replay_reports_unsent_records_and_how_to_continue(
    tmp_path: Path, capsys: Output, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Nothing listens at the router. A log states a time, or begins such that it ends now."""
    monkeypatch.setattr("edge_agent.cli.replay.DRAIN_S", 0.2)
    spool = tmp_path / "spool.sqlite"
    config = tmp_path / "agent.json"
    config.write_text(json.dumps({"spool": str(spool)}))
    words = [*write_drive(tmp_path / "d.parquet"), "--out", str(tmp_path / "e.parquet")]
    words += ["--config", str(config), "--connect", f"tcp/127.0.0.1:{free_ports(1)[0]}"]
    words += ["--publish", "--trust"]
    capsys.readouterr()
    assert main([*words, "--name", "car-one", "--start", "2026-01-31T07:00:00Z"]) == 1
    seen = capsys.readouterr()
    left = json.loads(seen.out.splitlines()[-1])["unsettled"]
    assert f"{left} records without acknowledgement stay in {spool};" in seen.err
    assert (
        f"error: publish: {left} records were not acknowledged; repeat the command, no record "
        "counts twice\n"
    ) in seen.err
    assert main([*words, "--name", "car-two"]) == 1
    stderr = capsys.readouterr().err
    assert f"{left} records of other vehicle names stay in {spool};" in stderr
    again = re.search(r"repeat the command( with --start 2\S+Z), no record counts twice", stderr)
    assert again is not None
    assert f"note: repeated{again[1]}, this drive counts once; otherwise it is another\n" in stderr
    assert "note: the log has no date: published as if it ended now" in stderr


def test_records_lost_by_a_damaged_outbox_are_reported(
    tmp_path: Path, router: Router, service: Service, capsys: Output
) -> None:
    """An earlier run left a batch that is damaged on the disk. The replayed drive is sent, but the
    loss must not pass as a success.
    """
    spool = tmp_path / "spool.sqlite"
    outbox = Outbox(spool)
    outbox.store([Draft("car-one", Kind.STATE, 77, 3, lambda seq, first: b"three records")], 0.0)
    outbox.close()
    with closing(sqlite3.connect(spool)) as database, database:
        database.execute("UPDATE batch SET payload = X'00'")
    config = tmp_path / "agent.json"
    config.write_text(
        json.dumps({"spool": str(spool), "zenoh": router.settings.model_dump(mode="json")})
    )
    words = [*write_drive(tmp_path / "d.parquet"), "--out", str(tmp_path / "e.parquet")]
    capsys.readouterr()
    assert main([*words, "--publish", "--trust", "--name", "car-one", "--config", str(config)]) == 1
    seen = capsys.readouterr()
    counts = json.loads(seen.out.splitlines()[-1])
    assert counts["published"] == counts["acknowledged"] > 0
    assert f"3 records are lost, because {spool} was damaged" in seen.err


def test_a_disk_that_refuses_the_records_of_a_replay_is_named(
    tmp_path: Path, capsys: Output, monkeypatch: pytest.MonkeyPatch
) -> None:
    def refuse(*_: object) -> None:
        raise sqlite3.OperationalError("database or disk is full")

    monkeypatch.setattr(SpoolFile, "insert_row", refuse)
    config = tmp_path / "agent.json"
    spool = tmp_path / "spool.sqlite"
    config.write_text(json.dumps({"spool": str(spool)}))
    words = [*write_drive(tmp_path / "d.parquet"), "--out", str(tmp_path / "e.parquet")]
    capsys.readouterr()
    assert main([*words, "--publish", "--trust", "--name", "car-one", "--config", str(config)]) == 2
    assert capsys.readouterr().err == (
        f"error: spool: {spool} does not accept the records (database or disk is full); make room "
        "on its disk, then repeat\n"
    )


def test_simulate_does_not_write_the_vehicle_over_its_log(tmp_path: Path, capsys: Output) -> None:
    path = tmp_path / "drive.parquet"
    assert main([*DRIVE, "--out", str(path), "--vehicle-out", str(path)]) == 2
    assert "vehicle-out: " in capsys.readouterr().err
    assert pq.read_table(path).num_rows
