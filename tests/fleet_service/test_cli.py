"""Tests of the commands of `fleet-service`, run as processes. Output and exit codes must be right,
and each mistake must give one line that names it.
"""

from __future__ import annotations

import json
import re
import signal
import subprocess
import sys
import time
from functools import partial
from pathlib import Path

import pyarrow as pa
import pytest
import zenoh

from deploy.router import open_router
from fleet_service import cli
from fleet_service.analytics.questions import QUESTIONS
from fleet_service.archive.format import reading
from fleet_service.cli import main
from schemas import wire
from schemas.config import ZenohSettings
from schemas.runtime.commandline import Command
from schemas.runtime.zenoh_session import open_session
from schemas.wire import Kind
from tests import reference_pages
from tests.buckets import BucketServer
from tests.faults.processes import Part
from tests.fleet_service.app.test_service import Fleet
from tests.fleet_service.conftest import Running, running
from tests.fleet_service.examples import CELL, SECOND, batch, key
from tests.waiting import PATIENCE_S, until

COMMAND = [sys.executable, "-m", "fleet_service.cli"]


@pytest.mark.parametrize("command", cli.COMMANDS, ids=lambda command: str(command.name))
def test_every_command_has_help_and_every_option_is_in_the_reference(
    command: Command, capsys: pytest.CaptureFixture[str]
) -> None:
    with pytest.raises(SystemExit, match="0"):
        main([command.name, "--help"])
    options = re.findall(r"^  (--[a-z-]+)", capsys.readouterr().out, re.MULTILINE)
    page = reference_pages.command_page("fleet-service")
    assert f"## `{command.name}`" in page
    assert options or command.name == "completion"
    assert not [option for option in options if option not in page]


def test_the_help_of_analyze_names_every_question() -> None:
    (analyze,) = (command for command in cli.COMMANDS if command.name == "analyze")
    assert analyze.help == f"analyse the archive: {', '.join(QUESTIONS)}"


def test_help_works_without_optional_libraries() -> None:
    words = (
        "import sys; from schemas.runtime import commandline; from fleet_service import cli; "
        "commandline.parser_of(*cli.LINE, None); print(*sys.modules)"
    )
    loaded = subprocess.run(
        [sys.executable, "-c", words], capture_output=True, text=True, check=True
    ).stdout.split()
    assert "fleet_service.cli" in loaded
    assert not {"numpy", "pyarrow", "zenoh", "numba", "pydantic"} & set(loaded)


@pytest.fixture
def fed(service: Running, session: zenoh.Session) -> Fleet:
    """Return a client that has published ice reports of three cars. The service has acknowledged
    the reports.
    """
    fleet = Fleet(session).await_services()
    fleet.settle(*(batch(f"sim-{k:03}", 1, time.time_ns() - SECOND, [0.2]) for k in range(3)))
    return fleet


def ask(router: ZenohSettings, *words: str) -> int:
    return main(["query", "--connect", router.connect[0], *words])


@pytest.mark.usefixtures("fed")
def test_query_prints_a_table_or_json_and_writes_files(
    router: ZenohSettings, capsys: pytest.CaptureFixture[str], tmp_path: Path
) -> None:
    assert ask(router) == 0
    lines = capsys.readouterr().out.splitlines()
    assert lines[0].split()[:4] == ["latitude", "longitude", "sector", "mu"]
    assert "measured" in lines[1]
    assert lines[-1] == "1 cells"
    assert ask(router, "--format", "geojson", "--bbox", "11,57,12,58", "--min-vehicles", "2") == 0
    assert json.loads(capsys.readouterr().out)["features"][0]["properties"]["cell"] == CELL
    assert ask(router, "--format", "json", "--out", str(tmp_path / "a.json")) == 0
    assert json.loads((tmp_path / "a.json").read_text())["tiles"][0]["cells"][0]["vehicles"] == 3
    assert ask(router, "--out", str(tmp_path / "a.arrow")) == 0
    with pa.OSFile(str(tmp_path / "a.arrow"), "rb") as file:
        assert pa.ipc.open_stream(file).read_all()["cell"].to_pylist() == [CELL]


