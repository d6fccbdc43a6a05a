"""Background jobs that maintain the archive of a running service, at lower priority than its worker
(the thread that processes messages).
"""

from __future__ import annotations

import logging
import os
import threading
import time
from collections.abc import Callable, Sequence
from contextlib import suppress
from datetime import UTC, datetime
from pathlib import Path
from typing import Final, NamedTuple

from fleet_service.app import erasing, subprocess_job
from fleet_service.app.clock import TimeNow
from fleet_service.app.engine import Engine
from fleet_service.archive.format import layout, segments, snapshots
from fleet_service.archive.format.load import count_set_aside
from fleet_service.archive.maintenance import disk_reserve
from fleet_service.archive.maintenance.retention import retire_rows
from fleet_service.counts import ServiceCounts
from fleet_service.ingest import weather
from schemas.config import ServiceConfig
from schemas.errors import InputError
from schemas.runtime.process import trim_memory
from schemas.thresholds import NS
from schemas.wire import Kind

log = logging.getLogger(__name__)
ROUND_ROWS: Final = 250_000  # rows per round of compaction: one second of work and 150 MB
# Largest number of segments that wait for compaction. A query to the archive reads each of them in
# a millisecond.
SEGMENTS_MOST: Final = 10_000
# [s] Period in which the archive's files are counted. Scanning thousands of files takes .1 s.
INVENTORY_S: Final = 300.0
# [s] Period in which results of compaction, checkpoints and snapshots are copied to the bucket.
FOLLOW_S: Final = 30.0
DAY_S: Final = 86_400.0
ASKED_S: Final = 2.0  # [s] period of the checks for a requested erasure or hand-over
# [s] Longest wait for the first run of a job, and for a repetition after a failure.
SOON_S: Final = 60.0
# [s] A job that runs for longer counts as hanging. Compaction of a day's backlog takes minutes.
HANGS_S: Final = 1800.0
Work = Callable[[threading.Event], str | None]
_NICE: Final = 10  # scheduling priority of the jobs' thread: lower than that of the worker


class Job(NamedTuple):
    """Background job that is repeated every `every_s` seconds; 0 means never. The function `work`
    does the job once and returns a line for the operator, or None.
    """

    name: str
    every_s: float
    work: Work


def archive_jobs(
    engine: Engine, config: ServiceConfig, root: Path, moment: Callable[[], TimeNow]
) -> list[Job]:
    """Return the jobs that maintain an archive, according to the settings. `moment` is a function
    that returns the service's time.
    """
    work = ArchiveWork(engine, config, root, moment)
    early_s = SOON_S if config.compact_s else 0.0
    retention_s = DAY_S if config.raw_days else 0.0
    follow_s = 0.0 if engine.copy is None else FOLLOW_S
    asked_s = 0.0 if engine.holding.lease is None else ASKED_S
    return [
        Job("compaction", config.compact_s, with_disk_space(root, work.compact_segments)),
        Job("early_compaction", early_s, with_disk_space(root, work.compact_early)),
        Job("checkpoint", config.checkpoint_s, work.save_checkpoint),
        Job("snapshot", config.snapshot_s, work.save_snapshot),
        Job("retention", retention_s, with_disk_space(root, work.remove_old_rows)),
        Job("inventory", INVENTORY_S, work.count_files),
        Job("old_cells", DAY_S, work.drop_old_cells),
        Job("following", follow_s, work.copy_files),
        Job("handing_over", asked_s, work.hand_over),
        Job("erasure", ASKED_S, work.erase_requested),
    ]


def with_disk_space(root: Path, work: Work) -> Work:
    """Return a function that runs the background job `work`. If the disk is full, it releases the
    reserved disk space of the archive in `root` and runs `work` again.
    """

    def run_job(stop: threading.Event) -> str | None:
        try:
            return work(stop)
        except (OSError, InputError):
            if not disk_reserve.release(root):
                raise
            return work(stop)

    return run_job


