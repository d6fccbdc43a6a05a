"""Tests that every option of the commands has an effect: a test changes the option, runs the
command, and requires another result than before.

A command runs on copies of the reference archive. Its result is its output, its exit code and the
files below its folder. Each command gives the same result twice, so a difference comes from the
option.
"""

from __future__ import annotations

import argparse
import importlib
import importlib.util
import json
import shutil
import signal
import subprocess
import sys
import time
from hashlib import blake2b
from pathlib import Path
from typing import Final, NamedTuple

import pyarrow as pa
import pyarrow.parquet as pq
import pytest
import zenoh
from cryptography import x509

from fleet_service.cli import COMMANDS, main
from fleet_service.lab import campaign
from schemas import grid, wire
from schemas.config import ZenohSettings
from schemas.runtime.commandline import Command
from tests.faults.processes import Part
from tests.fleet_service.app.test_service import Fleet
from tests.fleet_service.archive.reference_archive import DATA, PLACES
from tests.fleet_service.conftest import Running
from tests.fleet_service.examples import CELL, LATITUDE, LONGITUDE, REGION, SECOND, batch
from tests.secured import make_enrolment
from tests.waiting import PATIENCE_S

Capture = pytest.CaptureFixture[str]
ARCHIVE: Final = ["--archive", "{a}"]
ANALYZE: Final = ["analyze", "worst", *ARCHIVE, "--out", "{out}/a.csv"]
REPLAY: Final = [
    "analyze",
    "replay",
    *ARCHIVE,
    "--out",
    "{out}/a.csv",
    "--from",
    "2024-10-04T23:56",
    "--to",
    "2024-10-05",
]
MAP: Final = ["export", "map", *ARCHIVE, "--out", "{out}/a.csv", "--to", "2024-10-04T23:59:50"]
WEATHER: Final = ["analyze", "weather", *ARCHIVE, "--out", "{out}/a.csv"]
CERTS: Final = ["certs", "--fleet", "{fleet}", "--out", "{out}/certs"]
USUAL: Final = {
    "compact": ["compact", *ARCHIVE],
    "retention": ["retention", *ARCHIVE, "--raw-days", "31"],
    "forget": ["forget", *ARCHIVE, "--period", "2024-10"],
    "export": ["export", "observations", *ARCHIVE, "--out", "{out}/a.csv"],
    "analyze": ANALYZE,
    "certs": CERTS,
    "rebuild": ["rebuild", *ARCHIVE, "--out", "{out}/r", "--to", "2024-10-04T23:59:50"],
}
BOX: Final = "11,57,13,59"  # a box around one of two towns
# Each command's options: another value, or a pair of command lines with and without the option. The
# output must differ.
CHANGES: Final[dict[str, dict[str, str | tuple[list[str], list[str]]]]] = {
    "compact": {
        "--archive": "{b}",
        "--put-to": "file://{out}/there",
        "--round-rows": "10",
        "--json": "",
    },
    "retention": {"--archive": "{b}", "--raw-days": "100000", "--dry-run": "", "--json": ""},
    "forget": {
        "--archive": "{b}",
        "--period": "2024-09",
        "--vehicle": "sim-003",
        "--dry-run": "",
        "--json": "",
    },
    "export": {
        "what": (["export", "rollup", *USUAL["export"][2:]], USUAL["export"]),
        "--archive": "{b}",
        "--out": "{out}/a.geojson",
        "--from": "2024-10-05",
        "--to": "2024-10-04",
        "--bbox": BOX,
        "--json": "",
        "--snapshot": ([*MAP, "--snapshot"], MAP),
        "--min-vehicles": ([*MAP, "--min-vehicles", "3"], MAP),
    },
    "analyze": {
        "question": (["analyze", "grip", *ANALYZE[2:]], ANALYZE),
        "--archive": "{b}",
        "--out": "{out}/a.html",
        "--from": "2024-10-04T23:58",
        "--to": "2024-10-04T23:57",
        "--bbox": BOX,
        "--min-vehicles": "5",
        "--engine": "spark",
        "--at": ([*REPLAY, "--at", "2024-10-04T23:57"], REPLAY),
        "--step": ([*REPLAY, "--step", "60"], REPLAY),
        "--json": "",
        "--as-it-lies": "",
        "--stations": ([*WEATHER, "--stations", "{warm}"], [*WEATHER, "--stations", "{cold}"]),
    },
    "rebuild": {
        "--archive": "{b}",
        "--out": "{out}/other",
        "--to": "2024-10-04T23:57",
        "--engine": "spark",
        "--as-it-lies": "",
        "--json": "",
    },
    "certs": {
        "--fleet": "{fleet2}",
        "--out": "{out}/others",
        "--at": "/etc/gripmap/certs",
        "--days": "100",
        "--ca-days": "1000",
        "--ca": ([*CERTS, "--ca", "next"], CERTS),
    },
}
SHOWN_BELOW: Final = {
    "retention": {"--yes"},
    # These options are covered by test_commands.py, archive/test_retention.py and app/test_copy.py.
    "forget": {
        "--yes",
        "--put-to",
        "--config",
    },
    "completion": {"shell"},
    "certs": {"--renew-days", "--revoke", "--dry-run"},  # covered by enrolment/test_certificates.py
    # Covered by shards/test_successor.py.
    "run": {"--config", "--archive", "--weather", "--standby"},
    "export": {  # covered by client/test_datex.py and archive/test_iceberg.py
        *("--country", "--supplier", "--status", "--follow", "--connect", "--config"),
        *("--catalog", "--namespace", "--at"),
        *("--exclude-ice", "--last", "--roads"),  # covered by test_refused_files.py
    },
    # Covered by app/test_sizing.py.
    "size": {"--vehicles", "--road-km", "--latitude", "--rate", "--json"},
    "roads": {"extract", "--out", "--id", "--name"},  # covered by analytics/roads/test_join.py
    # Covered by analytics/roads/test_contract.py.
    "analyze": {"--roads", "--level", "--within", "--last"},
    "query": {
        "--bbox",
        "--route",
        "--min-vehicles",
        "--at",
        "--basis",
        "--format",
        "--out",
        "--connect",
        "--config",
    },
    "router": {"--config", "--listen", "--metrics-host", "--metrics-port"},
    "cits": {
        "--connect",
        "--config",
        "--amqp",
        "--to",
        "--from",
        "--selector",
        "--witness",
        "--station",
        "--country",
        "--publisher",
        "--state",
    },
    "page": {  # covered by page/test_server.py
        "--archive",
        "--host",
        "--port",
        "--name",
        "--metrics",
        "--overlay",
        "--base-map",
        "--attribution",
        "--roads",
        "--datex",
        "--country",
        "--supplier",
        "--status",
        "--connect",
        "--config",
    },
    "hand-over": {"region", "--to", "--connect", "--config"},  # covered by shards/test_handover.py
    "watch": {
        "--bbox",
        "--connect",
        "--config",
        "--alerts",
        "--json",
        "--webhook",
        "--webhook-queue",
        "--health-port",
    },
}
# Other modules that call the command with these options.
GIVEN_IN: Final[dict[str, tuple[str, ...]]] = {
    "retention": ("../test_commands",),
    "forget": ("../test_commands", "archive/test_retention", "app/test_copy"),
    "completion": ("../test_commands",),
    "certs": ("enrolment/test_certificates",),
    "run": (),
    "export": ("client/test_datex", "archive/test_iceberg", "test_refused_files"),
    "size": ("app/test_sizing",),
    "roads": ("analytics/roads/test_join",),
    "analyze": ("analytics/roads/test_contract", "test_refused_files"),
    "router": ("test_refused_files",),
    "query": (),
    "watch": ("client/test_stretches",),
    "page": ("page/test_server",),
    "cits": ("client/cits/test_command",),
    "hand-over": ("shards/test_handover",),
}
# A campaign takes minutes; tests/fleet_service/lab/test_evaluate.py runs a small one.
CAMPAIGN: Final = {"--out", "--quick", "--skip-end-to-end", "--end-to-end", "--only"}


