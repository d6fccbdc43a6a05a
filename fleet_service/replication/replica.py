"""Bucket replica of an archive: the same files under the same names.

Files on which an acknowledgement depends (segments, keys, vehicle identities) are uploaded before
the acknowledgement (`upload_segments`). All other files follow later (`sync`). Uploads come first
and deletions last, so that the copy contains every row at least once at any time. At start
(`sync_without_lease`), files that only the bucket has are downloaded (all files, if the disk is
empty), and files that only the folder has are uploaded. An object is deleted only if the upload
journal (list of own uploads) contains it.
"""

from __future__ import annotations

import json
import time
from collections.abc import Callable, Iterable, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import suppress
from pathlib import Path
from threading import Lock
from typing import Final

from fleet_service.archive.format import layout
from fleet_service.archive.format.files import sync_tree
from fleet_service.archive.format.layout import CHECKPOINTS
from fleet_service.archive.format.load import BAD
from fleet_service.replication.bucket import CopyError, ObjectBucket
from fleet_service.replication.fence import Fence, Term, fence_of, largest_epoch, put_fence
from fleet_service.replication.upload_journal import Stamp, UploadJournal, stamp_of
from schemas.config import ServiceConfig
from schemas.errors import InputError
from schemas.runtime.durable import open_durably

LOG: Final = "inbox/"
KEYS: Final = "keys/"
# In this order they are looked through: compaction adds to the later ones before it takes from the
# log, and retention rolls up before it takes from the observations, so that what has gone from one
# is found in the next.
FOLDERS: Final = (
    "inbox",
    "observations",
    "states",
    "rollup",
    "map",
    "weather",
    CHECKPOINTS,
    "keys",
)
OWNER: Final = "service.json"
_LAST: Final = "manifest.json"  # of a checkpoint: without it the folder is none
_PRIVATE: Final = ("tried",)  # notes of this disk
# of one request that an acknowledgement waits for; the service's worker may wait as long
QUICK_S: Final = 5.0
SLOW_S: Final = 300.0  # of one that nobody waits for: a compacted file has tens of megabytes
TURN_S: Final = 20.0  # of `upload_segments`, which then says that it has come so far
BACK_OFF_S: Final = 0.5  # after the first failure; doubles
MOST_BACK_OFF_S: Final = 8.0
_AT_ONCE: Final = 8  # requests