class ArchiveWork:
    """Work of the background jobs. Each public method does a job once and returns a line for the
    operator, or None. Its argument is an event that ends the work early.

    Args:
        engine: service without network.
        config: settings.
        root: folder of the archive.
        moment: function that returns the service's time.
    """

    def __init__(
        self, engine: Engine, config: ServiceConfig, root: Path, moment: Callable[[], TimeNow]
    ) -> None:
        self._engine = engine
        self._config = config
        self._root = root
        self._moment = moment

    def compact_segments(self, stop: threading.Event) -> str | None:
        """Move the rows of all segments (files of new rows) into sorted files."""
        copy = self._engine.copy
        # If compaction ran now, the segments that are not yet in the bucket could never be copied.
        # A full disk is no reason to wait, because compaction makes room.
        if copy is not None and copy.backoff.trouble is not None:
            return "compaction waits for the archive's copy"
        disk_reserve.allocate(self._root)
        weather.join_daily_files(self._root)
        put_to = self._config.put_to
        if not put_to and not self._count_segments():
            return None
        words = ["compact", "--archive", str(self._root), "--round-rows", str(ROUND_ROWS)]
        words += ["--put-to", put_to] if put_to else []
        output = subprocess_job.run_module("compact", "fleet_service.cli", words, stop)
        return output and f"compacted: {output}"

    def compact_early(self, stop: threading.Event) -> str | None:
        """Compact the archive (move new rows into sorted files) if too many segments wait."""
        return self.compact_segments(stop) if self._count_segments() > SEGMENTS_MOST else None

    def _count_segments(self) -> int:
        return sum(len(segments.list_segments(self._root, kind)) for kind in Kind)

    def save_snapshot(self, _: threading.Event) -> str | None:
        """Write the present map to the archive, unless it is empty."""
        now = self._moment().now
        table = self._engine.queries.whole_map(now)
        if table.num_rows:
            snapshots.write_snapshot(self._root, table, now)
        return None

    def save_checkpoint(self, stop: threading.Event) -> str | None:
        """Save a checkpoint (state of the service, for a fast restart)."""
        self._engine.save_checkpoint(stop)
        return None

    def remove_old_rows(self, _: threading.Event) -> str | None:
        """Remove rows and weather that are older than the setting `raw_days`."""
        at = self._moment()
        if not at.sure:
            return "retention waits: no report has confirmed the clock yet"
        raw_days = self._config.raw_days
        done = retire_rows(self._root, raw_days, datetime.fromtimestamp(at.now // NS, UTC).date())
        weather.retire_files(self._root, at.now // layout.DAY_NS - raw_days - 1)
        return f"retired: {done.days} days" if done.days else None

    def drop_old_cells(self, stop: threading.Event) -> str | None:
        """Drop cells from memory that were not visited for a week."""
        engine = self._engine
        dropped = engine.settlement.run_between_segments(engine.drop_old, stop)
        return f"dropped: {dropped} cells without a visit for a week" if dropped else None

    def count_files(self, _: threading.Event) -> str | None:
        """Count the damaged files that were set aside."""
        self._engine.counts.files_set_aside = count_set_aside(self._root)
        return None

    def copy_files(self, _: threading.Event) -> str | None:
        """Upload the files that no acknowledgement depends on to the archive's copy."""
        if self._engine.copy is not None:
            self._engine.copy.sync()
        return None

    def hand_over(self, stop: threading.Event) -> str | None:
        """Prepare the hand-over of the archive to another service, if one was requested."""
        holding = self._engine.holding
        if not holding.to:
            return None
        try:
            self.save_checkpoint(stop)
            self.copy_files(stop)
        except BaseException:
            holding.to = ""  # the hand-over failed; the service keeps its archive
            raise
        holding.leaves = True
        return f"handing over: to {holding.to}"

    def erase_requested(self, stop: threading.Event) -> str | None:
        """Erase the data for which an erasure was requested."""
        return erasing.handle_requests(self._engine, self._config, self._root, stop)


class BackgroundJobs:
    """Thread that runs the background jobs.

    Attributes:
        failed: for each job whose last run failed, the number of its consecutive failures.
    """

    def __init__(
        self, jobs: Sequence[Job], counts: ServiceCounts, log_line: Callable[[str], None]
    ) -> None:
        self._jobs = [job for job in jobs if job.every_s]
        self._counts = counts
        self._log_line = log_line
        self.failed: dict[str, int] = {}
        self._stop = threading.Event()
        self._busy: tuple[str, float] | None = None
        self._thread = threading.Thread(target=self._run_due_jobs, name="jobs")

    def health_problems(self) -> list[str]:
        """Return one message per background job (such as compaction) that has failed or does not
        end.
        """
        found = [
            f"{name} failed {times} times in a row" for name, times in list(self.failed.items())
        ]
        busy = self._busy
        if busy is not None and time.monotonic() - busy[1] > HANGS_S:
            found.append(f"{busy[0]} has not ended for {time.monotonic() - busy[1]:.0f} s")
        if self.has_ended:
            found.append("the thread of background jobs has ended; restart the service")
        return found

    @property
    def has_ended(self) -> bool:
        """Return True if the thread has ended although it was not told to stop."""
        return (
            self._thread.ident is not None
            and not self._thread.is_alive()
            and not self._stop.is_set()
        )

    def __enter__(self) -> BackgroundJobs:
        self._thread.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._stop.set()
        self._thread.join()

    def _run_due_jobs(self) -> None:
        # Setting a priority is not permitted everywhere; then the jobs run with the normal one.
        with suppress(OSError):
            # On Linux this changes the priority of this thread only.
            os.setpriority(os.PRIO_PROCESS, threading.get_native_id(), _NICE)
        began = time.monotonic()
        due = {job: began + min(job.every_s, SOON_S) for job in self._jobs}
        while due and not self._stop.wait(max(min(due.values()) - time.monotonic(), 0.0)):
            job = min(due, key=lambda job: due[job])
            again_s = job.every_s if self._run_job(job) else min(job.every_s, SOON_S)
            due[job] = time.monotonic() + again_s

    def _run_job(self, job: Job) -> bool:
        """Run a background job (such as compaction) once; return True on success. A failure does
        not affect the other jobs.
        """
        self._busy = (job.name, time.monotonic())
        try:
            line = job.work(self._stop)
            self._counts.runs[job.name] += 1
            self.failed.pop(job.name, None)
            has_succeeded = True
        except Exception as error:
            self._counts.failures[job.name] += 1
            self.failed[job.name] = self.failed.get(job.name, 0) + 1
            line = f"{job.name} failed: {error}"
            has_succeeded = False
            if not isinstance(error, (OSError, InputError)):
                log.exception("%s failed", job.name)
        self._busy = None
        trim_memory()
        if line:
            self._log_line(line)
        return has_succeeded