@pytest.mark.parametrize(
    ("words", "start"),
    [
        (["--bbox", "1,2,3"], "error: bbox: "),
        (["--format", "xml"], "error: format: "),
        (["--route", "0,0|90,0"], "error: route: "),
        (["--config", "nowhere.json"], "error: config: "),
        (["--out", "/nowhere/at/all"], "error: out: "),
        (["--at", "2999-01-01"], "error: at: lies in the future; give a time in the past\n"),
    ],
)
@pytest.mark.usefixtures("service")
def test_a_bad_query_is_one_line_that_names_the_field_and_exit_code_2(
    router: ZenohSettings, capsys: pytest.CaptureFixture[str], words: list[str], start: str
) -> None:
    assert ask(router, *words) == 2
    err = capsys.readouterr().err
    assert err.startswith(start)
    assert err.count("\n") == 1


def test_missing_router_is_reported(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["query", "--connect", "tcp/127.0.0.1:1"]) == 1
    assert capsys.readouterr().err.startswith("error: connect: no router at tcp/127.0.0.1:1; ")


def test_an_endpoint_without_a_protocol_is_named(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["query", "--connect", "127.0.0.1:7447"]) == 2
    assert "write PROTOCOL/HOST:PORT, such as tcp/127.0.0.1:7447" in capsys.readouterr().err


def test_parameters_parted_by_an_ampersand_are_named(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["query", "--bbox", "1,2,3,4&format=json", "--connect", "tcp/127.0.0.1:1"]) == 2
    assert "separate the parameters by ';'" in capsys.readouterr().err


