"""Tests of the bucket replica (copy of an archive in an object store). It must contain every
acknowledged row, and must lose the files that are deleted from the archive. A service with an empty
disk must be able to restore the archive from it.
"""

from __future__ import annotations

import json
import sys
import threading
from collections.abc import Callable, Iterator
from concurrent.futures import ALL_COMPLETED, Future, ThreadPoolExecutor, wait
from contextlib import closing
from datetime import date
from pathlib import Path
from types import SimpleNamespace
from typing import BinaryIO

import pytest

from fleet_service.archive.format import layout, segments
from fleet_service.archive.format.load import set_aside
from fleet_service.archive.identity.pseudonyms import Pseudonyms
from fleet_service.archive.maintenance.compaction import compact
from fleet_service.archive.maintenance.retention import retire_rows
from fleet_service.archive.segment_log import SegmentLog
from fleet_service.replication import file_transfer, replica, upload_backoff, upload_journal
from fleet_service.replication.bucket import CopyError, ObjectBucket
from fleet_service.replication.replica import OWNER, BucketReplica
from fleet_service.replication.upload_journal import Stamp, UploadJournal, last_copy_url
from schemas.config import ServiceConfig, load_config
from schemas.errors import InputError
from schemas.wire import Kind
from tests.buckets import SECRET, BucketServer, list_copied_files
from tests.fleet_service.archive.rows import identities, rows_of
from tests.waiting import until

NAME = "shard-0"
Make = Callable[[Path], BucketReplica]


@pytest.fixture
def make(bucket: BucketServer) -> Iterator[Make]:
    """Yield a function that starts the copying of an archive folder to a bucket (object store). At
    the end of the test all copying is stopped.
    """
    made: list[BucketReplica] = []

    def begin_replica(root: Path) -> BucketReplica:
        root.mkdir(exist_ok=True)
        made.append(BucketReplica(root, bucket.url, bucket.store))
        made[-1].sync_without_lease(NAME)
        return made[-1]

    yield begin_replica
    for copy in made:
        copy.close()


def there(bucket: BucketServer) -> dict[str, bytes]:
    return {name: content for name, content in bucket.read_objects().items() if name != OWNER}


def fill_log(root: Path, copy: BucketReplica | None, seeds: range = range(3)) -> SegmentLog[int]:
    """Return a segment log (writer of new rows) that has written files of observations and states
    to the disk. With the bucket replica `copy`, it has also uploaded these files to the bucket.
    """
    log: SegmentLog[int] = SegmentLog(root, NAME, None if copy is None else copy.upload_segments)
    Pseudonyms(root / "keys").of("sim-001", 0)
    for seed in seeds:
        for kind in Kind:
            log.add(kind, rows_of(kind, 5, seed), [seed])
        assert log.flush() == [seed, seed]
    return log


def test_settled_files_are_in_the_bucket_byte_for_byte(
    bucket: BucketServer, make: Make, tmp_path: Path
) -> None:
    root = tmp_path / "archive"
    with closing(fill_log(root, make(root))):
        assert len(there(bucket)) == 2 * 3 + 1
        assert there(bucket) == list_copied_files(root)


