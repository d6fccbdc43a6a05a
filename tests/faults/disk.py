"""Campaign on a full disk. A service and an agent's outbox (store of unacknowledged messages) run
on a small file system that becomes full several times under load.

If this process may mount, the file system is a real tmpfs of some megabytes. Otherwise the system
calls that create or rename files fail with ENOSPC. The campaign checks:

- While the disk is full, the service acknowledges no row that is not stored.
- When the disk has space again, all batches are acknowledged, and all background jobs continue.
- Retention (deletion of old days) works on a full disk. Before it deletes a day, it must write the
  day's roll-up (hourly statistics). The service reserves disk space for this purpose.
"""

from __future__ import annotations

import errno
import os
import subprocess
import threading
import time
from collections import Counter
from collections.abc import Callable, Iterator
from contextlib import closing, contextmanager, suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Final
from unittest.mock import patch

from edge_agent.publish.batching import Draft
from edge_agent.publish.outbox import Outbox
from fleet_service.app.clock import SteadyClock, TimeNow
from fleet_service.app.engine import Engine
from fleet_service.app.jobs import BackgroundJobs, archive_jobs
from fleet_service.archive.format import reading
from fleet_service.archive.maintenance import disk_reserve
from fleet_service.ingest.inbox import Message
from schemas import wire
from schemas.config import LEAST_RAW_DAYS, ServiceConfig
from schemas.runtime.figures import Figure
from schemas.thresholds import NS
from schemas.wire import Kind
from tests.faults.bars import make_figure
from tests.faults.frame import Site
from tests.faults.kill import begin_with_old_rows, old_days
from tests.fleet_service.examples import batch, key
from tests.outboxes import read_batches

SIZE_MB: Final = 24
BALLAST: Final = "ballast"  # file that fills the disk
VEHICLES: Final = 5
CONFIG: Final = ServiceConfig(
    compact_s=0.3, checkpoint_s=0.3, snapshot_s=0.3, raw_days=LEAST_RAW_DAYS
)
RESERVE_MB: Final = 2  # [MB] the same share of this small disk as 64 MB of a real one
JOBS: Final = ("compaction", "checkpoint")
STUCK_S: Final = 60.0


@contextmanager
def small_disk(folder: Path) -> Iterator[bool]:
    """Mount a small file system at a folder during the `with` block. Yield False if this process
    may not mount.
    """
    folder.mkdir()
    command = ["mount", "-t", "tmpfs", "-o", f"size={SIZE_MB}m", "tmpfs", str(folder)]
    try:
        mounted = subprocess.run(command, capture_output=True, check=False).returncode == 0
    except OSError:
        mounted = False
    try:
        yield mounted
    finally:
        if mounted:
            subprocess.run(["umount", "--lazy", str(folder)], check=True)


@contextmanager
def fill_disk(folder: Path, mounted: bool) -> Iterator[None]:
    """Fill the disk for the duration of the `with` block. If no small disk is mounted, let all
    system calls that write fail as on a full disk.
    """
    if mounted:
        _fill_up(folder)
        try:
            yield
        finally:
            (folder / BALLAST).unlink()
        return
    with _refuse_writes("open", "fsync", "rename", "mkdir"):
        yield


def _fill_up(folder: Path) -> None:
    """Fill the mounted file system with a file. Repeat this in the room that background jobs make
    meanwhile by removing files.
    """
    while os.statvfs(folder).f_bavail:
        with suppress(OSError), (folder / BALLAST).open("ab", buffering=0) as file:
            while True:
                file.write(bytes(1 << 12))


@contextmanager
def _refuse_writes(*names: str) -> Iterator[None]:
    """Let the functions of the module `os` that `names` lists fail as on a full disk, for the
    duration of the `with` block. They work again afterwards.
    """

    def refuse(*_: object, **__: object) -> object:
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    was: dict[str, Callable[..., object]] = {name: getattr(os, name) for name in names}
    for name in names:
        setattr(os, name, refuse)
    try:
        yield
    finally:
        for name, function in was.items():
            setattr(os, name, function)


@dataclass
class _Count:
    """Counts of a run: sent batches of each vehicle, acknowledged batches, times that more batches
    were acknowledged than stored, times that the service did not continue, and times that the disk
    was full.
    """

    seq: int = 0
    acknowledged: int = 0
    false_acks: int = 0
    stuck: int = 0
    times_full: int = 0


def _fill_once(engine: Engine, disk: Path, count: _Count, *, mounted: bool) -> None:
    """Let the vehicles drive, fill the disk, make room again, and add the results to `count`."""
    count.acknowledged += _drive(engine, count.seq, 3)
    count.seq += 3
    failures = engine.counts.failures["segment"]
    with fill_disk(disk, mounted):
        for _ in range(6):
            count.acknowledged += _drive(engine, count.seq, 1)
            count.seq += 1
            if mounted:  # a job may have removed files
                _fill_up(disk)
        count.times_full += engine.counts.failures["segment"] > failures
        count.false_acks += count.acknowledged > _count_rows(disk / "archive")
    count.acknowledged += _until_settled(engine)
    count.stuck += engine.settlement.unsettled > 0


