"""Tests that an acknowledged report is stored on disk and in the bucket (object store). The report
must survive three faults: the disk is lost, the bucket does not answer, or the service ends after
the first of the two writes.
"""

from __future__ import annotations

import errno
import json
import subprocess
import sys
import threading
import time
import urllib.error
import urllib.request
from collections.abc import Iterator
from contextlib import closing, contextmanager, suppress
from pathlib import Path

import pyarrow as pa
import pytest
import zenoh

from fleet_service.app.clock import SteadyClock
from fleet_service.app.engine import Engine
from fleet_service.app.jobs import Job, archive_jobs
from fleet_service.archive.format import reading, segments
from fleet_service.archive.identity.pseudonyms import Pseudonyms
from fleet_service.cli import main
from fleet_service.ingest.inbox import Message
from fleet_service.replication.bucket import CopyError
from fleet_service.replication.replica import OWNER, BucketReplica
from schemas import wire
from schemas.config import ServiceConfig, ZenohSettings
from schemas.wire import Batch, Kind
from tests.buckets import SECRET, BucketServer, list_copied_files
from tests.fleet_service.app.test_erasing import MONTH, pseudonyms_of
from tests.fleet_service.app.test_kill import identities, list_archived
from tests.fleet_service.app.test_service import Fleet
from tests.fleet_service.checkpoint_writer import save_checkpoint
from tests.fleet_service.examples import SECOND, batch, key
from tests.waiting import until

PATIENCE_S = 120.0  # time for a start on a busy machine
VEHICLES = 4
BATCHES = 12


def settings(bucket: BucketServer) -> ServiceConfig:
    return ServiceConfig.model_validate({"archive": bucket.settings})


def reports(mu: float, first: int, last: int) -> list[Batch]:
    now = time.time_ns() - 2 * SECOND
    return [
        batch(f"sim-{v:03}", seq, now, [mu] * 3)
        for seq in range(first, last + 1)
        for v in range(VEHICLES)
    ]


def take(engine: Engine, sent: list[Batch]) -> None:
    engine.intake.ingest(
        [Message(s.kind, key(s.vehicle), wire.encode(s), wire.ENCODING[s.kind]) for s in sent],
        time.time_ns(),
    )


def read_image(engine: Engine) -> dict[str, pa.Table]:
    """Return the engine's state that a service restores after a restart: map, trust in vehicles,
    known batches and alerts. The engine is a service without network.
    """
    return dict(engine.state.image(engine.settlement.newest_segment, []).tables)


@pytest.mark.parametrize("with_checkpoint", [False, True])
def test_a_service_starts_on_an_empty_disk_with_all_that_it_knew(
    bucket: BucketServer, tmp_path: Path, with_checkpoint: bool
) -> None:
    root = tmp_path / "archive"
    new = tmp_path / "new"
    config = settings(bucket)
    first = reports(0.15, 1, 4)
    second = reports(0.15, 5, 9)
    with closing(Engine(config, root)) as engine:
        take(engine, first)
        assert len(engine.settlement.flush()) == VEHICLES
        if with_checkpoint:
            save_checkpoint(engine)
            assert engine.copy is not None
            engine.copy.sync()
        take(engine, second)
        engine.settlement.flush()
        assert engine.alerts.count > 0
        rows = sum(table.num_rows for table in reading.read_tables(root, Kind.OBSERVATION, ["row"]))
    without = ServiceConfig()
    with closing(Engine(without, root)) as engine:
        expected = read_image(engine)
    with closing(Engine(config, new)) as engine:
        assert list_copied_files(new).keys() == list_copied_files(root).keys()
        missing = rows - sum(
            table.num_rows for table in reading.read_tables(new, Kind.OBSERVATION, ["row"])
        )
        # This is the figure `cluster.empty_disk.rows_missing`.
        assert (rows, missing) == (3 * len(first + second), 0)
        assert engine.alerts.count > 0
        found = read_image(engine)
        assert found.keys() == expected.keys()
        assert [name for name in expected if not found[name].equals(expected[name])] == []
        take(engine, first + second)
        assert engine.counts.duplicates == len(first + second)
        # The repeated batches are acknowledged again, but not written again.
        assert len(engine.settlement.flush()) == VEHICLES
        assert len(segments.list_segments(new, Kind.OBSERVATION)) == len(
            segments.list_segments(root, Kind.OBSERVATION)
        )


def fill_disk(*_: object) -> None:
    raise OSError(errno.ENOSPC, "No space left on device")


@contextmanager
def compacted_engine(
    bucket: BucketServer, root: Path
) -> Iterator[tuple[Engine, BucketReplica, Job]]:
    """Yield an engine (service without network), its bucket replica, and its compaction job."""
    config = settings(bucket)
    with closing(Engine(config, root)) as engine:
        assert engine.copy is not None
        compaction, *_ = archive_jobs(engine, config, root, SteadyClock().moment)
        yield engine, engine.copy, compaction