def test_rows_settle_once_after_a_bucket_outage_and_not_during_it(
    bucket: BucketServer, make: Make, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    now = [100.0]
    clock = SimpleNamespace(monotonic=lambda: now[0])
    monkeypatch.setattr(upload_backoff, "time", clock)
    root = tmp_path / "archive"
    copy = make(root)
    with closing(fill_log(root, copy)) as log:
        bucket.stop()
        log.add(Kind.OBSERVATION, rows_of(Kind.OBSERVATION, 5, 7), [7])
        with pytest.raises(CopyError):
            log.flush()
        now[0] += 0.9 * upload_backoff.BACK_OFF_S
        log.add(Kind.OBSERVATION, rows_of(Kind.OBSERVATION, 5, 8), [8])
        # The error comes at once, without a request to the network.
        with pytest.raises(CopyError, match="is tried again"):
            log.flush()
        assert (copy.backoff.failures, log.unsettled, log.rows) == (1, 2, 0)
        assert copy.backoff.away_s > 0
        assert "nothing is acknowledged" in str(copy.backoff.trouble)
        assert SECRET not in str(copy.backoff.trouble)
        bucket.start()
        now[0] += 0.2 * upload_backoff.BACK_OFF_S
        assert log.flush() == [7, 8]
        assert copy.backoff.trouble is None
        assert there(bucket) == list_copied_files(root)
    assert len(identities(root, Kind.OBSERVATION)) == 5 * 5


def test_upload_whose_answer_was_lost_is_no_error(
    bucket: BucketServer, make: Make, tmp_path: Path
) -> None:
    root = tmp_path / "archive"
    copy = make(root)
    with closing(fill_log(root, None)):
        (first, *others) = segments.list_segments(root, Kind.OBSERVATION)
        bucket.path_of("inbox").mkdir(parents=True)
        bucket.path_of(f"inbox/{first.name}").write_bytes(first.read_bytes())
        copy.upload_segments([first])
        bucket.path_of(f"inbox/{others[0].name}").write_bytes(b"another's")
        with pytest.raises(CopyError, match="another service"):
            copy.upload_segments([others[0]])


def test_the_copy_follows_compaction_and_retention(
    bucket: BucketServer, make: Make, tmp_path: Path
) -> None:
    root = tmp_path / "archive"
    copy = make(root)
    with closing(fill_log(root, copy)):
        assert compact(root).segments == 6
        assert any(name.startswith("inbox/") for name in there(bucket))
        assert copy.sync() > 0
        assert there(bucket) == list_copied_files(root)
        assert not any(name.startswith("inbox/") for name in there(bucket))
        assert copy.sync() == 0
        retire_rows(root, 31, date(2100, 1, 1))
        assert not list(layout.compacted_files(root, Kind.OBSERVATION))
        copy.sync()
        assert there(bucket) == list_copied_files(root)


def test_segment_compacted_before_its_upload_is_settled_by_the_result(
    bucket: BucketServer, make: Make, tmp_path: Path
) -> None:
    root = tmp_path / "archive"
    copy = make(root)
    with closing(fill_log(root, None)):
        gone = segments.list_segments(root, Kind.OBSERVATION)
        compact(root)
        copy.upload_segments(gone)
        assert there(bucket) == list_copied_files(root)
        assert any(name.startswith("observations/") for name in there(bucket))


def test_segment_compacted_during_its_upload_is_not_settled(
    bucket: BucketServer, make: Make, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A compaction goes on while the files of its first segments are uploaded. The other segments
    are then settled only when the bucket has the files that replace them.
    """
    root = tmp_path / "archive"
    copy = make(root)
    with closing(fill_log(root, None)):
        written = segments.list_segments(root, Kind.OBSERVATION)
        written[0].unlink()
        list_files = copy._files.list_files

        def compact_after_listing() -> dict[str, Stamp]:
            found = list_files()
            compact(root)
            return found

        with monkeypatch.context() as slow:
            slow.setattr(copy._files, "list_files", compact_after_listing)
            with pytest.raises(CopyError, match="compacted during the upload"):
                copy._upload_in_time(written)
        copy.upload_segments(written)
        assert there(bucket) == list_copied_files(root)


def test_standby_removes_files_that_the_bucket_no_longer_has(
    bucket: BucketServer, make: Make, tmp_path: Path
) -> None:
    root = tmp_path / "archive"
    standby = tmp_path / "standby"
    copy = make(root)
    with closing(fill_log(root, copy)):
        waiting = make(standby)
        (own := standby / "inbox" / "never-uploaded.parquet").write_bytes(b"")
        compact(root)
        copy.sync()
        waiting.prefetch()
        assert own.exists()
        own.unlink()
        assert list_copied_files(standby) == list_copied_files(root)


def test_an_empty_disk_has_all_of_it_again(
    bucket: BucketServer, make: Make, tmp_path: Path
) -> None:
    root = tmp_path / "archive"
    new = tmp_path / "new"
    copy = make(root)
    with closing(fill_log(root, copy)):
        compact(root)
        copy.sync()
    with closing(fill_log(root, copy, range(3, 5))):
        pass
    (half := bucket.path_of("checkpoints/0000000001-000000000001/streams.arrow")).parent.mkdir(
        parents=True
    )
    half.write_bytes(b"half a checkpoint")
    make(new)
    assert list_copied_files(new) == list_copied_files(root)
    assert len(identities(new, Kind.OBSERVATION)) == 5 * 5
    assert {path.stat().st_mode & 0o777 for path in (new / "keys").iterdir()} == {0o600}
    assert last_copy_url(new) == bucket.url


def test_interrupted_upload_and_damage_are_repaired_at_the_next_start(
    bucket: BucketServer, make: Make, tmp_path: Path
) -> None:
    root = tmp_path / "archive"
    copy = make(root)
    with closing(fill_log(root, copy)):
        copy.close()
    with closing(fill_log(root, None, range(3, 4))):  # written to disk, but not uploaded
        damaged = segments.list_segments(root, Kind.OBSERVATION)[0]
        whole = damaged.read_bytes()
        set_aside(damaged, "a bit has turned")
        lost = bucket.path_of(f"inbox/{segments.list_segments(root, Kind.OBSERVATION)[1].name}")
        lost.unlink()
        make(root)
        assert damaged.read_bytes() == whole
        assert not list(root.rglob("*.bad"))
        assert lost.exists()
        assert there(bucket) == list_copied_files(root)


@pytest.mark.parametrize("uploaded", [False, True])
def test_former_owner_takes_over_the_key_of_its_successor(
    bucket: BucketServer, make: Make, tmp_path: Path, *, uploaded: bool
) -> None:
    former = tmp_path / "former"
    copy = make(former)
    Pseudonyms(former / "keys").of("sim-001", 0)
    if uploaded:
        copy.sync()
        # The successor replaces a key that was uploaded after the lease had ended.
        ObjectBucket(bucket.url, bucket.store, 5.0).delete("keys/1970-01.key")
    successor = tmp_path / "successor"
    with closing(fill_log(successor, make(successor))):
        content = there(bucket)
        copy.sync_under_lease(NAME, succeeds=True)
        assert there(bucket) == content
        assert (former / "keys" / "1970-01.key").read_bytes() == content["keys/1970-01.key"]


def test_a_bucket_is_of_one_service(bucket: BucketServer, make: Make, tmp_path: Path) -> None:
    make(tmp_path / "archive")
    (tmp_path / "other").mkdir()
    with (
        closing(BucketReplica(tmp_path / "other", bucket.url, bucket.store)) as copy,
        pytest.raises(InputError, match="another service, shard-0"),
    ):
        copy.sync_without_lease("shard-1")


@pytest.mark.parametrize("kind", ["stopped", "frozen"])
def test_unreachable_bucket_at_the_start_is_reported_without_hanging(
    bucket: BucketServer, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, kind: str
) -> None:
    monkeypatch.setattr(replica, "SLOW_S", 1.0)
    bucket.take_away(kind)
    with (
        closing(BucketReplica(tmp_path, bucket.url, bucket.store)) as copy,
        pytest.raises(InputError) as raised,
    ):
        copy.sync_without_lease(NAME)
    assert raised.value.field == "archive.copy"
    assert SECRET not in str(raised.value)


def test_folder_of_this_machine_serves_as_a_bucket_for_trials(tmp_path: Path) -> None:
    pytest.importorskip("obstore", reason="pip install 'gripmap[objects]'")
    copy = ObjectBucket((tmp_path / "a bucket" / "north").as_uri(), {}, 5.0)
    assert copy.get("lease/1") is None
    assert copy.create("lease/1", b"mine")
    assert copy.create("lease/1", b"mine"), "the same content again"
    assert not copy.create("lease/1", b"another service's")
    copy.put("log/2", b"first")
    copy.put("log/2", b"second")
    assert sorted(copy.list_names("lease") + copy.list_names("log")) == ["lease/1", "log/2"]
    assert b"".join(copy.read_parts("log/2")) == b"second"
    copy.delete("log/2")
    copy.delete("log/2")
    assert copy.list_sizes() == {"lease/1": 4}
    assert (tmp_path / "a bucket" / "north" / "lease" / "1").read_bytes() == b"mine"


def test_unusable_settings_are_named_with_the_reason(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    pytest.importorskip("obstore", reason="pip install 'gripmap[objects]'")
    for url, store, field in [
        ("ftp://elsewhere/folder", {}, "archive.copy"),
        ("s3://", {}, "archive.copy"),
        ("s3://bucket", {"endpiont": SECRET}, "archive.store"),
    ]:
        with pytest.raises(InputError) as raised:
            BucketReplica(tmp_path, url, store)
        assert raised.value.field == field
        assert SECRET not in str(raised.value)
    monkeypatch.setitem(sys.modules, "obstore", None)
    with pytest.raises(InputError, match="obstore, which is not installed.*\\[objects\\]"):
        BucketReplica(tmp_path, "s3://bucket", {})


def test_bucket_works_by_environment_alone_and_errors_are_stable_lines(
    bucket: BucketServer, monkeypatch: pytest.MonkeyPatch
) -> None:
    for name, value in bucket.store.items():
        monkeypatch.setenv(f"AWS_{name.upper()}", value)
    copy = ObjectBucket(bucket.url, {}, 5.0)
    copy.put("some/thing", b"1")
    assert copy.get("some/thing") == b"1"
    bucket.stop()
    lines = set()
    for _ in range(3):
        with pytest.raises(CopyError) as raised:
            copy.list_names("some")
        lines.add(str(raised.value))
    assert len(lines) == 1


def test_a_folder_alone_is_an_archive_and_secrets_do_not_show(tmp_path: Path) -> None:
    (path := tmp_path / "service.json").write_text('{"archive": "here"}')
    assert load_config(path, ServiceConfig).archive.path == Path("here")
    settings = {"path": "here", "copy": "s3://b/c", "store": {"secret_access_key": SECRET}}
    path.write_text(json.dumps({"archive": settings}))
    config = load_config(path, ServiceConfig)
    assert (config.archive.second, config.archive.options) == (
        "s3://b/c",
        {"secret_access_key": SECRET},
    )
    assert SECRET not in repr(config)
    again = ServiceConfig.model_validate_json(config.model_dump_json())
    assert again.archive.second == "s3://b/c", "what is written can be read"
    path.write_text(json.dumps({"archive": {"store": {"secret_access_key": [SECRET]}}}))
    with pytest.raises(InputError) as raised:
        load_config(path, ServiceConfig)
    assert SECRET not in str(raised.value)


def test_a_journal_of_a_long_run_is_rewritten_and_loses_no_entry(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(upload_journal, "SPARE_LINES", 10)
    journal = UploadJournal(tmp_path, "s3://copy")
    path = tmp_path / upload_journal.NAME
    journal.add("old", Stamp(1, 1))
    for number in range(100):
        journal.add(f"{number}", Stamp(number, number))
        journal.remove(f"{number - 1}")
        journal.sync()
        assert len(path.read_text().splitlines()) <= 1 + 2 * 2 + 10
    with monkeypatch.context() as full:
        full.setattr(upload_journal, "SPARE_LINES", -100)
        full.setattr(upload_journal, "open_durably", fail_to_open)
        with pytest.raises(OSError, match="disk"):
            journal.sync()
    with ThreadPoolExecutor() as threads:
        for number in range(100, 400):
            threads.submit(journal.add, f"{number}", Stamp(number, number))
            threads.submit(journal.remove, "99")
            journal.sync()
    journal.close()
    kept = {"old", *map(str, range(100, 400))}
    with closing(UploadJournal(tmp_path, "s3://copy")) as again:
        assert again.copy_stamps().keys() == kept


def fail_to_open(_: Path) -> BinaryIO:
    raise OSError("disk is full")


def test_failed_download_leaves_no_other_running(
    bucket: BucketServer, make: Make, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A running download would write the draft of the same file as the next attempt."""
    fill_log(tmp_path / "archive", make(tmp_path / "archive"), range(1)).close()
    goes_on = threading.Event()
    begun: list[str] = []
    ended: list[str] = []
    parts_of = ObjectBucket.read_parts

    def read_parts(store: ObjectBucket, name: str) -> Iterator[bytes]:
        if name.startswith("keys/"):
            until(lambda: len(begun) == len(Kind))
            raise CopyError("the connection was reset")
        begun.append(name)
        goes_on.wait()
        yield from parts_of(store, name)
        ended.append(name)

    def wait_for_others(downloads: list[Future[None]], return_when: str = ALL_COMPLETED) -> None:
        if return_when == ALL_COMPLETED:
            goes_on.set()
        wait(downloads, return_when=return_when)

    monkeypatch.setattr(ObjectBucket, "read_parts", read_parts)
    monkeypatch.setattr(file_transfer, "wait", wait_for_others)
    (tmp_path / "new").mkdir()
    with (
        closing(BucketReplica(tmp_path / "new", bucket.url, bucket.store)) as new,
        pytest.raises(CopyError, match="reset"),
    ):
        new.prefetch()
    assert sorted(ended) == sorted(begun)