class Done(NamedTuple):
    """Result of a command: exit code, output, and the files below its folder."""

    code: int
    output: str
    files: dict[str, str]


def place(folder: Path) -> dict[str, str]:
    """Create two different archives and the other files that commands need, below `folder`. Return
    their paths by name.
    """
    names = {name: folder / name for name in ("a", "b", "out", "fleet", "fleet2", "warm", "cold")}
    for name in ("a", "b"):
        shutil.copytree(DATA / "v1.0" / "archive", names[name])
    shutil.rmtree(names["b"] / "inbox")
    shutil.rmtree(next((names["b"] / "observations").glob("*/zone=*")))
    shutil.rmtree(next((names["b"] / "rollup/cell_hour").glob("*/zone=*")))
    names["out"].mkdir()
    names["fleet"].write_text(make_enrolment().model_dump_json())
    names["fleet2"].write_text(make_enrolment(vehicles=["car-1"]).model_dump_json())
    for name, degrees in (("warm", 20), ("cold", -5)):
        rows = [
            f"{k},2024-10-04T23:00:00,{lat},{lon},{degrees}\n"
            for k, (lat, lon) in enumerate(PLACES)
        ]
        names[name].write_text("station,time,latitude,longitude,temperature\n" + "".join(rows))
    return {name: str(path) for name, path in names.items()}


