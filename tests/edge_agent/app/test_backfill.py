"""Tests of the replay of many recorded drives. Each drive's estimates must be written to a file of
their own, several drives must run at a time, and a bad drive must not stop the others.
"""

from __future__ import annotations

import multiprocessing
import os
import signal
import subprocess
import sys
import threading
from contextlib import suppress
from pathlib import Path

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest

from edge_agent.app.backfill import Outcome, Task, estimate_atomically, estimate_drives, tasks_of
from edge_agent.cli import main
from schemas.errors import InputError
from tests.waiting import until

DRIVES = 3


@pytest.fixture(scope="module")
def drives(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return a folder of recorded drives, each with its vehicle file."""
    folder = tmp_path_factory.mktemp("drives")
    for seed in range(DRIVES):
        files = [
            "--out",
            str(folder / f"d{seed}.parquet"),
            "--vehicle-out",
            str(folder / f"d{seed}.json"),
        ]
        assert main(["simulate", "slalom", "--duration", "1", "--seed", str(seed), *files]) == 0
    return folder


def logs(folder: Path) -> list[Path]:
    return sorted(folder.glob("*.parquet"))


def test_number_of_jobs_does_not_change_the_estimates(drives: Path, tmp_path: Path) -> None:
    paths = [str(path) for path in logs(drives)]
    for jobs in ("1", "2"):
        out = ["--out", str(tmp_path / jobs), "--jobs", jobs]
        assert main(["replay", *paths, "--estimator", "ckf", *out]) == 0
    one = tmp_path / "one.parquet"
    assert main(["replay", paths[0], "--estimator", "ckf", "--out", str(one)]) == 0
    assert pq.read_table(tmp_path / "1" / "d0.parquet").equals(pq.read_table(one))
    for path in logs(tmp_path / "1"):
        assert pq.read_table(path).equals(pq.read_table(tmp_path / "2" / path.name))
    assert len(logs(tmp_path / "2")) == DRIVES


def piped_tasks(drives: Path, folder: Path) -> list[Task]:
    """Return one estimation task per drive. Each task's vehicle file is a named pipe, so that a
    started task waits until the test closes this pipe.
    """
    tasks = [
        task._replace(vehicle=folder / task.vehicle.name)
        for task in tasks_of(logs(drives), None, folder)
    ]
    for task in tasks:
        os.mkfifo(task.vehicle)
    return tasks


@pytest.mark.parametrize("jobs", [1, 2])
def test_so_many_drives_are_under_way_at_once(drives: Path, tmp_path: Path, jobs: int) -> None:
    """Exactly `jobs` drives must be in progress at once. The vehicle files are named pipes, so each
    started drive waits until its pipe is closed, and the test counts the waiting drives.
    """
    tasks = piped_tasks(drives, tmp_path)
    writers: dict[Path, int] = {}
    under_way: list[int] = []

    def is_waiting(pipe: Path) -> bool:
        if pipe not in writers:
            try:
                writers[pipe] = os.open(pipe, os.O_WRONLY | os.O_NONBLOCK)
            except OSError:  # no process reads the pipe yet
                return False
        return True

    def watch() -> None:
        until(lambda: all(is_waiting(task.vehicle) for task in tasks[:jobs]))
        under_way.append(sum(is_waiting(task.vehicle) for task in tasks))
        for task in tasks:  # an empty pipe is not a valid vehicle file, so the drive ends
            until(lambda task=task: is_waiting(task.vehicle))  # type: ignore[misc]
            os.close(writers[task.vehicle])

    watcher = threading.Thread(target=watch)
    watcher.start()
    outcomes = list(estimate_drives(tasks, "ckf", jobs))
    watcher.join()
    assert under_way == [jobs]
    assert all(outcome.error is not None for outcome in outcomes)


def test_a_process_that_the_system_ends_is_an_error_and_no_hang(
    drives: Path, tmp_path: Path
) -> None:
    tasks = piped_tasks(drives, tmp_path)

    def end_one() -> None:
        with tasks[0].vehicle.open("wb"):  # `open` waits until a process reads the pipe
            multiprocessing.active_children()[0].kill()

    watcher = threading.Thread(target=end_one)
    watcher.start()
    with pytest.raises(InputError, match="jobs: the system ended a process"):
        list(estimate_drives(tasks, "ckf", 2))
    watcher.join()
    assert not multiprocessing.active_children()
    assert not logs(tmp_path)


def has_ended(process: subprocess.Popen[str], pipe: Path) -> bool:
    """Return True if a process has ended.

    The function also opens the named pipe `pipe` for writing and closes it. A process that waits
    for data from this pipe then reads the end of the file, and continues.
    """
    with suppress(OSError):  # no process waits
        os.close(os.open(pipe, os.O_WRONLY | os.O_NONBLOCK))
    return process.poll() is not None


@pytest.mark.parametrize("jobs", ["1", "2"])
def test_ctrl_c_ends_a_replay_of_many_logs_with_one_word(
    drives: Path, tmp_path: Path, jobs: str
) -> None:
    (pipe, *_) = (task.vehicle for task in piped_tasks(drives, tmp_path))
    words = ["replay", *map(str, logs(drives)), "--vehicle", str(pipe), "--estimator", "ckf"]
    # A background job of a shell ignores Ctrl-C, and its child processes inherit this.
    before = signal.signal(signal.SIGINT, signal.default_int_handler)
    process = subprocess.Popen(
        [sys.executable, "-m", "edge_agent.cli", *words, "--out", str(tmp_path), "--jobs", jobs],
        stderr=subprocess.PIPE,
        text=True,
        start_new_session=True,  # a process group of its own, like a command in a shell
    )
    signal.signal(signal.SIGINT, before)
    with pipe.open("wb"):  # `open` waits until a drive has begun
        os.killpg(process.pid, signal.SIGINT)
    # Python handles a signal late if it comes just before a blocking call, so no call may block.
    until(lambda: has_ended(process, pipe))
    _, reported = process.communicate()
    assert process.returncode == 130, reported
    assert reported.splitlines()[-1] == "interrupted"
    assert "Traceback" not in reported
    assert not logs(tmp_path)


def test_missing_log_is_reported_before_its_vehicle_file(
    drives: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    none = tmp_path / "none.parquet"
    words = ["replay", str(none), str(drives / "d0.parquet"), "--estimator", "ckf"]
    assert main([*words, "--out", str(tmp_path / "out")]) == 2
    assert f"error: {none}: log: {none} does not exist" in capsys.readouterr().err


def test_bad_log_is_reported_and_the_others_are_estimated(
    drives: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    bad = tmp_path / "bad.parquet"
    bad.write_bytes(b"not a log")
    vehicle = ["--vehicle", str(drives / "d0.json"), "--estimator", "ckf"]
    assert (
        main(
            [
                "replay",
                str(bad),
                str(drives / "d0.parquet"),
                *vehicle,
                "--out",
                str(tmp_path / "out"),
            ]
        )
        == 2
    )
    reported = capsys.readouterr().err
    assert f"error: {bad}: log:" in reported
    assert "2 of 2 logs, 100 samples" in reported
    assert [path.name for path in logs(tmp_path / "out")] == ["d0.parquet"]


def test_logs_of_one_name_and_estimates_over_their_log_are_refused(
    drives: Path, tmp_path: Path
) -> None:
    log = drives / "d0.parquet"
    with pytest.raises(InputError, match="would both write"):
        tasks_of([log, tmp_path / "d0.parquet"], None, tmp_path)
    with pytest.raises(InputError, match="would replace the log"):
        tasks_of([log], None, drives)
    assert tasks_of([log], None, tmp_path) == [
        Task(log, drives / "d0.json", tmp_path / "d0.parquet")
    ]


def test_no_job_is_refused_for_one_log_too(
    drives: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    command = ["replay", str(drives / "d0.parquet"), "--out", str(tmp_path / "d0.parquet")]
    assert main([*command, "--jobs", "0"]) == 2
    assert capsys.readouterr().err.startswith("error: jobs: 0 is below 1; ")


def test_faulty_signals_and_implausible_estimates_are_reported(
    drives: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """The first log has a time with one decimal, the second an acceleration in another unit."""
    table = pq.read_table(drives / "d0.parquet")
    coarse = tmp_path / "coarse.parquet"
    strong = tmp_path / "strong.parquet"
    for path, column, values in (
        (coarse, "t", np.floor(table["t"].to_numpy() * 10.0) / 10.0),
        (strong, "ay", table["ay"].to_numpy() + 1000.0),
    ):
        place = table.column_names.index(column)
        pq.write_table(table.set_column(place, column, pa.array(values)), path)
    words = [
        "--vehicle",
        str(drives / "d0.json"),
        "--estimator",
        "ckf",
        "--out",
        str(tmp_path / "o"),
    ]
    assert main(["replay", str(coarse), str(strong), *words]) == 3
    reported = capsys.readouterr().err
    assert f"warning: {coarse}: t repeats: most samples repeat a time" in reported
    assert f"warning: {strong}: 100 samples" in reported
    assert "NOT PLAUSIBLE: signals have faults, the upper bound lies below the grip" in reported


def test_log_with_a_fault_has_implausible_estimates_unless_trusted(
    drives: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    table = pq.read_table(drives / "d0.parquet")
    coarse = pa.array(np.floor(table["t"].to_numpy() * 10.0) / 10.0)
    log = tmp_path / "coarse.parquet"
    pq.write_table(table.set_column(table.column_names.index("t"), "t", coarse), log)
    words = ["replay", str(log), "--vehicle", str(drives / "d0.json"), "--estimator", "ckf"]
    assert main([*words, "--out", str(tmp_path / "o.csv")]) == 3
    assert "NOT PLAUSIBLE: signals have faults; run edge-agent check" in capsys.readouterr().err
    assert main([*words, "--trust", "--out", str(tmp_path / "o.csv")]) == 0
    assert capsys.readouterr().err.endswith("; plausible\n")


def test_several_logs_are_not_published_or_compared(
    drives: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    words = ["replay", *map(str, logs(drives)), "--out", str(tmp_path)]
    assert main([*words, "--publish"]) == 2
    assert "error: publish: 3 logs into a folder" in capsys.readouterr().err
    assert main([*words, "--compare", "ckf"]) == 2
    assert "error: compare: needs one log" in capsys.readouterr().err


def test_spark_engine_needs_several_logs_and_refuses_jobs(
    drives: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    paths = [str(path) for path in logs(drives)]
    out = ["--out", str(tmp_path / "out")]
    assert main(["replay", *paths, *out, "--engine", "abacus"]) == 2
    assert "error: engine: 'abacus' is unknown" in capsys.readouterr().err
    assert main(["replay", *paths, *out, "--engine", "spark", "--jobs", "2"]) == 2
    assert "error: jobs: 2 has no effect on Spark" in capsys.readouterr().err
    assert main(["replay", paths[0], *out, "--engine", "spark"]) == 2
    assert "error: engine: Spark needs several logs" in capsys.readouterr().err


def test_repeated_estimation_of_a_drive_writes_one_file_and_no_draft(
    drives: Path, tmp_path: Path
) -> None:
    (task, *_) = tasks_of(logs(drives), None, tmp_path)
    first = estimate_atomically(task, "ckf", None)
    content = task.out.read_bytes()
    assert estimate_atomically(task, "ckf", None) == first == Outcome(task, 100, None)
    assert [path.name for path in tmp_path.iterdir()] == [task.out.name]
    assert task.out.read_bytes() == content
    assert (
        estimate_atomically(task._replace(vehicle=tmp_path / "none.json"), "ckf", None).error
        is not None
    )
