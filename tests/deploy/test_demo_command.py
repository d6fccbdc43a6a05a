"""Tests of the commands `gripmap demo` and `gripmap router`."""

from __future__ import annotations

import os
import signal
import socket
import subprocess
import sys
from contextlib import suppress
from pathlib import Path
from typing import IO

import pytest

from deploy import cli
from deploy.demo import processes
from tests.waiting import PATIENCE_S, until


@pytest.mark.parametrize(
    ("option", "value"), [("--page-port", "99999999"), ("--page-port", "-1"), ("--duration", "nan")]
)
def test_a_number_out_of_range_is_refused_before_anything_starts(
    option: str, value: str, capsys: pytest.CaptureFixture[str]
) -> None:
    with pytest.raises(SystemExit, match="2"):
        cli.main(["demo", option, value])
    assert capsys.readouterr().err.startswith(f"error: argument {option}: '{value}' is not a p")


@pytest.fixture
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """Return the current folder of a demo that must not start a process."""

    def refuse_start(*_: object) -> None:
        raise AssertionError("a process was started")

    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(processes, "ManagedProcess", refuse_start)
    return tmp_path


@pytest.mark.parametrize(
    ("option", "value"),
    [
        ("--vehicles", "0"),
        ("--vehicles", "-1"),
        ("--vehicles", "1000"),
        ("--seed", "-1"),
        ("--warned", "1.5"),
        ("--warned", "nan"),
        ("--duration", "inf"),
        ("--screenshot", "none/page.png"),
        ("--screenshot", "page.docx"),
    ],
)
def test_wrong_option_is_named_before_a_process_starts(
    option: str,
    value: str,
    folder: Path,
    capsys: pytest.CaptureFixture[str],
) -> None:
    assert cli.main(["demo", option, value, "--page-port", "0"]) == 2
    _assert_one_error(capsys, option.removeprefix("--"))
    assert not list(folder.iterdir())


@pytest.mark.usefixtures("folder")
def test_port_in_use_is_named_before_a_process_starts(capsys: pytest.CaptureFixture[str]) -> None:
    with socket.create_server(("127.0.0.1", 0)) as other:
        assert cli.main(["demo", "--page-port", str(other.getsockname()[1])]) == 2
    _assert_one_error(capsys, "page-port")


@pytest.mark.usefixtures("folder")
def test_missing_chromium_is_named_before_a_process_starts(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr("shutil.which", lambda _: None)
    assert cli.main(["demo", "--page-port", "0", "--screenshot", "page.png"]) == 2
    _assert_one_error(capsys, "screenshot")


def test_demo_names_the_folder_that_it_cannot_make(
    folder: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (folder / ".demo").write_text("a file, and no folder")
    assert cli.main(["demo", "--page-port", "0"]) == 2
    _assert_one_error(capsys, "demo")


def test_signal_ends_all_processes_of_the_demo(tmp_path: Path) -> None:
    words = ["--vehicles", "1", "--warned", "0", "--page-port", "0"]
    demo = subprocess.Popen(
        [sys.executable, "-m", "deploy.demo", *words],
        cwd=tmp_path,
        stdout=subprocess.DEVNULL,
        stderr=subprocess.DEVNULL,
    )
    try:
        until((tmp_path / ".demo" / "fleet.log").exists)
        assert len(_processes_in(tmp_path)) > 1
        demo.terminate()
        assert demo.wait(PATIENCE_S) == 130
        assert not _processes_in(tmp_path)
    finally:
        for number in _processes_in(tmp_path):
            os.kill(number, signal.SIGKILL)
        demo.wait()


def test_signal_during_the_start_of_a_process_leaves_none_behind(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    started: list[subprocess.Popen[bytes]] = []
    usual = subprocess.Popen

    def start_interrupted(
        words: list[str], *, stdout: IO[str], stderr: int
    ) -> subprocess.Popen[bytes]:
        started.append(usual(words, stdout=stdout, stderr=stderr))
        signal.raise_signal(signal.SIGINT)
        return started[0]

    monkeypatch.setattr(subprocess, "Popen", start_interrupted)
    with pytest.raises(KeyboardInterrupt):
        processes.ManagedProcess("sleep", ["sleep", "100"], tmp_path)
    assert started[0].poll() == -signal.SIGTERM


def _processes_in(folder: Path) -> list[int]:
    """Return the numbers of the processes whose current folder is `folder`."""
    found = []
    for entry in Path("/proc").glob("[0-9]*"):
        with suppress(OSError):
            if (entry / "cwd").readlink() == folder:
                found.append(int(entry.name))
    return found


@pytest.mark.parametrize("file", ["none.json5", "folder", "empty"])
def test_router_names_a_wrong_file_without_build_paths(
    file: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    (tmp_path / "folder").mkdir()
    (tmp_path / "empty").touch()
    assert cli.main(["router", "--config", file]) == 2
    (line,) = capsys.readouterr().err.splitlines()
    assert line.startswith(f"error: config: cannot use {file} (")
    assert "/" not in line


def _assert_one_error(capsys: pytest.CaptureFixture[str], field: str) -> None:
    (line,) = capsys.readouterr().err.splitlines()
    assert line.startswith(f"error: {field}: ")
    assert "; " in line