def test_compaction_waits_for_the_bucket_and_not_for_a_full_disk(
    bucket: BucketServer, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    with compacted_engine(bucket, tmp_path) as (engine, copy, compaction):
        take(engine, reports(0.8, 1, 1))
        engine.settlement.flush()
        with monkeypatch.context() as full:
            full.setattr(segments.Writer, "write", fill_disk)
            take(engine, reports(0.8, 2, 2))
            engine.settlement.flush()
            assert engine.settlement.failing
            assert (compaction.work(threading.Event()) or "").startswith("compacted: ")
        assert len(engine.settlement.flush()) == VEHICLES
        with suppress(CopyError), copy.backoff.try_upload():
            raise CopyError("no answer")
        assert (compaction.work(threading.Event()) or "").startswith("compaction waits")
        tables = list(reading.read_tables(tmp_path, Kind.OBSERVATION, ["row"]))
        assert sum(table.num_rows for table in tables) == 2 * 3 * VEHICLES


def test_segments_are_uploaded_after_an_outage_although_the_disk_is_full(
    bucket: BucketServer, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    with compacted_engine(bucket, tmp_path) as (engine, copy, compaction):
        bucket.stop()
        take(engine, reports(0.8, 1, 1))
        engine.settlement.flush()
        assert copy.backoff.trouble is not None
        bucket.start()
        with monkeypatch.context() as full:
            full.setattr(segments.Writer, "write", fill_disk)
            take(engine, reports(0.8, 2, 2))

            def is_uploaded() -> bool:
                engine.settlement.flush()
                assert engine.settlement.failing
                return copy.backoff.trouble is None

            until(is_uploaded)
            assert (compaction.work(threading.Event()) or "").startswith("compacted: ")
        assert len(engine.settlement.flush()) == VEHICLES


def test_a_forgotten_month_stays_forgotten_where_only_the_bucket_is_left(
    bucket: BucketServer, tmp_path: Path
) -> None:
    root = tmp_path / "archive"
    config = settings(bucket)
    sent = reports(0.15, 1, 4)
    with closing(Engine(config, root)) as engine:
        take(engine, sent)
        engine.settlement.flush()
    file = tmp_path / "service.json"
    file.write_text(json.dumps({"archive": {"path": str(root), **bucket.settings}}))
    assert (
        main(["forget", "--archive", str(root), "--period", MONTH, "--yes", "--config", str(file)])
        == 0
    )
    with closing(Engine(config, tmp_path / "new")) as engine:
        take(engine, sent)
        assert engine.counts.refused["erased"] == len(sent)
        assert engine.state.fusion.live.visits[: engine.state.fusion.size].sum() == 3 * len(sent), (
            "the rows stay, nobody's"
        )


def test_engine_acknowledges_nothing_while_the_bucket_is_unreachable(
    bucket: BucketServer, tmp_path: Path
) -> None:
    sent = reports(0.7, 1, 2)
    with closing(Engine(settings(bucket), tmp_path / "archive")) as engine:
        bucket.stop()
        take(engine, sent)
        assert engine.settlement.flush() == []
        assert (
            bool(engine.settlement.failing),
            engine.counts.failures["copy"],
            engine.counts.failures["segment"],
        ) == (
            True,
            1,
            0,
        )
        take(engine, sent)  # repeated batches are recognised, but not yet acknowledged
        assert engine.settlement.flush() == []
        assert engine.state.fusion.size > 0  # the map is updated all the same
        bucket.start()
        acks: list[tuple[str, bytes]] = []

        def is_acknowledged() -> bool:
            acks.extend(engine.settlement.flush())
            return bool(acks)

        until(is_acknowledged)
        assert sorted(vehicle for vehicle, _ in acks) == sorted({one.vehicle for one in sent})
        assert engine.copy is not None
        assert engine.copy.backoff.away_s == 0


@contextmanager
def service(
    router: ZenohSettings, folder: Path, bucket: BucketServer
) -> Iterator[tuple[subprocess.Popen[bytes], str]]:
    """Yield a ready service process that copies its archive to a bucket (object store), and the
    address of its health page. End the process after the `with` block.
    """
    config = folder / "service.json"
    archive = {"path": str(folder / "archive"), **bucket.settings}
    document = {
        "zenoh": {"connect": router.connect},
        "segment_s": 0.05,
        "archive": archive,
        "metrics_port": 0,
    }
    config.write_text(json.dumps(document))
    words = [sys.executable, "-m", "fleet_service.cli", "run", "--config", str(config)]
    stdout = folder / "stdout"
    with stdout.open("w") as out:
        process = subprocess.Popen(words, stdout=out)
    try:
        until(
            lambda: stdout.read_text().startswith("ready: ") and "\n" in stdout.read_text(),
            PATIENCE_S,
        )
        yield process, stdout.read_text().splitlines()[0].split()[-1]
    finally:
        process.kill()
        process.wait()


def health(address: str) -> str:
    try:
        with urllib.request.urlopen(f"{address}/healthz", timeout=PATIENCE_S) as reply:
            return str(reply.read().decode())
    except urllib.error.HTTPError as error:
        return error.read().decode()


def drive(fleet: Fleet, sent: list[Batch]) -> bool:
    """Send those batches of the list `sent` again that the service has not acknowledged yet, as a
    vehicle's outbox (store of unacknowledged messages) does. Return True if all are acknowledged.
    """
    for one in fleet.list_unsettled(sent)[:20]:
        fleet.publish(one)
    return not fleet.list_unsettled(sent)


@pytest.mark.parametrize("kind", ["stopped", "frozen"])
@pytest.mark.campaign
def test_bucket_outage_loses_and_doubles_no_row(
    router: ZenohSettings, session: zenoh.Session, bucket: BucketServer, tmp_path: Path, kind: str
) -> None:
    root = tmp_path / "archive"
    fleet = Fleet(session)
    before = reports(0.8, 1, BATCHES)
    during = reports(0.6, BATCHES + 1, 2 * BATCHES)
    with service(router, tmp_path, bucket) as (process, address):
        until(lambda: drive(fleet, before), PATIENCE_S)
        assert "does not accept segments" not in health(address)
        bucket.take_away(kind)
        until(
            lambda: not drive(fleet, during) and "does not accept segments" in health(address),
            PATIENCE_S,
        )
        assert SECRET not in health(address)
        assert len(fleet.list_unsettled(during)) == len(during)  # no batch is acknowledged
        bucket.bring_back(kind)
        until(lambda: drive(fleet, during), PATIENCE_S)
        process.terminate()
        assert process.wait(PATIENCE_S) == 0
    found = list_archived(tmp_path)
    assert len(found) == len(set(found)) == 3 * len(before + during)
    _same_in_the_bucket(bucket, root)


@pytest.mark.parametrize("kind", ["stopped", "frozen"])
@pytest.mark.campaign
def test_service_killed_between_disk_and_bucket_loses_no_row(
    router: ZenohSettings, session: zenoh.Session, bucket: BucketServer, tmp_path: Path, kind: str
) -> None:
    root = tmp_path / "archive"
    fleet = Fleet(session)
    before = reports(0.8, 1, BATCHES)
    during = reports(0.6, BATCHES + 1, 2 * BATCHES)
    with service(router, tmp_path, bucket) as (process, _):
        until(lambda: drive(fleet, before), PATIENCE_S)
        written = len(list_archived(tmp_path))
        bucket.take_away(kind)
        until(
            lambda: not drive(fleet, during) and len(list_archived(tmp_path)) > written, PATIENCE_S
        )
        process.kill()
        process.wait()
        assert len(fleet.list_unsettled(during)) == len(during)
    bucket.bring_back(kind)
    with service(router, tmp_path, bucket) as (process, _):
        until(lambda: drive(fleet, during), PATIENCE_S)
        process.terminate()
        assert process.wait(PATIENCE_S) == 0
    found = list_archived(tmp_path)
    assert len(found) == len(set(found)) == 3 * len(before + during)
    assert all(one in found for one in identities(fleet, tmp_path))
    _same_in_the_bucket(bucket, root)


@pytest.mark.parametrize("beside", [True, False])
@pytest.mark.campaign
def test_an_erased_vehicle_leaves_the_bucket_too(
    router: ZenohSettings,
    session: zenoh.Session,
    bucket: BucketServer,
    tmp_path: Path,
    beside: bool,
) -> None:
    root = tmp_path / "archive"
    fleet = Fleet(session)
    sent = reports(0.8, 1, BATCHES)
    words = ["forget", "--archive", str(root), "--period", MONTH, "--vehicle", "sim-001", "--yes"]
    with service(router, tmp_path, bucket) as (process, _):
        until(lambda: drive(fleet, sent), PATIENCE_S)
        gone = Pseudonyms(root / "keys").of("sim-001", time.time_ns())
        if beside:
            assert main(words) == 0
        process.terminate()
        assert process.wait(PATIENCE_S) == 0
    if not beside:
        assert main(words) == 2  # the archive has a copy, but the service does not know its address
        assert main([*words, "--config", str(tmp_path / "service.json")]) == 0
    new = tmp_path / "new"
    with closing(Engine(settings(bucket), new)):
        others = pseudonyms_of(new)
        assert len(others) == 3 * BATCHES * (VEHICLES - 1)
        assert gone not in others
        assert list((new / "keys").glob(f"{MONTH}.{gone}.*.erased")), (
            "and it does not come in again"
        )
    kept = {
        name: content
        for name, content in bucket.read_objects().items()
        if not name.startswith("observations/")
    }
    assert not any(
        bytes.fromhex(gone) in content
        for name, content in kept.items()
        if name.endswith(".witnesses")
    )


def _same_in_the_bucket(bucket: BucketServer, root: Path) -> None:
    in_bucket = bucket.read_objects()
    on_disk = list_copied_files(root)
    log = {name for name in on_disk if name.startswith(("inbox/", "keys/"))}
    assert {name for name in in_bucket if name.startswith(("inbox/", "keys/"))} == log
    assert all(in_bucket[name] == on_disk[name] for name in log)
    assert json.loads(in_bucket[OWNER]) == {"service": "shard-0"}
