"""Bucket replica of an archive: the same files under the same names.

Files on which an acknowledgement depends are segments (files of new rows), keys and vehicle
identities. They are uploaded before the acknowledgement (`upload_segments`). All other files follow
later (`sync`). Uploads come first and deletions last, so that the bucket contains every row at
least once at any time. At start (`sync_without_lease`), files that only the bucket has are
downloaded, and files that only the folder has are uploaded. An object is deleted only if the
upload journal (list of own uploads) contains it.
"""

from __future__ import annotations

import json
import time
from collections.abc import Iterable, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import suppress
from pathlib import Path
from threading import Lock
from typing import Final, NamedTuple

from fleet_service.replication.bucket import CopyError, ObjectBucket, unusable_copy
from fleet_service.replication.fence import Term, largest_epoch
from fleet_service.replication.fenced_bucket import FencedBucket
from fleet_service.replication.file_transfer import FileTransfer
from fleet_service.replication.replica_files import KEYS, LOG, MANIFEST, ReplicaFiles
from fleet_service.replication.upload_backoff import UploadBackoff
from fleet_service.replication.upload_journal import UploadJournal
from schemas.config import ServiceConfig
from schemas.errors import InputError

OWNER: Final = "service.json"
# [s] Time limit of a request on which an acknowledgement depends. The worker may wait as long.
QUICK_S: Final = 5.0
SLOW_S: Final = 300.0  # [s] limit of other requests: compacted files have tens of megabytes
# [s] Longest time of one call of `upload_segments`, so that it can report its progress.
TURN_S: Final = 20.0
_AT_ONCE: Final = 8  # number of concurrent requests


class _Uploaded(NamedTuple):
    """Result of an upload: number of changed objects. `is_complete` is False if a listed file was
    removed before its upload; the file that replaces it may then be missing from the bucket.
    """

    changed: int
    is_complete: bool


