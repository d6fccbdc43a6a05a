"""Tests of the lease object, which records in the bucket which service owns the archive. The object
must state the lease time, and objects of other versions must be readable. A damaged object may
delay a service but must never end it.
"""

from __future__ import annotations

import gzip
import json
import threading
import time
from types import SimpleNamespace
from typing import cast

import pytest

from fleet_service.archive.format.version import Version, parse_version
from fleet_service.replication import lease as lease_module
from fleet_service.replication.bucket import CopyError, ObjectBucket
from fleet_service.replication.fence import fence_of
from fleet_service.replication.lease import UNKNOWN, Lease, Standby
from schemas.errors import InputError


class MemoryBucket:
    """Simulated bucket (object store) in memory. It can create an object only if no object has this
    name.
    """

    def __init__(self) -> None:
        self.objects: dict[str, bytes] = {}

    def list_names(self, folder: str) -> list[str]:
        return [name for name in self.objects if name.startswith(f"{folder}/")]

    def get(self, name: str) -> bytes | None:
        return self.objects.get(name)

    def put(self, name: str, content: bytes) -> None:
        self.objects[name] = content

    def create(self, name: str, content: bytes) -> bool:
        return self.objects.setdefault(name, content) is content


def lease_on(bucket: MemoryBucket, name: str, lease_s: float) -> Lease:
    return Lease(name, cast(ObjectBucket, bucket), name, lease_s)


def standby_of(bucket: MemoryBucket, name: str, lease_s: float) -> Lease:
    """Let the standby (waiting service) `name` take over the lease (ownership of the archive) in
    the bucket. Return the `Lease` of this standby.
    """
    standby = Standby(
        can_serve=lambda: True,
        has_token=lambda _: False,
        notify_alive=lambda: None,
        prefetch=lambda: "",
    )
    lease = lease_on(bucket, name, lease_s)
    assert lease.wait(threading.Event(), print, lambda: 0, standby)
    return lease


@pytest.mark.parametrize(("holder_s", "standby_s"), [(60.0, 5.0), (5.0, 60.0), (0.5, 0.6)])
def test_service_with_another_lease_time_does_not_start(
    monkeypatch: pytest.MonkeyPatch, holder_s: float, standby_s: float
) -> None:
    bucket = MemoryBucket()
    holder = lease_on(bucket, "one", holder_s)
    assert holder._create_next(None, lambda: 0, VirtualStop(monkeypatch))
    with pytest.raises(
        InputError, match=rf"archive.lease_s: is {standby_s:g}, and one, .* uses {holder_s:g}"
    ):
        standby_of(bucket, "two", standby_s)
    assert holder.may_acknowledge
    holder.release()
    assert standby_of(bucket, "two", standby_s).former_holders == ("one",)


@pytest.mark.parametrize("lease_s", [None, 0.5])
def test_lease_of_another_version_is_read(lease_s: float | None) -> None:
    bucket = MemoryBucket()
    record = {
        "holder": "one",
        "service": "one",
        "epoch": 7,
        "turn": 3,
        "released": False,
        "later": {"a": [1]},
    }
    bucket.put(
        "lease/0000000002.json",
        json.dumps(record | ({} if lease_s is None else {"lease_s": lease_s})).encode(),
    )
    standby = standby_of(bucket, "two", 0.5)
    assert (standby.term.number, standby.former_holders) == (3, ("one",))


@pytest.mark.parametrize(
    "content",
    [
        b"",
        b'{"holder": "one", "ser',
        b"[]",
        b"\xff",
        b'{"holder":1,"service":2,"epoch":"x","turn":0,"released":0}',
    ],
)
def test_damaged_lease_is_waited_for_and_then_taken(content: bytes) -> None:
    bucket = MemoryBucket()
    assert lease_on(bucket, "one", 0.5)._create_next(None, lambda: 0, threading.Event())
    bucket.put("lease/0000000002.json", content)
    standby = standby_of(bucket, "two", 0.5)
    assert (standby.term.number, standby.former_holders) == (3, ("one", UNKNOWN))


def test_holder_repairs_a_damaged_lease_and_keeps_it(monkeypatch: pytest.MonkeyPatch) -> None:
    bucket = MemoryBucket()
    holder = lease_on(bucket, "one", 0.5)
    assert holder._create_next(None, lambda: 0, VirtualStop(monkeypatch))
    name = "lease/0000000001.json"
    bucket.put(name, bucket.objects[name][:20])
    holder.renew()
    assert holder.may_acknowledge
    assert json.loads(bucket.objects[name])["service"] == "one"


