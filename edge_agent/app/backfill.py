"""Estimation of many recorded drives in parallel, in processes of this machine or on Spark.

On one machine the main process loads the compiled code, and the worker processes forked from it
share this memory. Local processes and Spark run the same function for each drive and write the same
bytes.
"""

from __future__ import annotations

import signal
import sys
import warnings
from collections.abc import Iterator, Sequence
from concurrent.futures import Future, as_completed
from contextlib import suppress
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple

import numpy as np
import pyarrow as pa

from edge_agent.adaptation.memberships import Memberships
from edge_agent.app.estimates_file import EstimatesFile
from edge_agent.app.estimator_factory import bank_of
from edge_agent.app.output_path import prepare_path
from edge_agent.app.plausible import Plausibility
from edge_agent.estimators import ESTIMATORS
from edge_agent.inputs.doctor.adopt import prepare_log
from edge_agent.inputs.signal_log import read_log
from schemas.errors import InputError
from schemas.runtime import spark
from schemas.runtime.durable import own_drafts, sweep_drafts, sync_directory
from schemas.runtime.process import end_with_parent
from schemas.signals import CHANNELS
from schemas.vehicle import load_vehicle

if TYPE_CHECKING:
    from concurrent.futures import ProcessPoolExecutor


class Task(NamedTuple):
    """Task of estimating one recorded drive: a signal log, the vehicle that recorded it, and the
    path for its estimates.
    """

    log: Path
    vehicle: Path
    out: Path


class Outcome(NamedTuple):
    """Result of the estimation of one drive: the number of estimated samples, or the reason of a
    failure. `faults` are those that the signal doctor found in the log, and `implausible` is the
    summary of implausible estimates.
    """

    task: Task
    samples: int
    error: InputError | None
    faults: tuple[str, ...] = ()
    implausible: str | None = None


def tasks_of(logs: Sequence[Path], vehicle: Path | None, folder: Path) -> list[Task]:
    """Return one task per signal log. Each task writes its estimates to a file in `folder` with the
    log's name. It reads the vehicle file `vehicle`, or, if that is None, the vehicle file next to
    the log.

    Raises:
        InputError: two logs have the same name, or estimates would replace a log.
    """
    tasks = [
        Task(log, vehicle or vehicle_file_of(log), folder / f"{log.stem}.parquet") for log in logs
    ]
    seen: dict[Path, Path] = {}
    for task in tasks:
        if (other := seen.setdefault(task.out, task.log)) is not task.log:
            raise InputError(
                "log", f"{other} and {task.log} would both write {task.out}", "rename one of them"
            )
        if task.out.resolve() == task.log.resolve():
            raise InputError(
                "out", f"estimates would replace the log {task.log}", "choose another folder"
            )
    return tasks


def vehicle_file_of(log: Path) -> Path:
    """Return the path of the vehicle file that belongs to a signal log: the same name with the
    suffix .json.
    """
    return log.with_suffix(".json")


def estimate_drives(
    tasks: Sequence[Task], estimator: str, jobs: int, memberships: Memberships | None = None
) -> Iterator[Outcome]:
    """Estimate all recorded drives in `jobs` parallel processes. Yield each drive's outcome as soon
    as it is available.

    A drive that fails does not stop the others. After Ctrl-C no further drive begins.

    Raises:
        InputError: the operating system ended one of the processes.
    """
    count = min(jobs, len(tasks))
    if count < 2:
        for task in tasks:
            yield estimate_drive(task, estimator, memberships)
        return
    from concurrent.futures.process import BrokenProcessPool

    _load_kernels(estimator, memberships)
    pool = _fork_processes(count)
    try:
        for future in as_completed(_submit_drives(pool, tasks, estimator, memberships)):
            yield future.result()
    except BrokenProcessPool as error:
        problem = "the system ended a process that estimated a drive, perhaps for lack of memory"
        raise InputError("jobs", problem, "give fewer jobs") from error
    finally:
        pool.shutdown(cancel_futures=True)


def _load_kernels(estimator: str, memberships: Memberships | None) -> None:
    """Let an estimator process one sample that has no readings. This compiles or loads the
    estimator's kernels (compiled functions), so that processes forked afterwards share them. Do
    nothing for an estimator of another installed package, because each process loads such an
    estimator itself. Ignore errors, because the later estimation of each drive reports them.
    """
    if estimator not in ESTIMATORS:
        return
    with suppress(InputError):
        bank = bank_of(estimator, [load_vehicle("class:compact")], memberships)
        bank.advance(np.zeros((1, 1)), np.full((1, 1, len(CHANNELS)), np.nan))