class BucketReplica:
    """Copy of one archive in a bucket (object store); call `upload_segments` from one thread and
    `sync` from another.

    Args:
        root: folder of the archive.
        url: address of the copy.
        options: options of the object store, see `ObjectBucket`.

    Raises:
        InputError: the URL or an option cannot be used, or obstore is not installed.
        OSError: the journal (list of uploaded files) cannot be read or written.

    Attributes:
        bucket: the bucket under the lease and the fence (list of valid objects) of its owner.
        backoff: failures of `upload_segments`, and the pauses after them.
    """

    def __init__(self, root: Path, url: str, options: Mapping[str, str]) -> None:
        self._url = url
        self._files = ReplicaFiles(root)
        self._quick = ObjectBucket(url, options, QUICK_S)
        self._slow = ObjectBucket(url, options, SLOW_S)
        self._journal = UploadJournal(root, url)
        self._following = Lock()
        self._pool = ThreadPoolExecutor(_AT_ONCE, "copy")
        self.bucket = FencedBucket(self._slow)
        self.backoff = UploadBackoff(url)
        self._transfer = FileTransfer(self._files, self.bucket, self._journal, self._pool)

    def close(self) -> None:
        """Close the archive's bucket replica; the bucket is not changed."""
        self._pool.shutdown(cancel_futures=True)
        self._journal.close()

    def sync_without_lease(self, service: str) -> int:
        """Synchronise the archive's folder and the bucket in both directions; return the number of
        downloaded files. No other process may use the archive meanwhile.

        Raises:
            InputError: the bucket cannot be reached, or belongs to another service.
            OSError: the folder cannot be read or written.
        """
        try:
            return self.sync_under_lease(service)
        except CopyError as error:
            raise unusable_copy(self._url, error) from error

    def sync_under_lease(
        self, service: str | None, term: Term | None = None, *, succeeds: bool = False
    ) -> int:
        """Synchronise folder and bucket like `sync_without_lease`, but under the `term` of a lease
        (ownership): files that a former holder of the lease uploads later are ignored.

        Args:
            service: name of the service. The bucket must belong to this name, or to no service yet.
                None skips this check, because a standby (waiting service) takes over the bucket of
                a service with another name.
            term: lease number and epoch (number in file names); None without a lease.
            succeeds: True if another machine had the lease before. Data that only this folder has
                were then never acknowledged and are removed.

        Raises:
            InputError: the bucket belongs to another service.
            CopyError: the bucket cannot be reached; the call may be repeated.
            OSError: the folder cannot be read or written.
        """
        if service is not None:
            self._claim_bucket(service)
        remote_sizes = self.bucket.list_valid()
        if succeeds:
            self._remove_unlisted(remote_sizes)
        got = self._transfer.download_missing(remote_sizes)
        self._upload_changes(with_log=True)
        if term is not None:
            self.bucket.raise_fence(term, self._files.list_files())
        return got

    def largest_epoch(self) -> int:
        """Return the largest epoch (number of an owner's term) in the file names of folder and
        bucket, or 0.

        Raises:
            CopyError: the bucket cannot be listed.
        """
        return max(largest_epoch(self._slow.list_sizes()), largest_epoch(self._files.list_files()))

    def prefetch(self) -> None:
        """Download files that a later `sync_under_lease` will need, and remove those that the
        bucket no longer has. A standby calls this in advance, while another service still owns the
        bucket.

        Raises:
            CopyError, OSError: the download is incomplete, for example because the owner's
                compaction has removed files meanwhile.
        """
        remote_sizes = self.bucket.list_valid()
        for name in self._journal.copy_stamps().keys() - remote_sizes.keys():
            self._files.path_of(name).unlink(missing_ok=True)
        self._transfer.download_missing(remote_sizes)

    def _remove_unlisted(self, remote_sizes: Mapping[str, int]) -> None:
        """Remove files of the archive's folder that the bucket does not contain with the same size.
        `remote_sizes` has names and sizes of the bucket's valid objects. Then remove the journal
        entries of all files that the folder does not contain.

        Files of the folder `keys` are always removed, and so downloaded again: two secret keys of
        one month have the same name and size, and only the bucket's belongs to valid rows.
        """
        for name, stamp in self._files.list_files().items():
            if remote_sizes.get(name) != stamp.size or name.startswith(KEYS):
                self._files.path_of(name).unlink()
        for name in self._journal.copy_stamps():
            if not self._files.path_of(name).exists():
                self._journal.remove(name)

    def upload_segments(self, segments: Iterable[Path]) -> None:
        """Upload written segments, and the files of the folder `keys` that are new or have changed.
        These contain the secret keys for pseudonyms, and vehicle identities. All of them are in the
        bucket when this returns.

        Raises:
            CopyError: some files are not in the bucket; the next call continues and uploads no file
                twice. After a failure there is a pause, which grows with each further failure.
        """
        with self.backoff.try_upload():
            missing = [
                path
                for path in segments
                if self._journal.find_stamp(self._files.name_of(path)) is None
            ]
            key_files = self._files.list_files(("keys",))
            keys = [
                self._files.path_of(name)
                for name, stamp in key_files.items()
                if self._journal.find_stamp(name) != stamp
            ]
            self._upload_in_time([*keys, *missing])

    def sync(self) -> int:
        """Upload new and rewritten files of the archive to the bucket, then delete removed ones;
        return the number of changed objects.

        Segments in the inbox folder are excluded; only `upload_segments` uploads them.

        Raises:
            CopyError: the work is incomplete; the next call continues.
            OSError: the journal cannot be written.
        """
        return self._upload_changes(with_log=False).changed

    def _upload_in_time(self, paths: Sequence[Path]) -> None:
        deadline = time.monotonic() + TURN_S
        for first in range(0, len(paths), _AT_ONCE):
            if time.monotonic() > deadline:
                raise CopyError(f"{len(paths) - first} segments are not uploaded yet")
            batch = paths[first : first + _AT_ONCE]
            try:
                if len(batch) == 1:
                    self._upload_quickly(batch[0])
                else:
                    list(self._pool.map(self._upload_quickly, batch))
            # Compaction has moved the rows of a segment into files that are uploaded later.
            except FileNotFoundError:
                if not self._upload_changes(with_log=True).is_complete:
                    raise CopyError("the archive was compacted during the upload") from None
                return

    def _upload_quickly(self, path: Path) -> None:
        self._transfer.upload_file(path, self._quick)

    def _upload_changes(self, *, with_log: bool) -> _Uploaded:
        if not self.bucket.may_write():
            raise CopyError("this service may have lost the lease")
        if not self._following.acquire(timeout=QUICK_S):
            raise CopyError("compacted files are being uploaded")
        try:
            # Copy the journal before the files are listed, so that a new file does not count as
            # deleted.
            known = self._journal.copy_stamps()
            local = self._files.list_files()
            new = [
                name
                for name, stamp in local.items()
                if known.get(name) != stamp and (with_log or not name.startswith(LOG))
            ]
            new.sort(key=lambda name: name.endswith(MANIFEST))
            vanished = [name for name in new if not self._transfer.upload_if_present(name)]
            removed = [
                name
                for name in known
                if not (vanished or name in local or self._files.set_aside_path(name).exists())
            ]
            removed.sort(key=lambda name: not name.endswith(MANIFEST))
            self.bucket.admit_objects(new)
            if removed:
                # Without the lease, this could delete objects that the next owner needs.
                self.bucket.require_lease()
            for name in removed:
                self._slow.delete(name)
                self._journal.remove(name)
            self._journal.sync()
            return _Uploaded(len(new) - len(vanished) + len(removed), not vanished)
        finally:
            self._following.release()

    def _claim_bucket(self, service: str) -> None:
        own = json.dumps({"service": service}).encode()
        owner = self._slow.get(OWNER)
        if owner is None:
            self._slow.put_new(OWNER, own)
        elif owner != own:
            with suppress(ValueError, KeyError, TypeError):
                owner = str(json.loads(owner)["service"]).encode()
            problem = (
                f"{self._url} is the copy of another service, {owner.decode(errors='replace')[:60]}"
            )
            raise InputError(
                "archive.copy", problem, "give each service its own folder in the bucket"
            )


def open_replica(config: ServiceConfig, root: Path) -> BucketReplica | None:
    """Open the bucket replica (copy of the archive in an object store) named in the configuration
    and synchronise it with the folder `root`; return None if the configuration names no replica.

    Raises:
        InputError: the address or an option cannot be used, or the bucket cannot be reached or
            belongs to another service.
        OSError: the folder or the journal cannot be read or written.
    """
    archive = config.archive
    if archive.second is None:
        return None
    copy = BucketReplica(root, archive.second, archive.options)
    try:
        copy.sync_without_lease(config.name)
    except BaseException:
        copy.close()
        raise
    return copy
