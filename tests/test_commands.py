"""Tests of both command lines, `edge-agent` and `fleet-service`. Help, completion, Ctrl-C and exit
codes must work as documented, and no command may replace a file that it must not touch.
"""

from __future__ import annotations

import importlib
import json
import os
import pty
import re
import shlex
import shutil
import subprocess
import sys
import tomllib
from pathlib import Path
from typing import Any, Final

import pyarrow.csv as pacsv
import pyarrow.parquet as pq
import pytest

import edge_agent.cli
import fleet_service.cli
from deploy.demo.processes import DemoError, ManagedProcess
from schemas.errors import InputError
from schemas.runtime import commandline
from tests.fleet_service.archive.reference_archive import DATA
from tests.structure import ROOT

LINES: Final[dict[str, Any]] = {"edge-agent": edge_agent.cli, "fleet-service": fleet_service.cli}
EXAMPLES: Final = [(name, c.name, c.example) for name, line in LINES.items() for c in line.COMMANDS]
Capture = pytest.CaptureFixture[str]


@pytest.fixture
def archive(tmp_path: Path) -> Path:
    """Return a copy of the archive that is committed as test data."""
    return Path(shutil.copytree(DATA / "v1.0" / "archive", tmp_path / "archive"))


@pytest.mark.parametrize("name", LINES)
def test_the_version_is_that_of_the_distribution(name: str, capsys: Capture) -> None:
    with pytest.raises(SystemExit, match="0"):
        LINES[name].main(["--version"])
    assert capsys.readouterr().out == f"{name} {commandline.version()}\n"
    assert commandline.version()[0].isdigit()


@pytest.mark.parametrize("value", ["nan", "-inf", "-1", "0", "ten"])
@pytest.mark.parametrize(
    ("command", "option"),
    [
        ("run", "--duration"),
        ("run", "--rate"),
        ("fleet", "--duration"),
        ("fleet", "--rate"),
        ("simulate", "--speed"),
        ("simulate", "--duration"),
        ("simulate", "--rate"),
    ],
)
def test_an_option_above_zero_refuses_any_other_value(
    command: str, option: str, value: str, capsys: Capture
) -> None:
    with pytest.raises(SystemExit, match="2"):
        edge_agent.cli.main([command, f"{option}={value}"])
    message = f"error: argument {option}: '{value}' is not a positive number; see "
    assert capsys.readouterr().err == f"{message}edge-agent {command} --help\n"


@pytest.mark.parametrize("value", ["-1", "65536", "8080.5", "http"])
@pytest.mark.parametrize(
    "words", [("page", "--port"), ("watch", "--health-port"), ("router", "--metrics-port")]
)
def test_an_option_for_a_port_refuses_any_other_value(
    words: tuple[str, str], value: str, capsys: Capture
) -> None:
    with pytest.raises(SystemExit, match="2"):
        fleet_service.cli.main([words[0], f"{words[1]}={value}"])
    error = f"error: argument {words[1]}: '{value}' is not a port (0 to 65535); see "
    assert capsys.readouterr().err.startswith(error)


@pytest.mark.parametrize(("name", "command", "example"), EXAMPLES)
def test_the_example_of_each_help_is_a_command_that_is_understood(
    name: str, command: str, example: str
) -> None:
    words = shlex.split(example.partition(" > ")[0])
    assert words[:2] == [name, command]
    parser = commandline.parser_of(*LINES[name].LINE, command)
    assert parser.parse_args(commandline.join_negative_numbers(words[1:])).command == command


@pytest.mark.parametrize("name", LINES)
@pytest.mark.parametrize("shell", commandline.SHELLS)
def test_completion_is_a_script_of_the_shell(name: str, shell: str, capsys: Capture) -> None:
    assert LINES[name].main(["completion", shell]) == 0
    script = capsys.readouterr().out
    for option in ("--version", "--archive" if name == "fleet-service" else "--estimator"):
        assert option.lstrip("-") in script
    if shell == "bash":
        assert subprocess.run(["bash", "-n"], input=script, text=True, check=False).returncode == 0
    assert LINES[name].main(["completion", "abacus"]) == 2