def content(path: Path, folder: Path) -> str:
    """Return a text that describes a file's content and is the same in every run. For most files
    it is a hash of the content. For certificates, which are different in every run, it is their
    period of validity [days]. For private keys and READMEs it is "".
    """
    if path.suffix == ".key" or path.name.startswith("README"):
        return ""
    if path.suffix == ".pem":
        found = x509.load_pem_x509_certificates(path.read_bytes())
        return str([(one.not_valid_after_utc - one.not_valid_before_utc).days for one in found])
    return blake2b(path.read_bytes().replace(str(folder).encode(), b""), digest_size=8).hexdigest()


def run_command(words: list[str], folder: Path, capsys: Capture) -> Done:
    """Run the command `words` in a new folder with test files, and return the command's result."""
    names = place(folder)
    code = main([word.format(**names) for word in words])
    captured = capsys.readouterr()
    text = (captured.out + (captured.err if code else "")).replace(str(folder), "")
    files = {
        str(p.relative_to(folder)): content(p, folder)
        for p in sorted(folder.rglob("*"))
        if p.is_file()
    }
    return Done(code, text, files)


def options(command: Command) -> set[str]:
    """Return the names of the options that a command of `fleet-service` has."""
    parser = argparse.ArgumentParser(add_help=False)
    importlib.import_module(command.module).add_arguments(parser)
    return {
        action.option_strings[0] if action.option_strings else action.dest
        for action in parser._actions
    }


def test_every_option_of_every_command_is_in_a_table() -> None:
    for command in COMMANDS:
        shown = set(CHANGES.get(command.name, {})) | SHOWN_BELOW.get(command.name, set())
        assert options(command) == (CAMPAIGN if command.name == "evaluate" else shown), command


@pytest.mark.parametrize("command", SHOWN_BELOW)
def test_the_tests_that_show_an_option_give_it_to_the_command(command: str) -> None:
    """Each option in SHOWN_BELOW must occur in a test that shows its effect. This test searches
    the source of the modules in GIVEN_IN, and the part of this module that follows its tables of
    options.
    """
    own = Path(__file__)
    texts = [(own.parent / f"{name}.py").read_text() for name in GIVEN_IN[command]]
    text = "".join([*texts, own.read_text().partition("class Done")[2]])
    named = {
        option: (f'"{option}"', f"{option.strip('-').replace('-', '_')}=")
        for option in SHOWN_BELOW[command]
    }
    missing = [
        option
        for option, ways in named.items()
        if option[0] == "-" and not any(way in text for way in ways)
    ]
    assert missing == []
    assert all(option in text for option in named if option[0] != "-")


