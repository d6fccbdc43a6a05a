"""Estimation of many recorded drives in parallel, on threads of this machine or on Spark.

On one machine the drives run on threads of one process, which loads the compiled code once: kernels
and Parquet release the interpreter lock. Both engines run the same function for each drive and
write the same bytes.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor, as_completed
from functools import partial
from pathlib import Path
from typing import NamedTuple

from edge_agent.adaptation.memberships import Memberships
from edge_agent.app.estimates_file import EstimatesFile
from edge_agent.app.estimator_factory import bank_of
from edge_agent.app.output_path import prepare_path
from edge_agent.inputs.doctor.adopt import prepare_log
from edge_agent.inputs.signal_log import read_log
from schemas.errors import InputError
from schemas.runtime import spark
from schemas.runtime.durable import own_drafts, sweep_drafts, sync_directory
from schemas.vehicle import load_vehicle


class Task(NamedTuple):
    """Task of estimating one recorded drive: a signal log, the vehicle that recorded it, and the
    path for its estimates.
    """

    log: Path
    vehicle: Path
    out: Path


class Outcome(NamedTuple):
    """Result of the estimation of one drive: the number of estimated samples, or the reason of a
    failure."""

    task: Task
    samples: int
    error: InputError | None


def tasks_of(logs: Sequence[Path], vehicle: Path | None, folder: Path) -> list[Task]:
    """Return one task per log. The file of its estimates lies in `folder` and has the log's name.
    The vehicle file lies next to the log unless `vehicle` is given.

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
    """Estimate all drives, `jobs` at a time, and yield the outcomes as they become available.

    A drive that fails does not stop the others.

    Raises:
        InputError: jobs is below 1.
    """
    if jobs < 1:
        raise InputError("jobs", f"{jobs} is below 1", "give at least one job")
    with ThreadPoolExecutor(jobs) as pool:
        for future in as_completed(
            [pool.submit(estimate_drive, task, estimator, memberships) for task in tasks]
        ):
            yield future.result()


def backfill_on_spark(
    tasks: Sequence[Task], estimator: str, memberships: Memberships | None = None
) -> Iterator[Outcome]:
    """Estimate all drives on the machines of Spark, which must all see the same files. Yield the
    outcomes in the order of the tasks.

    Raises:
        InputError: Spark is not available or failed, or the folder of the estimates cannot be
            created.
    """
    folders = {prepare_path("out", task.out).parent for task in tasks}
    yield from spark.spread(
        spark.session(),
        tasks,
        partial(estimate_atomically, estimator=estimator, memberships=memberships),
    )
    for folder in folders:
        sweep_drafts(folder)


def estimate_atomically(task: Task, estimator: str, memberships: Memberships | None) -> Outcome:
    """Estimate one drive and write the estimates' file atomically, even if another process
    estimates the same drive.
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
        vehicle = load_vehicle(task.vehicle)
        log, vehicle, *_ = prepare_log(read_log(task.log), vehicle)
        bank = bank_of(estimator, [vehicle], memberships)
        with EstimatesFile(task.out) as file:
            for block in log.blocks(0):
                file.write(block.t, bank.advance(block.t, block.signals))
    except InputError as error:
        return Outcome(task, 0, error)
    return Outcome(task, len(log.t), None)