@pytest.mark.parametrize(
    ("given", "understood"),
    [
        (["--bbox", "-0.5,51,0.3,52"], ["--bbox=-0.5,51,0.3,52"]),
        (["--route", "-.1,51|-.2,52", "-q"], ["--route=-.1,51|-.2,52", "-q"]),
        (["--slope", "-0.03", "log"], ["--slope=-0.03", "log"]),
        (["--out", "x", "-v"], ["--out", "x", "-v"]),
        (["--bbox=-1,2,3,4", "-1"], ["--bbox=-1,2,3,4", "-1"]),
    ],
)
def test_a_minus_sign_is_a_number_behind_an_option(given: list[str], understood: list[str]) -> None:
    assert commandline.join_negative_numbers(given) == understood


def test_bbox_with_a_negative_longitude_is_accepted(
    archive: Path, tmp_path: Path, capsys: Capture
) -> None:
    words = ["export", "observations", "--archive", str(archive), "--out", str(tmp_path / "a.csv")]
    assert fleet_service.cli.main([*words, "--bbox", "-0.5,51.2,0.3,51.7"]) == 0
    assert capsys.readouterr().out.startswith("0 rows in ")


def test_ctrl_c_is_130_and_one_word(capsys: Capture) -> None:
    def raise_interrupt() -> int:
        raise KeyboardInterrupt

    assert commandline.run_guarded(raise_interrupt) == 130
    assert capsys.readouterr().err == "interrupted\n"


@pytest.mark.parametrize(
    "command", ["compact", "retention --raw-days 31", "forget --period 2026-01", "export map"]
)
def test_a_folder_that_is_no_archive_is_left_as_it_is(
    command: str, tmp_path: Path, capsys: Capture
) -> None:
    (tmp_path / "README.md").write_text("mine")
    out = ["--out", str(tmp_path / "a.csv")] if command.startswith("export") else []
    assert fleet_service.cli.main([*command.split(), "--archive", str(tmp_path), *out]) == 2
    assert capsys.readouterr().err.startswith("error: archive: ")
    assert [(path.name, path.read_text()) for path in tmp_path.iterdir()] == [("README.md", "mine")]


def test_foreign_page_in_an_archive_is_not_replaced(archive: Path) -> None:
    (archive / "README.md").write_text("mine")
    assert fleet_service.cli.main(["compact", "--archive", str(archive)]) == 0
    assert (archive / "README.md").read_text() == "mine"


def list_files(folder: Path) -> set[Path]:
    return {path for path in folder.rglob("*") if path.is_file()}


@pytest.mark.parametrize(
    "words", [["forget", "--period", "2024-10"], ["retention", "--raw-days", "31"]]
)
def test_destructive_command_has_a_dry_run_and_asks_on_a_terminal(
    words: list[str], archive: Path, capsys: Capture
) -> None:
    command = [*words, "--archive", str(archive)]
    before = list_files(archive)
    assert fleet_service.cli.main([*command, "--dry-run"]) == 0
    assert "would be" in capsys.readouterr().out
    assert list_files(archive) == before
    output = on_terminal([sys.executable, "-m", "fleet_service.cli", *command], "n\n")
    assert "Continue? [y/N]" in output
    assert "nothing" in output
    assert list_files(archive) == before
    assert fleet_service.cli.main([*command, "--yes"]) == 0
    assert list_files(archive) != before


def on_terminal(command: list[str], answer: str) -> str:
    """Run the command on a terminal with `answer` as the typed input, and return its output."""
    controller, terminal = pty.openpty()
    with subprocess.Popen(command, stdin=terminal, stdout=terminal, stderr=terminal) as process:
        os.close(terminal)
        os.write(controller, answer.encode())
        output = b""
        try:
            while block := os.read(controller, 4096):
                output += block
        except OSError:  # the program has closed its terminal
            pass
        assert process.wait(60) == 0
    os.close(controller)
    return output.decode()


def test_forget_reports_an_unknown_vehicle(archive: Path, capsys: Capture) -> None:
    words = ["forget", "--archive", str(archive), "--period", "2024-10", "--vehicle"]
    assert fleet_service.cli.main([*words, "sim-typo"]) == 0
    assert capsys.readouterr().out == "no rows of sim-typo in 2024-10: nothing removed\n"
    assert fleet_service.cli.main([*words, "sim-003", "--json"]) == 0
    assert json.loads(capsys.readouterr().out)["rows"] > 0