@pytest.mark.campaign
def test_a_standby_without_a_copy_to_follow_is_refused(
    tmp_path: Path, router: ZenohSettings
) -> None:
    config = tmp_path / "config.json"
    config.write_text(json.dumps({"zenoh": router.model_dump()}))
    words = ["run", "--config", str(config), "--archive", str(tmp_path / "a"), "--standby"]
    ended = subprocess.run(
        [sys.executable, "-m", "fleet_service.cli", *words], capture_output=True, text=True
    )
    assert ended.returncode == 2
    assert "error: standby: needs archive.copy" in ended.stderr


def test_the_end_to_end_part_of_a_campaign_is_left_out_or_run_alone(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: Capture
) -> None:
    seen: list[tuple[bool, bool, str | None]] = []

    def note(
        folder: Path, quick: bool, drives: object, log_line: object, *, only: str | None
    ) -> list[object]:
        seen.append((quick, bool(drives), only))
        return []

    monkeypatch.setattr(campaign, "run", note)
    for more in ([], ["--skip-end-to-end"], ["--end-to-end"], ["--only", "value"]):
        assert main(["evaluate", "--out", str(tmp_path), "--quick", *more]) == 0
    assert seen == [
        (True, True, None),
        (True, False, None),
        (True, True, "end-to-end"),
        (True, False, "value"),
    ]


@pytest.mark.parametrize(
    ("command", "option"), [(c, o) for c, changes in CHANGES.items() for o in changes]
)
def test_every_option_of_a_command_changes_what_it_does(
    command: str, option: str, tmp_path: Path, capsys: Capture
) -> None:
    if option == "--engine" and importlib.util.find_spec("pyspark"):
        pytest.skip("Spark is installed; test_spark compares its answers")
    change = CHANGES[command][option]
    usual = USUAL[command]
    if isinstance(change, tuple):
        other, usual = change
    elif option in usual:
        at = usual.index(option) + 1
        other = [*usual[:at], change, *usual[at + 1 :]]
    else:
        other = [*usual, option, *([change] if change else [])]
    first, again = (run_command(usual, tmp_path / name, capsys) for name in ("first", "again"))
    assert first == again
    assert first.code == 0, first.output
    seen = run_command(other, tmp_path / "other", capsys)
    assert seen != first
    wrong = {"--period": "has no key of 2024-09", "--engine": "Spark is not installed"}
    assert wrong.get(option, "") in seen.output
    assert (seen.code == 0) == (option not in wrong), seen.output


@pytest.mark.parametrize(("days", "renewed"), [("5", False), ("20", True)])
def test_certificates_that_end_within_so_many_days_are_renewed(
    days: str, renewed: bool, tmp_path: Path, capsys: Capture
) -> None:
    names = place(tmp_path)
    words = [word.format(**names) for word in CERTS]
    assert main([*words, "--days", "10", "--renew-days", "1"]) == 0
    capsys.readouterr()
    assert main([*words, "--days", "100", "--renew-days", days]) == 0
    assert capsys.readouterr().out.startswith("issued 7: ") == renewed


@pytest.mark.campaign
def test_service_weather_archive_and_configuration_are_those_given(
    tmp_path: Path, router: ZenohSettings
) -> None:
    rain = pa.table({"region": [REGION], "time": [time.time_ns()], "precipitation": [2.0]})
    pq.write_table(rain, tmp_path / "rain.parquet")
    for name, more in (("shard-1", []), ("shard-2", ["--weather", str(tmp_path / "rain.parquet")])):
        config = tmp_path / f"{name}.json"
        archive = tmp_path / name
        config.write_text(json.dumps({"name": name, "zenoh": router.model_dump()}))
        words = ["run", "--config", str(config), "--archive", str(archive), *more]
        part = Part(name, [sys.executable, "-m", "fleet_service.cli", *words], tmp_path)
        part.start()
        try:
            part.line_with(f"ready: {name}, ")
        finally:
            part.stop()
        assert (archive / "inbox").is_dir()
        assert len(list((archive / "weather").glob(f"{name}-*.parquet"))) == bool(more)


FAR: Final = (LATITUDE, LONGITUDE + 0.05)


def there(name: str, mu: float) -> wire.Batch:
    """Return a batch of the vehicle `name` that reports the friction `mu` in the usual region, but
    in another tile.
    """
    cell = int(grid.cell_of(*FAR))
    return batch(
        name, 2, time.time_ns() - SECOND, [mu], latitude=[FAR[0]], longitude=[FAR[1]], cell=[cell]
    )


