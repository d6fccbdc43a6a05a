"""Tests of a standby whose disk is full: it waits, says so, and takes over when there is space."""

from __future__ import annotations

import errno
import json
import os
from collections.abc import Callable
from pathlib import Path

import pytest
import zenoh

from fleet_service.replication import lease, ownership
from fleet_service.replication.replica import BucketReplica
from schemas.config import ZenohSettings
from schemas.wire import Kind
from tests.buckets import BucketServer
from tests.faults.disk import fill_disk, small_disk
from tests.fleet_service.app.test_copy import BATCHES, PATIENCE_S, reports
from tests.fleet_service.app.test_service import Fleet
from tests.fleet_service.archive.rows import identities as rows_in
from tests.fleet_service.replication.test_lease import (
    Machine,
    assert_whole,
    leave_unacknowledged_rows,
    make_driver,
)
from tests.schemas.runtime.test_metrics import fetch_page
from tests.standbys import open_hosts
from tests.waiting import until


@pytest.mark.campaign
def test_standby_with_a_full_disk_waits_and_takes_over_when_there_is_space(
    router: ZenohSettings, session: zenoh.Session, bucket: BucketServer, tmp_path: Path
) -> None:
    fleet = Fleet(session)
    before, during = (reports(0.8, n * BATCHES + 1, (n + 1) * BATCHES) for n in range(2))
    with (
        open_hosts(
            tmp_path, ["one", "two"], router.connect[0], bucket, lease_s=3.0, metrics_port=0
        ) as (one, two),
        small_disk(two.root) as is_mounted,
    ):
        if not is_mounted:
            pytest.skip("this process may not mount a small disk")
        one.part.start()
        one.part.line_with("ready: ")
        two.part.start()
        address = two.part.line_with("standby: shard-0 ").rpartition(", ")[2]
        with fill_disk(two.root, mounted=True):
            until(make_driver(fleet, before), PATIENCE_S)
            two.part.line_with("standby: cannot store the files of the archive on this disk")
            status, _, health = fetch_page(f"{address}/healthz")
            assert status == 503
            assert "No space left on device" in health
            one.part.kill()
            for sent in during:
                fleet.publish(sent)
        two.part.line_with("ready: ")
        until(make_driver(fleet, during), PATIENCE_S)
        assert two.part.stop() == 0
        assert_whole(fleet, before + during, two.root.parent)


@pytest.mark.parametrize(
    "steps",
    [
        ((BucketReplica, "sync_under_lease"), (BucketReplica, "prefetch")),
        ((ownership, "save_holder"),),
    ],
    ids=["files", "identity"],
)
def test_full_disk_delays_a_takeover_without_loss(
    bucket: BucketServer,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    steps: tuple[tuple[object, str], ...],
) -> None:
    """The disk is full until the standby says so. It has then released the lease, so that another
    standby could take over.
    """
    monkeypatch.setattr(lease, "PREFETCH_S", 0.0)
    one, before = leave_unacknowledged_rows(bucket, tmp_path)
    lines: list[str] = []
    released: list[bool] = []

    def fill_disk_before(work: Callable[..., object]) -> Callable[..., object]:
        def do(*words: object, **named: object) -> object:
            if not lines:
                raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
            return work(*words, **named)

        return do

    def record_line(line: str) -> None:
        lines.append(line)
        leases = sorted(one for one in bucket.read_objects().items() if "lease/" in one[0])
        released.append(json.loads(leases[-1][1])["released"])

    for owner, name in steps:
        monkeypatch.setattr(owner, name, fill_disk_before(getattr(owner, name)))
    back = Machine(one.root, bucket, record_line)
    (line,) = lines
    assert line.startswith("standby: cannot store the files of the archive on this disk (No space")
    assert released == [True]
    assert sorted(rows_in(back.root, Kind.OBSERVATION)) == before
    back.close()