def test_map_export_is_of_the_present_and_states_its_time(
    archive: Path, tmp_path: Path, capsys: Capture
) -> None:
    words = ["export", "map", "--archive", str(archive), "--out", str(tmp_path / "map.parquet")]
    assert fleet_service.cli.main([*words, "--to", "2024-10-04T23:59:50"]) == 0
    assert "the map as of 2024-10-04T23:59:50Z" in capsys.readouterr().out
    then = pq.read_table(tmp_path / "map.parquet")
    assert {f"{time:%S}" for time in then["snapshot_time"].to_pylist()} == {"50"}
    assert fleet_service.cli.main([*words, "--json"]) == 0
    document = json.loads(capsys.readouterr().out)
    assert document["as_of"] > "2026-"
    assert document["rows"] >= then.num_rows


def test_rows_in_the_log_are_compacted_and_counted(archive: Path, capsys: Capture) -> None:
    words = ["analyze", "grip", "--archive", str(archive), "--json"]
    assert fleet_service.cli.main([*words, "--as-it-lies"]) == 0
    without = capsys.readouterr()
    assert fleet_service.cli.main(words) == 0
    whole = capsys.readouterr()
    assert "compacted first: " in whole.err
    visits = [
        sum(json.loads(line)["observations"] for line in captured.out.splitlines())
        for captured in (without, whole)
    ]
    assert visits[0] < visits[1]


@pytest.mark.parametrize(
    ("words", "start"),
    [
        (
            ["grip", "--at", "2026-01-01"],
            "error: at: does not apply to grip; it applies to before-after, replay",
        ),
        (["worst", "--min-vehicles", "0"], "error: min-vehicles: 0 is below 1"),
        (
            ["grip", "--from", "2024-10-05", "--to", "2024-10-04"],
            "error: to: 2024-10-04 is not after --from",
        ),
        (["grip", "--out", "nowhere/at/all.csv"], "error: out: cannot write"),
        (
            ["weather", "--stations", "{stations}"],
            "error: stations: german.csv has an invalid value",
        ),
    ],
)
def test_an_option_that_would_be_passed_over_is_refused(
    words: list[str], start: str, archive: Path, tmp_path: Path, capsys: Capture
) -> None:
    german = "station,time,latitude,longitude,temperature\na,31.01.2026 07:00,57.7,11.9,-2\n"
    (tmp_path / "german.csv").write_text(german)
    words = [word.format(stations=tmp_path / "german.csv") for word in words]
    assert fleet_service.cli.main(["analyze", *words, "--archive", str(archive)]) == 2
    assert capsys.readouterr().err.splitlines()[-1].startswith(start)


def test_a_recording_is_never_replaced_by_its_estimates(tmp_path: Path, capsys: Capture) -> None:
    log = tmp_path / "x.parquet"
    car = tmp_path / "x.json"
    drive = ["simulate", "slalom", "--duration", "1", "--out", str(log), "--vehicle-out", str(car)]
    assert edge_agent.cli.main(drive) == 0
    before = log.read_bytes()
    for out in (log, car, tmp_path / "." / "x.parquet"):
        assert (
            edge_agent.cli.main(["replay", str(log), "--out", str(out), "--estimator", "ckf"]) == 2
        )
        assert "would overwrite" in capsys.readouterr().err
    assert log.read_bytes() == before


def test_the_ending_of_a_file_decides_its_format(tmp_path: Path, capsys: Capture) -> None:
    drive = [
        "simulate",
        "slalom",
        "--duration",
        "1",
        "--vehicle-out",
        str(tmp_path / "x.json"),
        "--out",
    ]
    for name in ("x.parquet", "x.csv"):
        assert edge_agent.cli.main([*drive, str(tmp_path / name)]) == 0
    log = tmp_path / "x.parquet"
    assert pacsv.read_csv(tmp_path / "x.csv").num_rows == pq.read_table(log).num_rows
    assert (
        edge_agent.cli.main(
            ["replay", str(log), "--out", str(tmp_path / "e.csv"), "--estimator", "ckf"]
        )
        == 0
    )
    assert {"mu", "mu_lower"} <= set(pacsv.read_csv(tmp_path / "e.csv").column_names)
    assert (
        edge_agent.cli.main(
            ["replay", str(log), "--out", str(tmp_path / "e.xlsx"), "--estimator", "ckf"]
        )
        == 2
    )
    assert "error: out: e.xlsx has no known ending" in capsys.readouterr().err
    assert not (tmp_path / "e.xlsx").exists()