@pytest.fixture
def fed(service: Running, session: zenoh.Session) -> Fleet:
    """Return a client whose reports the service has acknowledged: three cars reported ice, and
    later one car reported a dry road elsewhere.
    """
    fleet = Fleet(session).await_services()
    fleet.settle(*(batch(f"sim-{k:03}", 1, time.time_ns() - SECOND, [0.2]) for k in range(3)))
    fleet.settle(there("sim-009", 0.8))
    return fleet


@pytest.mark.campaign
@pytest.mark.usefixtures("fed")
def test_every_option_of_a_query_changes_the_answer(
    router: ZenohSettings, tmp_path: Path, capsys: Capture
) -> None:
    out = tmp_path / "a"
    config = tmp_path / "config.json"
    config.write_text(json.dumps({"zenoh": router.model_dump()}))
    usual = {"--connect": router.connect[0], "--format": "json", "--out": str(out)}
    here = CELL
    far = int(grid.cell_of(*FAR))

    def cells(**changed: str | None) -> set[int]:
        given = usual | {f"--{name.replace('_', '-')}": value for name, value in changed.items()}
        words = [
            word for name, value in given.items() if value is not None for word in (name, value)
        ]
        assert main(["query", *words]) == 0
        return {
            row["cell"] for tile in json.loads(out.read_text())["tiles"] for row in tile["cells"]
        }

    assert cells() == {here, far}
    assert cells(bbox="11.96,57.69,11.98,57.71") == {here}
    for form in ("json", "geojson", "arrow"):
        swapped = usual | {"--format": form, "--bbox": "57.69,11.96,57.71,11.98"}
        assert main(["query", *(word for pair in swapped.items() for word in pair)]) == 0
        assert "longitude comes before latitude" in capsys.readouterr().err
    assert cells(route=f"{FAR[1] - 1e-4},{FAR[0]}|{FAR[1] + 1e-4},{FAR[0]}") == {far}
    assert cells(min_vehicles="2") == {here}
    assert cells(at="2024-10-05") == set()
    assert cells(basis="borrowed") > {here, far}
    assert cells(connect=None, config=str(config)) == {here, far}
    assert main(["query", "--connect", "tcp/127.0.0.1:1", "--format", "json"]) == 1
    capsys.readouterr()
    assert main(["query", "--connect", router.connect[0], "--format", "geojson"]) == 0
    assert json.loads(capsys.readouterr().out)["type"] == "FeatureCollection"
    assert main(["query", "--connect", router.connect[0]]) == 0
    assert capsys.readouterr().out.splitlines()[-1] == "2 cells"


def test_box_selects_watched_tiles_and_both_options_name_the_router(
    service: Running, session: zenoh.Session, router: ZenohSettings, tmp_path: Path
) -> None:
    (tmp_path / "config.json").write_text(json.dumps({"zenoh": router.model_dump()}))
    boxes = {"here": "11.96,57.69,11.98,57.71", "far": "12.01,57.69,12.03,57.71"}
    ways = {
        "here": ["--connect", router.connect[0]],
        "far": ["--config", str(tmp_path / "config.json")],
    }
    watching = {}
    for name, box in boxes.items():
        words = [sys.executable, "-m", "fleet_service.cli", "watch", "--bbox", box, *ways[name]]
        watching[name] = Part(name, words, tmp_path)
        watching[name].start()
    try:
        for part in watching.values():
            part.line_with("watching")
        fleet = Fleet(session).await_services()
        fleet.settle(batch("sim-001", 1, time.time_ns() - SECOND, [0.8]), there("sim-009", 0.8))
        tiles = {name: part.line_with("tile ").split()[1] for name, part in watching.items()}
        assert tiles["here"] != tiles["far"]
        for name, part in watching.items():
            part.send_signal(signal.SIGTERM)
            part.wait(PATIENCE_S)
            assert {line.split()[1] for line in part.read_lines() if line.startswith("tile ")} == {
                tiles[name]
            }
    finally:
        for part in watching.values():
            part.kill()