def run(site: Site) -> list[Figure]:
    """Fill the disk several times, at different stages of the background jobs. Return figures, such
    as rows acknowledged without being stored, and parts that do not continue when the disk has
    space again.
    """
    disk = site.folder / "disk"
    count = _Count()
    with small_disk(disk) as mounted:
        root = disk / "archive"
        with closing(Engine(CONFIG, root)) as engine:
            jobs = archive_jobs(engine, CONFIG, root, SteadyClock().moment)
            with BackgroundJobs(jobs, engine.counts, lambda _: None):
                for _ in range(site.choose_amount(10, 3)):
                    _fill_once(engine, disk, count, mounted=mounted)
                count.acknowledged += _until_done(engine)
            runs = Counter(engine.counts.runs)
            count.false_acks += count.acknowledged > _count_rows(root)
            room = _room_made(engine, disk) if mounted else 0
        count.stuck += not _outbox_recovers(disk, mounted)
    site.say(
        f"{'mounted' if mounted else 'injected'}; {count.acknowledged} acknowledged, {dict(runs)}"
    )
    lacks_acks = count.acknowledged != VEHICLES * count.seq
    return [
        make_figure("faults.disk.false_acks", count.false_acks),
        make_figure("faults.disk.stuck", count.stuck + lacks_acks),
        make_figure("faults.disk.times_full", count.times_full),
        make_figure("faults.disk.jobs_run", min(runs[job] for job in JOBS)),
        make_figure("faults.disk.room_made", room)
        if mounted
        else Figure("faults.disk.room_made", 0, "days; nothing was mounted"),
        Figure("faults.disk.mounted", int(mounted), "a real file system"),
    ]


def _drive(engine: Engine, since: int, steps: int) -> int:
    """Let each simulated vehicle send `steps` batches to the service, with the sequence numbers
    after `since`. Return the number of acknowledged batches.
    """
    got = 0
    for seq in range(since + 1, since + steps + 1):
        now = time.time_ns()
        for vehicle in range(VEHICLES):
            one = batch(f"sim-{vehicle:03}", seq, now - NS, [0.8])
            engine.intake.ingest(
                [Message(Kind.OBSERVATION, key(one.vehicle), wire.encode(one), "")], now
            )
        got += _count_acked(engine.settlement.flush())
        threading.Event().wait(0.2)  # time for the background jobs
    return got


def _count_acked(acks: list[tuple[str, bytes]]) -> int:
    return sum(
        last - first + 1
        for _, payload in acks
        for stream in wire.decode_ack(payload)[1]
        for first, last in stream.durable
    )


def _until_settled(engine: Engine) -> int:
    got = 0
    deadline = time.monotonic() + STUCK_S
    while engine.settlement.unsettled and time.monotonic() < deadline:
        got += _count_acked(engine.settlement.flush())
        threading.Event().wait(0.05)
    return got


def _until_done(engine: Engine) -> int:
    """Wait until each background job has succeeded once after space on the disk has become free.
    Return the number of rows that were acknowledged meanwhile.
    """
    got = 0
    deadline = time.monotonic() + STUCK_S
    while not all(engine.counts.runs[job] for job in JOBS) and time.monotonic() < deadline:
        got += _count_acked(engine.settlement.flush())
        threading.Event().wait(0.05)
    return got


def _count_rows(root: Path) -> int:
    return sum(table.num_rows for table in reading.read_tables(root, Kind.OBSERVATION, ["seq"]))


def _room_made(engine: Engine, folder: Path) -> int:
    """Fill the disk, run the job that deletes old days (retention), and return the number of days
    that it deleted.
    """
    root = folder / "archive"
    begin_with_old_rows(root)
    with patch.multiple(disk_reserve, SIZE=RESERVE_MB << 20, _LEAST_FREE=2 * RESERVE_MB << 20):
        disk_reserve.allocate(root)
        assert (root / disk_reserve.NAME).exists()
        jobs = archive_jobs(engine, CONFIG, root, lambda: TimeNow(time.time_ns()))
        retention = next(job for job in jobs if job.name == "retention")
        before = len(old_days(root))
        with fill_disk(folder, mounted=True):
            retention.work(threading.Event())
            return before - len(old_days(root))


def _outbox_recovers(folder: Path, mounted: bool) -> bool:
    """Return True if an outbox (store of unacknowledged messages) refuses batches on a full disk,
    keeps those that it accepted before, and continues when there is space again.
    """
    outbox = Outbox(folder / "spool.sqlite", boot=5)
    draft = Draft("car-a", Kind.OBSERVATION, 77, 1, lambda seq, first: bytes(60_000))
    stored = len(outbox.store([draft], 0.0))
    refused = False
    if mounted:
        with fill_disk(folder, mounted):
            try:
                stored += len(outbox.store([draft] * 50, 0.0))
            except Exception:  # noqa: BLE001 sqlite raises errors of its own
                refused = True
    stored += len(outbox.store([draft], 0.0))
    whole = len(read_batches(outbox)) == stored and (refused or not mounted)
    outbox.close()
    return whole