def _fork_processes(count: int) -> ProcessPoolExecutor:
    """Return a pool for `count` worker processes; no worker is started yet. On Linux, the workers
    are forked from this process. Elsewhere they start without a fork, because the system libraries
    do not support it.
    """
    from concurrent.futures import ProcessPoolExecutor
    from multiprocessing import get_context

    context = get_context("fork" if sys.platform == "linux" else "spawn")
    return ProcessPoolExecutor(count, context, _prepare_process)


def _submit_drives(
    pool: ProcessPoolExecutor,
    tasks: Sequence[Task],
    estimator: str,
    memberships: Memberships | None,
) -> list[Future[Outcome]]:
    """Submit all drives to a pool of processes, and return one future (later result) per drive.
    Submitting starts the processes. SIGINT (Ctrl-C) is blocked meanwhile, so that no process
    receives it before it has installed its own handler.

    Python's warning that the forked process has several threads is suppressed, because the
    libraries with threads (OpenBLAS, Arrow) handle a fork correctly.
    """
    before = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", DeprecationWarning)
            return [
                pool.submit(_estimate_in_process, task, estimator, memberships) for task in tasks
            ]
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, before)


class _PoolProcess:
    """State of one worker process: `estimates` is True while it estimates a drive, and
    `interrupted` is True after Ctrl-C.
    """

    estimates = False
    interrupted = False


def _prepare_process() -> None:
    """Prepare a new worker process. It ends when its parent process ends. SIGTERM ends it even if
    the parent handles SIGTERM, and Ctrl-C stops the estimation of its current drive. Arrow uses one
    thread in it.
    """
    end_with_parent()
    signal.signal(signal.SIGTERM, signal.SIG_DFL)
    pa.set_cpu_count(1)
    signal.signal(signal.SIGINT, _interrupt_drive)
    signal.pthread_sigmask(signal.SIG_UNBLOCK, {signal.SIGINT})


def _interrupt_drive(*_: object) -> None:
    """Handle Ctrl-C in a worker process: stop the estimation of the current drive, if there is one,
    by a KeyboardInterrupt. The parent process reports the interruption to the user.
    """
    _PoolProcess.interrupted = True
    if _PoolProcess.estimates:
        raise KeyboardInterrupt


def _estimate_in_process(task: Task, estimator: str, memberships: Memberships | None) -> Outcome:
    """Estimate one drive in a worker process and return its outcome. A worker that was interrupted
    by Ctrl-C estimates no further drive.

    Raises:
        KeyboardInterrupt: Ctrl-C was pressed; no file of estimates is written for this drive.
    """
    _PoolProcess.estimates = True
    try:
        if _PoolProcess.interrupted:
            raise KeyboardInterrupt
        return estimate_drive(task, estimator, memberships)
    finally:
        _PoolProcess.estimates = False


def backfill_on_spark(
    tasks: Sequence[Task], estimator: str, memberships: Memberships | None = None
) -> Iterator[Outcome]:
    """Estimate all drives on the machines of a Spark cluster, which must all have access to the
    same files. Yield the outcomes in the order of the tasks.

    Raises:
        InputError: Spark is not available or failed, or the folder of the estimates cannot be
            created.
    """
    folders = {prepare_path("out", task.out).parent for task in tasks}
    yield from spark.run_tasks(
        spark.open_session(),
        tasks,
        partial(estimate_atomically, estimator=estimator, memberships=memberships),
    )
    for folder in folders:
        sweep_drafts(folder)


def estimate_atomically(task: Task, estimator: str, memberships: Memberships | None) -> Outcome:
    """Estimate one drive. Write its estimates to a temporary file, and rename this file when it is
    complete. Another process that estimates the same drive has its own temporary file.
    """
    folder = task.out.parent
    with own_drafts(folder) as drafts:
        outcome = estimate_drive(task._replace(out=drafts / task.out.name), estimator, memberships)
        if outcome.error is None:
            (drafts / task.out.name).rename(task.out)
            sync_directory(folder)
    return outcome._replace(task=task)


def estimate_drive(task: Task, estimator: str, memberships: Memberships | None = None) -> Outcome:
    """Estimate one drive and write its estimates to `task.out`; return the outcome (number of
    samples, or the error).
    """
    try:
        recorded = read_log(task.log)  # before the vehicle file, whose place depends on it
        log, vehicle, diagnosis, _ = prepare_log(recorded, load_vehicle(task.vehicle))
        bank = bank_of(estimator, [vehicle], memberships)
        plausibility = Plausibility(vehicle.wheel_radius, bool(diagnosis.findings))
        with EstimatesFile(task.out) as file:
            for block in log.blocks(0):
                estimates = bank.advance(block.t, block.signals)
                plausibility.add(block.t, block.signals, estimates)
                file.write(block.t, estimates)
    except InputError as error:
        return Outcome(task, 0, error)
    faults = tuple(map(str, diagnosis.findings))
    implausible = plausibility.summary_line() if plausibility.problems() else None
    return Outcome(task, len(log.t), None, faults, implausible)