def test_overlapping_regions_are_refused(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    config = tmp_path / "service.json"
    config.write_text(json.dumps({"regions": ["1200/320/*", "1201/*/*", "1200/320/230"]}))
    assert main(["run", "--config", str(config), "--archive", str(tmp_path / "archive")]) == 2
    stderr = capsys.readouterr().err
    assert "error: regions: 1200/320/* and 1200/320/230 overlap; " in stderr
    assert not (tmp_path / "archive").exists()


def test_second_service_on_an_archive_exits_with_an_error(
    tmp_path: Path, router: ZenohSettings, capsys: pytest.CaptureFixture[str]
) -> None:
    with running(router, tmp_path):
        handlers = [signal.getsignal(number) for number in (signal.SIGTERM, signal.SIGINT)]
        try:
            assert main(["run", "--archive", str(tmp_path)]) == 2
        finally:
            for number, handler in zip((signal.SIGTERM, signal.SIGINT), handlers, strict=True):
                signal.signal(number, handler)
    # The first command of a machine also reports that it compiles kernels.
    assert capsys.readouterr().err.splitlines()[-1].startswith("error: archive: ")


def test_run_and_watch_as_processes_from_start_to_signal(
    router: ZenohSettings, session: zenoh.Session, tmp_path: Path
) -> None:
    config = tmp_path / "service.json"
    config.write_text(json.dumps({"zenoh": {"connect": router.connect}, "put_s": 0.1}))
    begin = partial(
        subprocess.Popen[str], stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True
    )
    run = begin([*COMMAND, "run", "--config", str(config), "--archive", str(tmp_path / "archive")])
    watch = begin([*COMMAND, "watch", "--config", str(config), "--bbox", "11,57,13,59"])
    with run, watch:
        assert run.stdout is not None
        assert watch.stdout is not None
        assert run.stdout.readline() == "ready: shard-0, 0 cells from the archive\n"
        assert watch.stdout.readline() == "watching\n"
        fleet = Fleet(session).await_services()
        fleet.settle(*(batch(f"sim-{k:03}", 1, time.time_ns() - SECOND, [0.2]) for k in range(4)))
        # The tile may be printed before or after its alert.
        awaited = {
            "alert RAISED at 57.69",
            "tile 12003202",
        }
        for line in iter(watch.stdout.readline, ""):
            slippery = line.startswith("alert") or "likely slippery" in line
            awaited -= {begin for begin in awaited if line.startswith(begin) and slippery}
            if not awaited:
                break
        assert not awaited
        for process in (run, watch):
            process.send_signal(signal.SIGTERM)
            assert process.wait(PATIENCE_S) == 0
            assert process.stderr is not None
            assert process.stderr.read() == ""
        stdout = run.stdout.read()
        assert "status: 4 observations" in stdout
    kept = pa.concat_tables(
        reading.read_tables(tmp_path / "archive", Kind.OBSERVATION, ["boot", "seq", "row"])
    )
    assert kept.num_rows == 4
    modes = {path: path.stat().st_mode for path in (tmp_path / "archive").rglob("*")}
    assert any(path.suffix == ".parquet" for path in modes)
    assert [path for path, mode in modes.items() if mode & 0o027] == [], (
        "readable by others, or written by the group"
    )


SIGNALLED = """
import os, signal
from fleet_service.cli.common import stop_on_signals
stop = stop_on_signals()
for _ in range(2):
    os.kill(os.getpid(), signal.SIGTERM)
    print(stop.is_set(), flush=True)
"""


def test_second_signal_ends_the_process_at_once() -> None:
    done = subprocess.run([sys.executable, "-c", SIGNALLED], capture_output=True, text=True)
    assert (done.stdout, done.returncode) == ("True\n", -signal.SIGTERM)


HANGS = """
import sys, threading
from fleet_service.app import service
from fleet_service.app.jobs import Job
from fleet_service.cli import main
from schemas.runtime.logs import print_line
def hangs(_):
    print_line("hangs", sys.stdout)
    threading.Event().wait()
service.archive_jobs = lambda *_: [Job("hangs", .001, hangs)]
{more}
sys.exit(main(sys.argv[1:]))
"""
BREAKS = "service.Service._shut_down = lambda self, *_: [][0]"


@pytest.mark.campaign
@pytest.mark.parametrize(("more", "code"), [("", 0), (BREAKS, 1)])
def test_exit_code_of_a_forced_end_shows_success_or_failure(
    tmp_path: Path, router: ZenohSettings, more: str, code: int
) -> None:
    config = tmp_path / "service.json"
    config.write_text(json.dumps({"zenoh": router.model_dump()}))
    words = ["run", "--config", str(config), "--archive", str(tmp_path / "archive")]
    service = Part("service", [sys.executable, "-c", HANGS.format(more=more), *words], tmp_path)
    service.start()
    try:
        service.line_with("hangs")
        assert service.stop() == code
        assert "shutdown incomplete: a session or a job did not end in time" in service.read_lines()
        assert ("IndexError: list index out of range" in service.read_lines()) == bool(more)
    finally:
        service.kill()


@pytest.mark.campaign
def test_terminated_service_releases_its_lease(
    tmp_path: Path, router: ZenohSettings, bucket: BucketServer
) -> None:
    config = tmp_path / "service.json"
    archive = {"path": str(tmp_path / "archive"), **bucket.settings}
    config.write_text(json.dumps({"zenoh": router.model_dump(), "archive": archive}))
    words = ["run", "--config", str(config)]
    service = Part("service", [sys.executable, "-c", HANGS.format(more=""), *words], tmp_path)
    service.start()
    try:
        service.line_with("hangs")
        service.line_with("ready: ")
        assert service.stop() == 0
        assert "shutdown incomplete: a session or a job did not end in time" in service.read_lines()
    finally:
        service.kill()
    (lease,) = bucket.path_of("lease").glob("*.json")
    assert json.loads(lease.read_text())["released"] is True


def test_the_service_waits_for_a_router_and_survives_its_restart(tmp_path: Path) -> None:
    router, endpoints = open_router(listen="tcp/127.0.0.1:0")
    settings = ZenohSettings(
        connect=endpoints, config={"connect/retry": {"period_init_ms": 50, "period_max_ms": 100}}
    )
    with running(settings, tmp_path) as run:
        router.close()
        router, _ = open_router(listen=endpoints[0])
        with router:
            client = open_session(settings)
            assert client is not None
            with client:
                fleet = Fleet(client)
                sent = batch("sim-001", 1, time.time_ns() - SECOND, [0.8])

                def is_acknowledged() -> bool:
                    client.put(key("sim-001"), wire.encode(sent), encoding=wire.ENCODING[sent.kind])
                    return 1 in fleet.durable["sim-001"]

                until(is_acknowledged)
            run.end()
    assert run.service.engine.state.fusion.live.visits[0] == 1