class BucketReplica:
    """Copy of one archive; call `upload_segments` from one thread and `sync` from another.

    Args:
        root: folder of the archive.
        url: address of the copy.
        options: options of the object store, see `ObjectBucket`.

    Raises:
        InputError: the URL or an option cannot be used, or obstore is not installed.
        OSError: the journal cannot be read or written.

    Attributes:
        failures: number of failed requests of `upload_segments`.
    """

    def __init__(self, root: Path, url: str, options: Mapping[str, str]) -> None:
        self._root = root
        self._url = url
        self._quick = ObjectBucket(url, options, QUICK_S)
        self._slow = ObjectBucket(url, options, SLOW_S)
        self._copied = UploadJournal(root, url)
        self._following = Lock()
        self._pool = ThreadPoolExecutor(_AT_ONCE, "copy")
        self.failures = 0
        self._in_a_row = 0
        self._not_before = 0.0
        self._error = ""
        self._since: float | None = None
        self._may: Callable[[], bool] = lambda: True
        self._alone: Callable[[], None] | None = None
        self._term = Term(0, 0)
        self._fence = Fence(0, frozenset())
        self._turn = 0

    def close(self) -> None:
        """Close the replica; the bucket is not changed."""
        self._pool.shutdown(cancel_futures=True)
        self._copied.close()

    def attach_lease(self, may: Callable[[], bool], alone: Callable[[], None]) -> None:
        """From now on, write to the bucket only while this service has the lease.

        Args:
            may: function that returns True if this service certainly has the lease.
            alone: function that checks in the bucket that no later lease exists. It raises
                CopyError if one exists or the check fails.
        """
        self._may = may
        self._alone = alone

    @property
    def away_s(self) -> float:
        """Return the time [s] for which the bucket has not accepted data on which an
        acknowledgement depends; 0 if it accepts them.
        """
        since = self._since
        return 0.0 if since is None else time.monotonic() - since

    @property
    def trouble(self) -> str | None:
        """Return a message to the operator about failing uploads; None if there is no problem."""
        if self._since is None:
            return None
        waits = f"nothing is acknowledged for {self.away_s:.0f} s"
        return f"the copy at {self._url} does not accept segments, {waits}: {self._error}"

    def sync_without_lease(self, service: str) -> int:
        """Synchronise folder and bucket in both directions; return the number of downloaded files.
        No other process may use the archive meanwhile.

        Raises:
            InputError: the bucket cannot be reached, or belongs to another service.
            OSError: the folder cannot be read or written.
        """
        try:
            return self.sync_under_lease(service)
        except CopyError as error:
            fix = (
                "check the network, endpoint, region and credentials, "
                "then start again; no data are lost"
            )
            raise InputError(
                "archive.copy", f"{self._url} cannot be used ({error})", fix
            ) from error

    def sync_under_lease(
        self, service: str | None, term: Term | None = None, *, succeeds: bool = False
    ) -> int:
        """Synchronise like `sync_without_lease`, but under the `term` of a lease: files that a
        former holder of the lease uploads later are ignored.

        Args:
            service: name of the service; None for a standby, which follows the owner of the bucket.
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
        got = (
            self._mirror_bucket()
            if succeeds
            else self._download_missing(self._select_counted(self._slow.list_sizes()))
        )
        self._upload_changes(with_log=True)
        if term is not None:
            self._raise_fence(term)
        return got

    def largest_epoch(self) -> int:
        """Return the largest epoch (lease term) in the file names of folder and bucket, or 0.

        Raises:
            CopyError: the bucket cannot be listed.
        """
        return max(largest_epoch(self._slow.list_sizes()), largest_epoch(self._list_files(FOLDERS)))

    def prefetch(self) -> None:
        """Download files in advance, for a standby: those that a later `sync_under_lease` will
        need. Another service still owns the bucket.

        Raises:
            CopyError, OSError: the download is incomplete, because the owner's compaction may
                remove files meanwhile.
        """
        self._download_missing(self._select_counted(self._slow.list_sizes()))

    def _raise_fence(self, term: Term) -> None:
        """Write a fence (list of valid objects) for this term of ownership: objects that appear
        later are valid only if their names contain the epoch of the term. Delete objects that are
        not valid.
        """
        names = [
            name
            for name in self._list_files(FOLDERS)
            if (layout.term_of(name) or term.epoch) < term.epoch
        ]
        fence = Fence(term.epoch, frozenset(names))
        self._put_fence(term, fence)
        self._require_lease()
        for name in self._slow.list_sizes():
            if not fence.counts_object(name):  # no service writes this name again
                self._slow.delete(name)

    def _put_fence(self, term: Term, fence: Fence) -> None:
        self._turn += 1
        put_fence(self._slow, term.number, self._turn, fence)
        self._term = term
        self._fence = fence

    def _mirror_bucket(self) -> int:
        """Make the folder identical to the bucket; return the number of downloaded files."""
        there = self._select_counted(self._slow.list_sizes())
        for name, stamp in self._list_files(FOLDERS).items():
            if there.get(name) != stamp.size:
                (self._root / name).unlink()
        for name in self._copied.copy_stamps():
            if not (self._root / name).exists():
                self._copied.remove(name)
        return self._download_missing(there)

    def _select_counted(self, there: Mapping[str, int]) -> dict[str, int]:
        """Return names and sizes [bytes] of those objects in `there` that are valid according to
        the bucket's fence (list of valid objects).
        """
        fence = fence_of(self._slow)
        return {name: size for name, size in there.items() if fence.counts_object(name)}

    def upload_segments(self, segments: Iterable[Path]) -> None:
        """Upload written segments (files of new rows) and the keys; all of them are in the bucket
        when this returns.

        Raises:
            CopyError: some files are not in the bucket; the next call continues and uploads no file
                twice. After a failure there is a pause, which grows with each further failure.
        """
        if time.monotonic() < self._not_before:
            raise CopyError(f"the upload fails and is tried again: {self._error}")
        try:
            missing = [
                path
                for path in segments
                if self._copied.find_stamp(self._object_name(path)) is None
            ]
            own = self._list_files(("keys",))
            keys = [
                self._root / name
                for name, stamp in own.items()
                if self._copied.find_stamp(name) != stamp
            ]
            self._upload_in_time([*keys, *missing])
        except CopyError as error:
            self.failures += 1
            self._error = str(error)
            self._since = self._since or time.monotonic()
            self._not_before = time.monotonic() + min(
                BACK_OFF_S * 2.0**self._in_a_row, MOST_BACK_OFF_S
            )
            self._in_a_row = min(self._in_a_row + 1, 10)
            raise
        self._in_a_row = 0
        self._since = None

    def sync(self) -> int:
        """Upload new and rewritten files, then delete removed ones; return the number of changed
        objects.

        Segments (files of new rows) in the inbox folder are excluded; only `upload_segments`
        uploads them.

        Raises:
            CopyError: the work is incomplete; the next call continues.
            OSError: the journal cannot be written.
        """
        return self._upload_changes(with_log=False)

    def _upload_in_time(self, paths: Sequence[Path]) -> None:
        deadline = time.monotonic() + TURN_S
        for first in range(0, len(paths), _AT_ONCE):
            if time.monotonic() > deadline:
                raise CopyError(f"{len(paths) - first} segments are not uploaded yet")
            some = paths[first : first + _AT_ONCE]
            try:
                if len(some) == 1:
                    self._upload_file(some[0], self._quick)
                else:
                    list(self._pool.map(lambda path: self._upload_file(path, self._quick), some))
            except FileNotFoundError:  # compacted meanwhile: the rows are in files that follow
                self._upload_changes(with_log=True)
                return

    def _upload_changes(self, *, with_log: bool) -> int:
        if not self._may():
            raise CopyError("this service may have lost the lease")
        if not self._following.acquire(timeout=QUICK_S):
            raise CopyError("compacted files are being uploaded")
        try:
            known = (
                self._copied.copy_stamps()
            )  # before the files: what comes meanwhile is not taken for gone
            local = self._list_files(FOLDERS)
            new = [
                name
                for name, stamp in local.items()
                if known.get(name) != stamp and (with_log or not name.startswith(LOG))
            ]
            new.sort(key=lambda name: name.endswith(_LAST))
            vanished = [name for name in new if not self._upload_if_present(name)]
            removed = [
                name
                for name in known
                if not (vanished or name in local or self._set_aside_path(name).exists())
            ]
            removed.sort(key=lambda name: not name.endswith(_LAST))
            if strays := [
                name for name in new if not self._fence.counts_object(name)
            ]:  # compacted by who began before
                self._put_fence(
                    self._term, self._fence._replace(names=self._fence.names.union(strays))
                )
            if removed:
                # then whoever comes next finds all that was put until now, and misses none of what
                # goes
                self._require_lease()
            for name in removed:
                self._slow.delete(name)
                self._copied.remove(name)
            self._copied.sync()
            return len(new) - len(vanished) + len(removed)
        finally:
            self._following.release()

    def _upload_if_present(self, name: str) -> bool:
        """Upload a file; return False if the file has been removed meanwhile."""
        try:
            self._upload_file(self._root / name, self._slow)
        except FileNotFoundError:
            return False
        return True

    def _upload_file(self, path: Path, bucket: ObjectBucket) -> None:
        name = self._object_name(path)
        stamp = stamp_of(path)
        if self._copied.find_stamp(name) is None and (
            name.startswith(LOG) or name.endswith(".key")
        ):
            self._upload_new(name, path.read_bytes(), bucket)
        elif name.startswith(KEYS):
            bucket.put(
                name, path.read_bytes()
            )  # who the vehicles are grows meanwhile, and is then put again
        else:
            bucket.put(name, path)
        self._copied.add(name, stamp)

    def _upload_new(self, name: str, content: bytes, bucket: ObjectBucket) -> None:
        """Upload a file whose name must be new. The exception is a file of keys that a former
        service uploaded after it had lost its lease: it belongs to rows that are not valid, and is
        replaced.
        """
        if self._alone is None or name.startswith(LOG) or bucket.create(name, content):
            bucket.put_new(name, content)
        else:
            self._alone()
            bucket.put(name, content)

    def _require_lease(self) -> None:
        if self._alone is not None:
            self._alone()

    def _claim_bucket(self, service: str) -> None:
        mine = json.dumps({"service": service}).encode()
        there = self._slow.get(OWNER)
        if there is None:
            self._slow.put_new(OWNER, mine)
        elif there != mine:
            with suppress(ValueError, KeyError, TypeError):
                there = str(json.loads(there)["service"]).encode()
            problem = (
                f"{self._url} is the copy of another service, {there.decode(errors='replace')[:60]}"
            )
            raise InputError(
                "archive.copy", problem, "give each service its own folder in the bucket"
            )

    def _download_missing(self, there: Mapping[str, int]) -> int:
        """Download the files that only the bucket has; return their number. Also remove from the
        journal the entries of files that the bucket lacks.
        """
        local = self._list_files(FOLDERS)
        for name in self._copied.copy_stamps():
            if name not in there or (name in local and local[name].size != there[name]):
                self._copied.remove(name)
        known = self._copied.copy_stamps()
        whole = {name.rpartition("/")[0] for name in there if name.endswith(f"/{_LAST}")}
        wanted = [
            name
            for name in there
            if name not in local
            and _is_copied(name)
            and (name not in known or self._set_aside_path(name).exists())
            and (not name.startswith(CHECKPOINTS) or name.rpartition("/")[0] in whole)
        ]
        list(self._pool.map(self._download_file, wanted))
        paths = [self._root / name for name in wanted]
        sync_tree(self._root, {path.parent for path in paths})
        for name, path in zip(
            wanted, paths, strict=True
        ):  # only now: power loss would else make them look deleted
            self._copied.add(name, stamp_of(path))
            self._set_aside_path(name).unlink(missing_ok=True)
        return len(wanted)

    def _download_file(self, name: str) -> None:
        path = self._root / name
        secret = name.startswith(KEYS)
        path.parent.mkdir(mode=0o700 if secret else 0o777, parents=True, exist_ok=True)
        with open_durably(path, 0o600 if secret else None, named=False) as file:
            for part in self._slow.read_parts(name):
                file.write(part)

    def _object_name(self, path: Path) -> str:
        return path.relative_to(self._root).as_posix()

    def _set_aside_path(self, name: str) -> Path:
        return self._root / f"{name}{BAD}"

    def _list_files(self, folders: Iterable[str]) -> dict[str, Stamp]:
        """Return names and stamps (size and time) of the files that belong into the copy, in the
        order of the folders.
        """
        found: dict[str, Stamp] = {}
        paths = (path for one in folders for path in sorted((self._root / one).rglob("*")))
        for path in paths:
            name = self._object_name(path)
            if _is_copied(name):
                with suppress(FileNotFoundError):
                    if path.is_file():
                        found[name] = stamp_of(path)
        return found


def _is_copied(name: str) -> bool:
    """Return True if a file of this name belongs into the copy; drafts and damaged files do not."""
    folder, *rest = name.split("/")
    hidden = any(part.startswith(".") for part in rest)
    return (
        folder in FOLDERS
        and bool(rest)
        and not hidden
        and not name.endswith(BAD)
        and rest[-1] not in _PRIVATE
    )


def open_replica(config: ServiceConfig, root: Path) -> BucketReplica | None:
    """Open the bucket replica named in the configuration and synchronise it with the folder `root`;
    return None if the configuration names no replica.

    Raises:
        InputError, OSError: as for `BucketReplica` and its `sync_without_lease`.
    """
    wanted = config.archive
    if wanted.second is None:
        return None
    copy = BucketReplica(root, wanted.second, wanted.options)
    try:
        copy.sync_without_lease(config.name)
    except BaseException:
        copy.close()
        raise
    return copy
