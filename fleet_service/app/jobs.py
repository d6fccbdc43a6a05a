"""What a running service does for its archive now and then, at low priority beside the worker."""

from __future__ import annotations

import os
import subprocess
import sys
import threading
import time
from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from datetime import UTC, datetime
from pathlib import Path
from typing import Final, NamedTuple

from fleet_service.app.clock import Moment
from fleet_service.app.engine import Engine
from fleet_service.archive import segments, snapshots
from fleet_service.archive.load import count_set_aside
from fleet_service.archive.retention import retire
from fleet_service.replay import checkpoints
from schemas.config import ServiceConfig
from schemas.errors import InputError
from schemas.runtime.process import trim_memory
from schemas.thresholds import NS
from schemas.wire import Kind

ROUND_ROWS: Final = 250_000  # of one round of compaction: a second of work, 150 MB
LOOK_S: Final = 0.1  # between two looks whether a compaction has ended, or shall
INVENTORY_S: Final = 300.0  # thousands of files are looked through in a tenth of a second
DAY_S: Final = 86_400.0
SOON_S: Final = 60.0  # after the start; the first turn of a job does not wait for its whole interval
_NICE: Final = 10  # the worker goes first


class Job(NamedTuple):
    """Something to do every so often: returns a line for the operator, or None; 0 seconds: never."""

    name: str
    every_s: float
    work: Callable[[threading.Event], str | None]


def archive_jobs(engine: Engine, config: ServiceConfig, root: Path, moment: Callable[[], Moment]) -> list[Job]:
    """What keeps an archive in order, as the settings say; `moment` is the service's time."""

    def compaction(stop: threading.Event) -> str | None:
        if not config.put_to and not any(segments.paths(root, kind) for kind in Kind):
            return None
        words = ["compact", "--archive", str(root), "--round-rows", str(ROUND_ROWS)]
        output = _beside([*words, *(["--to", config.put_to] if config.put_to else [])], stop)
        return output and f"compacted: {output}"

    def snapshot(_: threading.Event) -> str | None:
        now = moment().now
        table = engine.whole_map(now)
        if table.num_rows:
            snapshots.write(root, table, now)
        return None

    def checkpoint(stop: threading.Event) -> str | None:
        taken = engine.checkpoint(stop)
        if taken is not None:
            checkpoints.save(root, taken)
        return None

    def retention(_: threading.Event) -> str | None:
        at = moment()
        if not at.sure:
            return "retention waits: no report has confirmed the clock yet"
        done = retire(root, config.raw_days, datetime.fromtimestamp(at.now // NS, UTC).date())
        return f"retired: {done.days} days" if done.days else None

    def inventory(_: threading.Event) -> str | None:
        engine.counts["files_set_aside"] = count_set_aside(root)
        return None

    return [
        Job("compaction", config.compact_s, compaction),
        Job("checkpoint", config.checkpoint_s, checkpoint),
        Job("snapshot", config.snapshot_s, snapshot),
        Job("retention", DAY_S if config.raw_days else 0.0, retention),
        Job("inventory", INVENTORY_S, inventory),
    ]


def _beside(words: Sequence[str], stop: threading.Event) -> str | None:
    """What a command of `fleet-service` said, run as a process of its own; None if it was stopped.

    Its memory goes with it, and the worker shares no interpreter with it. A compaction may die at any instant.

    Raises:
        InputError: it failed.
    """
    command = [sys.executable, "-m", "fleet_service.cli", *words]
    with subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True) as child:
        while child.poll() is None and not stop.wait(LOOK_S):
            pass
        if child.poll() is None:
            child.terminate()
            return None
        output, errors = child.communicate()
    if child.returncode:
        raise InputError(words[0], errors.strip() or f"ended with {child.returncode}", "it is tried again")
    return output.strip()


@contextmanager
def upkeep(jobs: Sequence[Job], counts: Counter[str], log_line: Callable[[str], None]) -> Iterator[None]:
    """Do the jobs in turn while the block runs; what fails is counted as `NAME_failures` and tried again next time."""
    stop = threading.Event()
    thread = threading.Thread(target=_keep, args=([job for job in jobs if job.every_s], counts, log_line, stop))
    thread.start()
    try:
        yield
    finally:
        stop.set()
        thread.join()


def _keep(jobs: Sequence[Job], counts: Counter[str], log_line: Callable[[str], None], stop: threading.Event) -> None:
    os.setpriority(os.PRIO_PROCESS, threading.get_native_id(), _NICE)  # of this thread alone, on Linux
    began = time.monotonic()
    due = {job: began + min(job.every_s, SOON_S) for job in jobs}
    while due and not stop.wait(max(min(due.values()) - time.monotonic(), 0.0)):
        job = min(due, key=lambda job: due[job])
        due[job] = time.monotonic() + job.every_s
        try:
            line = job.work(stop)
            counts[f"{job.name}_runs"] += 1
        except (OSError, InputError) as error:
            counts[f"{job.name}_failures"] += 1
            line = f"{job.name} failed: {error}"
        trim_memory()
        if line:
            log_line(line)
