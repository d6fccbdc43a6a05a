"""Tests of the background jobs of a running service: they lose no row, and a job that fails is
counted, reported and repeated without stopping other jobs.
"""

from __future__ import annotations

import shutil
import threading
from collections.abc import Callable
from contextlib import closing
from pathlib import Path
from types import SimpleNamespace

import pytest
import zenoh

from fleet_service.app import tasks
from fleet_service.app.clock import SteadyClock
from fleet_service.app.engine import Engine
from fleet_service.app.jobs import BackgroundJobs, Job, archive_jobs
from fleet_service.archive.format import layout
from fleet_service.archive.maintenance import disk_reserve
from fleet_service.archive.maintenance.compaction import hold_compaction_lock
from fleet_service.cli import main
from fleet_service.counts import ServiceCounts
from fleet_service.ingest.inbox import Message
from schemas import wire
from schemas.config import ServiceConfig, ZenohSettings
from schemas.errors import InputError
from schemas.wire import Kind
from tests.fleet_service.app.test_service import Fleet, now
from tests.fleet_service.archive.rows import identities
from tests.fleet_service.conftest import running
from tests.fleet_service.examples import batch, key
from tests.waiting import until


@pytest.mark.campaign
def test_a_running_service_compacts_and_keeps_every_row_once(
    router: ZenohSettings, session: zenoh.Session, tmp_path: Path
) -> None:
    moment = now()
    with running(router, tmp_path, compact_s=0.05) as run:
        fleet = Fleet(session).await_services()
        for seq in range(1, 11):
            fleet.settle(*(batch(f"sim-{k:03}", seq, moment, [0.8]) for k in range(3)))
        until(lambda: not list((tmp_path / "inbox").glob("*.parquet")))
        until(lambda: any(line.startswith("compacted: ") for line in run.lines))
    assert (
        len(set(identities(tmp_path, Kind.OBSERVATION)))
        == len(identities(tmp_path, Kind.OBSERVATION))
        == 30
    )
    with running(router, tmp_path) as again:
        assert again.service.engine.state.fusion.live.visits[0] == 30
        # The command runs while the service is running.
        assert main(["compact", "--archive", str(tmp_path)]) == 0


def test_failed_job_is_counted_logged_and_repeated(tmp_path: Path) -> None:
    turns: list[int] = []

    def work(stop: threading.Event) -> str | None:
        turns.append(1)
        if len(turns) == 1:
            raise OSError("no disk")
        return "well" if len(turns) == 2 else None

    counts = ServiceCounts()
    lines: list[str] = []
    with BackgroundJobs([Job("mending", 0.001, work)], counts, lines.append):
        until(lambda: len(turns) > 2)
    assert counts.failures["mending"] == 1
    assert lines == ["mending failed: no disk", "well"]


def test_an_unforeseen_job_failure_ends_no_other_job_and_is_reported(tmp_path: Path) -> None:
    turns: list[int] = []

    def work(stop: threading.Event) -> str | None:
        raise ValueError("Invalid isoformat string: '2026-01-31 (copy)'")

    counts = ServiceCounts()
    jobs = [Job("broken", 0.001, work), Job("other", 0.001, lambda _: turns.append(1))]
    with BackgroundJobs(jobs, counts, lambda _: None) as background_jobs:
        until(lambda: len(turns) > 5 and counts.failures["broken"] > 5)
        assert background_jobs.health_problems()[0].startswith("broken failed ")
        assert not background_jobs.has_ended


@pytest.mark.filterwarnings("ignore::pytest.PytestUnhandledThreadExceptionWarning")
def test_dead_background_thread_is_detected_and_reported() -> None:
    def work(stop: threading.Event) -> str | None:
        raise KeyboardInterrupt

    with BackgroundJobs(
        [Job("fatal", 0.001, work)], ServiceCounts(), lambda _: None
    ) as background_jobs:
        until(lambda: background_jobs.has_ended)
        assert (
            background_jobs.health_problems()[-1]
            == "the thread of background jobs has ended; restart the service"
        )
    assert not background_jobs.has_ended, "it was stopped"


def test_a_copy_of_a_days_folder_is_none_of_the_archive(tmp_path: Path) -> None:
    for name in ("date=2026-01-31 (copy)", "date=2026-01-31", "date=2026-99-99"):
        (tmp_path / "observations" / name).mkdir(parents=True)
    assert [path.name for path in layout.day_folders(tmp_path, "observations")] == [
        "date=2026-01-31"
    ]


def test_a_checkpoint_without_good_segments_does_not_block_other_jobs(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(tasks, "MOST_S", 0.05)
    with (
        closing(Engine(ServiceConfig(), tmp_path)) as engine,
        pytest.raises(OSError, match="no segment"),
    ):
        engine.save_checkpoint(threading.Event())  # no worker runs here, so nothing is written


def test_on_a_full_disk_the_jobs_that_make_room_have_the_reserve(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(disk_reserve, "SIZE", 1 << 16)
    disk_reserve.allocate(tmp_path)
    assert (tmp_path / "reserve").stat().st_size == 1 << 16
    assert not disk_reserve.release(tmp_path), "there is room"
    monkeypatch.setattr(shutil, "disk_usage", lambda _: SimpleNamespace(free=0))
    assert disk_reserve.release(tmp_path)
    assert not (tmp_path / "reserve").exists()
    disk_reserve.allocate(tmp_path)
    assert not (tmp_path / "reserve").exists()


def test_a_job_of_no_interval_is_never_done(tmp_path: Path) -> None:
    done: Callable[[threading.Event], str | None] = lambda _: "done"  # noqa: E731
    lines: list[str] = []
    with BackgroundJobs([Job("never", 0.0, done)], ServiceCounts(), lines.append):
        pass
    assert not lines


def test_compact_reports_that_another_process_compacts(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "inbox").mkdir()
    with hold_compaction_lock(tmp_path):
        assert main(["compact", "--archive", str(tmp_path)]) == 2
    assert capsys.readouterr().err.startswith("error: archive: ")


def test_rounds_of_no_rows_are_refused(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (tmp_path / "inbox").mkdir()
    assert main(["compact", "--archive", str(tmp_path), "--round-rows", "0"]) == 2
    assert capsys.readouterr().err.startswith("error: round-rows: ")


def test_failing_compaction_is_reported_and_a_running_one_is_stopped(tmp_path: Path) -> None:
    engine = Engine(ServiceConfig(), tmp_path)
    with closing(engine):
        engine.intake.ingest(
            [
                Message(
                    Kind.OBSERVATION,
                    key("sim-001"),
                    wire.encode(batch("sim-001", 1, now(), [0.8])),
                    "",
                )
            ],
            now(),
        )
        engine.settlement.flush()
        compaction, *_ = archive_jobs(engine, ServiceConfig(), tmp_path, SteadyClock().moment)
        with hold_compaction_lock(tmp_path), pytest.raises(InputError, match="being compacted"):
            compaction.work(threading.Event())
        stopped = threading.Event()
        stopped.set()
        assert compaction.work(stopped) is None
        assert list((tmp_path / "inbox").glob("*.parquet"))
        assert (compaction.work(threading.Event()) or "").startswith(
            "compacted: 1 rows of 1 segments"
        )
        assert compaction.work(threading.Event()) is None