def test_output_path_is_checked_before_any_computation(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="out: .* is a folder"):
        commandline.check_out_file("out", tmp_path)
    with pytest.raises(InputError, match="out: a.xls has no known ending; use one of .csv"):
        commandline.check_ending("out", Path("a.xls"), (".csv",))
    assert (
        commandline.check_ending("out", Path("a.geo.parquet"), (".parquet", ".geo.parquet"))
        == ".geo.parquet"
    )


@pytest.mark.parametrize("out", ["/proc/none/e.parquet", "file/e.parquet"])
def test_unwritable_estimates_are_refused_in_one_line(
    out: str, tmp_path: Path, capsys: Capture
) -> None:
    log = tmp_path / "x.parquet"
    drive = [
        "simulate",
        "slalom",
        "--duration",
        "1",
        "--out",
        str(log),
        "--vehicle-out",
        str(tmp_path / "x.json"),
    ]
    assert edge_agent.cli.main(drive) == 0
    (tmp_path / "file").touch()
    capsys.readouterr()
    assert (
        edge_agent.cli.main(
            ["replay", str(log), "--out", str(tmp_path / out), "--estimator", "ckf"]
        )
        == 2
    )
    assert capsys.readouterr().err.splitlines()[-1].startswith("error: out: ")


def test_every_command_module_has_a_description() -> None:
    for line in LINES.values():
        for command in line.COMMANDS:
            text = importlib.import_module(command.module).__doc__
            assert text is not None
            assert text.startswith("`")


def test_missing_package_is_one_line_with_its_extra(capsys: pytest.CaptureFixture[str]) -> None:
    def import_missing() -> int:
        raise ModuleNotFoundError("No module named 'scipy.stats'", name="scipy.stats")

    assert commandline.run_guarded(import_missing) == commandline.BAD_INPUT
    stderr = capsys.readouterr().err
    assert stderr.startswith("error: packages: scipy is not installed; pip install ")
    assert "analytics" in stderr

    def import_unknown() -> int:
        raise ModuleNotFoundError("No module named 'typo'", name="typo")

    with pytest.raises(ModuleNotFoundError):
        commandline.run_guarded(import_unknown)


@pytest.mark.parametrize(
    "modules",
    [
        "deploy.demo.story, deploy.demo.processes, fleet_service.page.server",
        "edge_agent.cli.run, edge_agent.cli.fleet, edge_agent.cli.replay, edge_agent.cli.check",
        "fleet_service.cli.run, fleet_service.cli.watch, fleet_service.cli.query",
    ],
)
def test_demo_and_plain_commands_load_without_optional_packages(modules: str) -> None:
    """The commands of the demo and those without extras must load without SciPy, matplotlib and
    Ibis. The extras `demo` and `page` do not install these.
    """
    hidden = "import sys; sys.modules.update(dict.fromkeys(('scipy', 'matplotlib', 'ibis')))"
    command = [sys.executable, "-c", f"{hidden}; import {modules}"]
    subprocess.run(command, check=True, capture_output=True)


def test_demo_extra_brings_what_its_processes_need(tmp_path: Path) -> None:
    """The extra `demo` must install the packages for the demo's metrics and page. If a process of
    the demo cannot start, the demo must print an error with the reason that the process printed.
    """
    extras = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
    names = {re.split(r"[<>=]", one)[0] for one in extras["optional-dependencies"]["demo"]}
    assert {"prometheus-client", "starlette", "uvicorn"} <= names
    failing = [sys.executable, "-c", "print('error: metrics_port: is missing')"]
    part = ManagedProcess("service", failing, tmp_path)
    with pytest.raises(DemoError, match="ends with: error: metrics_port: is missing"):
        part.line_with("ready")


def test_no_command_reports_the_threads_of_a_library() -> None:
    asked = "import logging, edge_agent.cli as c; c.main(['simulate', '--list']); "
    for library in ("numexpr", "matplotlib.font_manager"):
        asked += f"assert not logging.getLogger('{library}').isEnabledFor(logging.INFO); "
    asked += "assert logging.getLogger('schemas.runtime.link_watch').isEnabledFor(logging.INFO)"
    subprocess.run([sys.executable, "-c", asked], check=True, capture_output=True)
