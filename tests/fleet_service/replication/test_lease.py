"""Tests of the lease (exclusive ownership of an archive). If a service ends, freezes or is cut off,
another service must take over the archive, with every acknowledged row exactly once.
"""

from __future__ import annotations

import signal
import socket
import threading
import time
from collections.abc import Callable
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest
import zenoh

from fleet_service.archive.format import segments
from fleet_service.archive.maintenance import compaction
from fleet_service.archive.maintenance.compaction import compact
from fleet_service.archive.segment_log import SegmentLog
from fleet_service.replication.bucket import CopyError, ObjectBucket
from fleet_service.replication.folder_identity import holder_of
from fleet_service.replication.lease import Lease
from fleet_service.replication.ownership import Ownership, acquire_archive, open_exclusive
from fleet_service.replication.replica import BucketReplica
from schemas.config import ServiceConfig, ZenohSettings
from schemas.errors import InputError
from schemas.wire import Batch, Kind
from tests.buckets import BucketServer
from tests.fleet_service.app.test_copy import BATCHES, PATIENCE_S, reports
from tests.fleet_service.app.test_kill import identities, list_archived
from tests.fleet_service.app.test_service import Fleet
from tests.fleet_service.archive.rows import identities as rows_in
from tests.fleet_service.archive.rows import rows_of
from tests.schemas.runtime.test_metrics import fetch_page
from tests.standbys import Host, open_hosts, restore_archive
from tests.waiting import until

RESEND_S = 1.0
LEASE_S = 4.0  # lease time of services in threads; a request may take a quarter of it


GONE: dict[str, Callable[[Host], None]] = {
    "killed": lambda host: host.part.kill(),
    "stopped": lambda host: host.part.send_signal(signal.SIGTERM),
    "frozen": lambda host: host.part.freeze(),
    "cut from the bucket": lambda host: host.to_bucket.cut(),
    "cut from the routers": lambda host: host.to_router.cut(),
}