def test_failed_renewal_uses_its_turn_up(monkeypatch: pytest.MonkeyPatch) -> None:
    """Each renewal of the lease writes a serial number, its turn. After a failed renewal the next
    one must use another turn, because the failed write may still take effect later.
    """
    bucket = MemoryBucket()
    holder = lease_on(bucket, "one", 0.5)
    assert holder._create_next(None, lambda: 0, threading.Event())
    written: list[bytes] = []

    def fail(_: str, content: bytes) -> None:
        written.append(content)
        raise CopyError("no answer")

    with monkeypatch.context() as cut:
        cut.setattr(bucket, "put", fail)
        with pytest.raises(CopyError):
            holder.renew()
    holder.renew()
    holder.release()
    turns = [json.loads(one)["turn"] for one in (*written, *bucket.objects.values())]
    assert turns == [1, 3]


class VirtualStop(threading.Event):
    """Event whose waits take no real time. They advance the virtual clock of the lease module, and
    a wait of at least `long_s` sets the event.
    """

    def __init__(self, monkeypatch: pytest.MonkeyPatch, long_s: float = 1e9) -> None:
        super().__init__()
        self._now_s = 0.0
        self._long_s = long_s
        clock = SimpleNamespace(
            monotonic=lambda: self._now_s, clock_gettime=lambda _: self._now_s, time=time.time
        )
        for module in ("fleet_service.replication.lease", "schemas.runtime.steady_clock"):
            monkeypatch.setattr(f"{module}.time", clock)

    def wait(self, timeout: float | None = None) -> bool:
        assert timeout is not None
        self._now_s += timeout
        if timeout >= self._long_s:
            self.set()
        return self.is_set()


class LateRenewalBucket(MemoryBucket):
    """Bucket to which `holder` writes a renewal just before another service creates a lease. If
    `is_cut`, it does not answer the next request.
    """

    def __init__(self, *, is_cut: bool) -> None:
        super().__init__()
        self._is_cut = is_cut
        self._fails = False
        self.holder = lease_on(self, "one", 4.0)
        assert self.holder._create_next(None, lambda: 0, threading.Event())

    def get(self, name: str) -> bytes | None:
        fails = self._fails
        self._fails = False
        if fails:
            raise CopyError("no answer")
        return super().get(name)

    def create(self, name: str, content: bytes) -> bool:
        if len(self.objects) == 1 and self.holder.term.number:
            self.holder.renew()
            self._fails = self._is_cut
        return super().create(name, content)


@pytest.mark.parametrize("is_cut", [False, True])
def test_former_holder_stops_before_the_successor_starts(
    monkeypatch: pytest.MonkeyPatch, is_cut: bool
) -> None:
    stop = VirtualStop(monkeypatch)
    bucket = LateRenewalBucket(is_cut=is_cut)
    standby = Standby(lambda: True, lambda _: False, lambda: None, lambda: "")
    assert lease_on(bucket, "two", 4.0).wait(stop, print, lambda: 0, standby)
    assert not bucket.holder.may_acknowledge


def test_take_over_stopped_before_its_check_releases_nothing(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    stop = VirtualStop(monkeypatch, long_s=4.0)
    bucket = LateRenewalBucket(is_cut=False)
    standby = Standby(lambda: True, lambda _: False, lambda: None, lambda: "")
    lease = lease_on(bucket, "two", 4.0)
    assert not lease.wait(stop, print, lambda: 0, standby)
    lease.release()
    assert not any(json.loads(content)["released"] for content in bucket.objects.values())


def test_damaged_fence_is_an_error_of_the_copy() -> None:
    bucket = MemoryBucket()
    for content in (b"", b"no gzip", gzip.compress(b"[]"), gzip.compress(b'{"epoch": 1}')):
        bucket.put("fence/0000000001-000001.json.gz", content)
        with pytest.raises(CopyError, match="is damaged"):
            fence_of(cast(ObjectBucket, bucket))


@pytest.mark.parametrize("text", ["1.x", "1", "", "1.2.3", "one", " 1.2", "-1.0"])
def test_malformed_version_is_an_input_error(text: str) -> None:
    with pytest.raises(InputError, match="archive: version .* is not MAJOR.MINOR"):
        parse_version(text)
    assert parse_version("10.2") == Version(10, 2)


def test_standby_takes_over_only_when_its_disk_accepts_files(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """The holder leaves at the second of three attempts that the standby's full disk refuses."""
    monkeypatch.setattr(lease_module, "PREFETCH_S", 0.0)
    bucket = MemoryBucket()
    holder = lease_on(bucket, "one", 60.0)
    assert holder._create_next(None, lambda: 0, threading.Event())
    attempts: list[int] = []
    lines: list[str] = []

    def prefetch() -> str:
        attempts.append(1)
        if len(attempts) == 2:
            holder.release()
        return "cannot store files" if len(attempts) < 4 else ""

    standby = Standby(lambda: True, lambda _: False, lambda: None, prefetch)
    lease = lease_on(bucket, "two", 60.0)
    assert lease.wait(threading.Event(), lines.append, lambda: 0, standby)
    assert len(attempts) == 4
    assert lines == ["standby: cannot store files; trying again"]
    assert lease.former_holders == ("one",)