@pytest.mark.campaign
@pytest.mark.parametrize("how", GONE)
def test_standby_continues_with_all_acknowledged_rows(
    router: ZenohSettings, session: zenoh.Session, bucket: BucketServer, tmp_path: Path, how: str
) -> None:
    fleet = Fleet(session)
    before, during, after = (reports(0.8, n * BATCHES + 1, (n + 1) * BATCHES) for n in range(3))
    with open_hosts(tmp_path, ["one", "two"], router.connect[0], bucket, lease_s=3.0) as (one, two):
        one.part.start()
        one.part.line_with("ready: ")
        two.part.start()
        two.part.line_with("standby: ")
        until(make_driver(fleet, before), PATIENCE_S)
        for sent in during[: len(during) // 2]:
            fleet.publish(sent)
        GONE[how](one)
        two.part.line_with("ready: ")
        until(make_driver(fleet, during), PATIENCE_S)
        if how == "frozen":
            one.part.send_signal(signal.SIGCONT)
        one.to_router.restore()
        # A service that still runs must end. If it is cut off from the bucket, it learns of its
        # successor by the token.
        if how not in {
            "killed",
            "stopped",
        }:
            assert one.part.wait(PATIENCE_S) == 1
            assert one.has_said("lease lost to another service")
        one.to_bucket.restore()
        one.part.start()  # it is now the standby, and its folder becomes a copy of the bucket
        one.part.line_with("standby: ")
        two.part.stop()
        one.part.line_with("ready: ")
        until(make_driver(fleet, after), PATIENCE_S)
        assert one.part.stop() == 0
    assert_whole(fleet, before + during + after, tmp_path / "one")
    restore_archive(tmp_path / "new", bucket)
    assert_whole(fleet, before + during + after, tmp_path / "new")


def make_driver(fleet: Fleet, sent: list[Batch]) -> Callable[[], bool]:
    """Return a function for repeated calls. Once a second it sends those batches of `sent` again
    that no service has acknowledged. It returns True when all of them are acknowledged.
    """
    last = [0.0]

    def is_done() -> bool:
        if time.monotonic() - last[0] < RESEND_S:
            return not fleet.list_unsettled(sent)
        last[0] = time.monotonic()
        for one in fleet.list_unsettled(sent):
            fleet.publish(one)
        return False

    return is_done


def assert_whole(fleet: Fleet, sent: list[Batch], folder: Path) -> None:
    """Check that an archive contains the rows of all batches once, and no others."""
    found = list_archived(folder)
    assert len(found) == len(set(found)) == 3 * len(sent)
    assert sorted(found) == sorted(identities(fleet, folder))


@pytest.mark.campaign
def test_one_of_two_standbys_takes_over_and_the_other_waits(
    router: ZenohSettings, session: zenoh.Session, bucket: BucketServer, tmp_path: Path
) -> None:
    fleet = Fleet(session)
    sent = reports(0.8, 1, BATCHES)
    with open_hosts(tmp_path, ["one", "two", "three"], router.connect[0], bucket, lease_s=3.0) as (
        one,
        two,
        three,
    ):
        one.part.start()
        one.part.line_with("ready: ")
        for host in (two, three):
            host.part.start()
            host.part.line_with("standby: ")
        until(make_driver(fleet, sent), PATIENCE_S)
        one.part.kill()
        until(lambda: two.has_said("ready: ") or three.has_said("ready: "), PATIENCE_S)
        first, second = (two, three) if two.has_said("ready: ") else (three, two)
        until(lambda: second.has_said("standby: shard-0 is served under lease 2"), PATIENCE_S)
        assert not second.has_said("ready: ")
        first.part.kill()
        second.part.line_with("ready: ")
        assert second.part.stop() == 0
    assert_whole(fleet, sent, second.root.parent)


class Machine:
    """Service that runs in threads on an archive folder. A test can stop it between any two
    steps.
    """

    def __init__(
        self,
        root: Path,
        bucket: BucketServer,
        say: Callable[[str], None] = print,
        *,
        standby: bool = True,
    ) -> None:
        root.mkdir(exist_ok=True)
        self.root = root
        settings = {"standby": standby, "lease_s": LEASE_S, "archive": bucket.settings}
        self.config = ServiceConfig.model_validate(settings)
        # A router is reachable, and no token is active.
        router_signs = (
            lambda: True,
            lambda _: False,
            lambda: None,
        )
        signs = router_signs if standby else None
        held = acquire_archive(self.config, root, threading.Event(), say, signs)
        assert held is not None
        self.holding: Ownership = held
        upload = None if held.copy is None else held.copy.upload_segments
        self.log: SegmentLog[int] = SegmentLog(root, self.config.name, upload, held.smallest_epoch)

    @property
    def copy(self) -> BucketReplica:
        assert self.holding.copy is not None
        return self.holding.copy

    def freeze(self) -> None:
        """Stop the service from renewing its lease (ownership of the archive), as if its process
        were frozen.
        """
        assert self.holding.lease is not None
        self.holding.lease._stop.set()

    def write(self, seed: int) -> None:
        self.log.add(Kind.OBSERVATION, rows_of(Kind.OBSERVATION, 5, seed), [seed])
        assert self.log.flush() == [seed]

    def close(self) -> None:
        self.log.close()
        self.holding.close()


def acknowledges(one: Machine) -> bool:
    return one.holding.may_acknowledge


@pytest.mark.campaign
def test_unfinished_work_of_a_frozen_service_has_no_effect(
    bucket: BucketServer, tmp_path: Path
) -> None:
    one = Machine(tmp_path / "one", bucket)
    for seed in range(3):
        one.write(seed)
    assert acknowledges(one)
    one.freeze()
    two = Machine(tmp_path / "two", bucket)  # the constructor waits until the lease is old
    assert not acknowledges(one)
    before = rows_in(two.root, Kind.OBSERVATION)
    assert len(before) == 15
    # The frozen service resumes in the middle of its work: it writes a segment, compacts, and tries
    # to upload the result and to delete the compacted files.
    one.write(3)
    assert not acknowledges(one)
    compact(one.root)
    with pytest.raises(CopyError):
        one.copy.sync()
    # As if it had been frozen right after the check of its lease.
    one.copy.bucket.may_write = lambda: True
    with pytest.raises(CopyError, match="another service has the lease"):
        one.copy.sync()
    names = bucket.read_objects()
    assert any(name.startswith("observations/") for name in names)
    assert sum(name.startswith("inbox/") for name in names) == 4  # the bucket still has these files
    compact(two.root)
    two.copy.sync()
    for root in (two.root, restore_archive(tmp_path / "new", bucket)):
        assert sorted(rows_in(root, Kind.OBSERVATION)) == sorted(before)
    two.close()
    again = Machine(tmp_path / "two", bucket)  # at its start it removes invalid objects
    assert not [name for name in bucket.read_objects() if name.startswith("inbox/")]
    again.close()
    one.close()
    back = Machine(tmp_path / "one", bucket)
    assert sorted(rows_in(back.root, Kind.OBSERVATION)) == sorted(before)
    assert not segments.list_segments(back.root, Kind.OBSERVATION)
    back.close()


def test_folder_served_without_its_bucket_is_not_synchronised(
    bucket: BucketServer, tmp_path: Path
) -> None:
    one = Machine(tmp_path / "one", bucket)
    one.write(0)
    one.close()
    open_exclusive(ServiceConfig(), one.root).close()
    two = Machine(tmp_path / "two", bucket)
    two.close()
    with pytest.raises(InputError, match="is not the archive of"):
        Machine(one.root, bucket)
    assert len(rows_in(one.root, Kind.OBSERVATION)) == 5


class _KilledError(Exception):
    """Error in place of the end of a process."""


def test_interrupted_take_over_removes_unacknowledged_rows_next_time(
    bucket: BucketServer, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """They must not count after the folder's take-over was interrupted."""
    one, before = leave_unacknowledged_rows(bucket, tmp_path)

    def fail(*_: object, **__: object) -> None:
        raise _KilledError

    with monkeypatch.context() as killed:
        killed.setattr(BucketReplica, "sync_under_lease", fail)
        with pytest.raises(_KilledError):
            Machine(one.root, bucket)
    back = Machine(one.root, bucket)
    assert sorted(rows_in(back.root, Kind.OBSERVATION)) == before
    back.close()


def leave_unacknowledged_rows(
    bucket: BucketServer, tmp_path: Path
) -> tuple[Machine, list[tuple[int, int]]]:
    """Return a closed service whose folder keeps rows that were never acknowledged and that another
    service has received again, and the rows of that service, which has left too.
    """
    one = Machine(tmp_path / "one", bucket)
    one.write(0)
    with pytest.MonkeyPatch.context() as cut:
        cut.setattr(one.log, "_upload", lambda _: None)
        one.write(1)
    one.close()
    two = Machine(tmp_path / "two", bucket)
    two.write(1)
    before = sorted(rows_in(two.root, Kind.OBSERVATION))
    two.close()
    return one, before


@pytest.mark.campaign
def test_a_compaction_that_outlived_its_service_is_waited_for(
    bucket: BucketServer, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    one = Machine(tmp_path / "one", bucket)
    one.write(0)
    with monkeypatch.context() as killed:  # failure between writing to disk and uploading
        killed.setattr(one.log, "_upload", lambda _: None)
        one.write(1)
    has_read = threading.Event()
    goes_on = threading.Event()
    place = compaction._place_files

    def count_placed(*args: Any) -> int:  # noqa: ANN401
        has_read.set()
        goes_on.wait()
        return place(*args)

    monkeypatch.setattr(compaction, "_place_files", count_placed)
    still = threading.Thread(target=compact, args=(one.root,))
    still.start()
    has_read.wait()
    one.freeze()
    one.log.close()
    assert one.holding.lease is not None
    one.holding.lease.lost = True  # so that it does not release the lease
    one.holding.close()
    two = Machine(tmp_path / "two", bucket)
    assert len(rows_in(two.root, Kind.OBSERVATION)) == 5
    two.close()
    lines: list[str] = []
    back: list[Machine] = []
    start = threading.Thread(
        target=lambda: back.append(Machine(one.root, bucket, say=lines.append))
    )
    start.start()
    until(lambda: any("is being compacted" in line for line in lines))
    goes_on.set()
    for thread in (still, start):
        thread.join(PATIENCE_S)
    back[0].copy.sync()
    for root in (one.root, restore_archive(tmp_path / "new", bucket)):
        assert len(rows_in(root, Kind.OBSERVATION)) == 5
    back[0].close()


def test_start_without_bucket_ends_or_waits_as_a_standby(
    bucket: BucketServer, tmp_path: Path
) -> None:
    bucket.stop()
    with pytest.raises(InputError, match="cannot be used .* check the network"):
        Machine(tmp_path / "one", bucket, standby=False)
    lines: list[str] = []
    made: list[Machine] = []
    start = threading.Thread(
        target=lambda: made.append(Machine(tmp_path / "two", bucket, lines.append)), daemon=True
    )
    start.start()
    until(lambda: any(line.startswith("standby: the copy cannot be reached") for line in lines))
    bucket.start()
    start.join(PATIENCE_S)
    made[0].write(0)
    made[0].close()


@pytest.mark.campaign
def test_standby_signals_systemd_and_shows_that_it_does_not_serve(
    router: ZenohSettings, bucket: BucketServer, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    holder = Machine(tmp_path / "one", bucket)
    with (
        socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as notified,
        open_hosts(
            tmp_path, ["two"], router.connect[0], bucket, lease_s=LEASE_S, metrics_port=0
        ) as (two,),
    ):
        notified.bind(str(tmp_path / "notify"))
        notified.settimeout(PATIENCE_S)
        monkeypatch.setenv("NOTIFY_SOCKET", str(tmp_path / "notify"))
        monkeypatch.setenv("WATCHDOG_USEC", "1000000")
        two.part.start()
        address = two.part.line_with("standby: shard-0 ").rpartition(", ")[2]
        for _ in range(3):
            assert notified.recv(100) == b"READY=1\nWATCHDOG=1"
        assert (
            'gripmap_serves{regions="*/*/*"} 0.0'
            in fetch_page(f"{address}/metrics")[2].splitlines()
        )
        assert fetch_page(f"{address}/healthz")[0] == 200
        holder.close()
        two.part.line_with("ready: ")
        lines = fetch_page(f"{two.part.line_with('ready: ').rpartition(', ')[2]}/metrics")[
            2
        ].splitlines()
        assert 'gripmap_serves{regions="*/*/*"} 1.0' in lines
        assert two.part.stop() == 0


def test_active_lease_is_refused_to_a_service_that_is_no_standby(
    bucket: BucketServer, tmp_path: Path
) -> None:
    one = Machine(tmp_path / "one", bucket)
    with pytest.raises(InputError, match="is served by shard-0"):
        Machine(tmp_path / "two", bucket, standby=False)
    one.close()
    Machine(tmp_path / "two", bucket).close()  # the lease was released


def test_copied_folder_is_another_lease_holder(tmp_path: Path) -> None:
    one = tmp_path / "one"
    two = tmp_path / "two"
    one.mkdir()
    two.mkdir()
    first, known = holder_of(one, "s3://bucket/a")
    assert not known
    assert holder_of(one, "s3://bucket/a") == (first, True)
    (two / "holder.json").write_bytes((one / "holder.json").read_bytes())
    assert holder_of(two, "s3://bucket/a")[0] != first
    assert holder_of(one, "s3://bucket/b") != (first, True)


def test_one_of_many_takes_a_lease(bucket: BucketServer) -> None:
    stores = ObjectBucket(bucket.url, bucket.store, 5.0)
    leases = [Lease(f"holder-{n}", stores, "shard-0", 5.0) for n in range(3)]
    taken = [lease._create_next(None, lambda: 0, threading.Event()) for lease in leases]
    assert taken == [True, False, False]


@pytest.mark.skipif(
    not hasattr(time, "CLOCK_BOOTTIME"), reason="this system does not count while it is suspended"
)
@pytest.mark.parametrize("lease_s", [4.0, 40.0])
def test_acknowledgement_stops_half_a_lease_after_the_last_renewal(
    bucket: BucketServer, monkeypatch: pytest.MonkeyPatch, lease_s: float
) -> None:
    now = [100.0]
    # `monotonic` stops while a machine is suspended, so the lease must not use it.
    clock = SimpleNamespace(monotonic=lambda: 0.0, clock_gettime=lambda _: now[0], time=time.time)
    for module in ("fleet_service.replication.lease", "schemas.runtime.steady_clock"):
        monkeypatch.setattr(f"{module}.time", clock)
    lease = Lease("one", ObjectBucket(bucket.url, bucket.store, 5.0), "shard-0", lease_s)
    fresh = [lease.may_acknowledge]
    assert lease.wait(threading.Event(), print, lambda: 0, None)
    for _ in range(2):
        for share in (0.49, 0.02):
            now[0] += share * lease_s
            fresh.append(lease.may_acknowledge)
        lease.renew()
    assert fresh == [False, True, False, True, False]
    assert lease.may_acknowledge
