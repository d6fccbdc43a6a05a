"""Exclusive ownership of an archive by a running service: of the folder by a file lock, and of the
bucket copy, if any, by a lease (ownership limited in time).
"""

from __future__ import annotations

import math
import threading
from collections.abc import Callable
from contextlib import nullcontext
from pathlib import Path
from typing import BinaryIO, Final, TypeVar

from fleet_service.archive.format import layout
from fleet_service.archive.format.files import lock_archive
from fleet_service.archive.maintenance import compaction
from fleet_service.replication.bucket import CopyError, ObjectBucket, unusable_copy
from fleet_service.replication.folder_identity import forget_holder, holder_of, save_holder
from fleet_service.replication.lease import Lease, Standby
from fleet_service.replication.replica import BucketReplica, open_replica
from fleet_service.replication.replica_files import FOLDERS
from schemas.config import ServiceConfig
from schemas.errors import InputError

AGAIN_S: Final = 1.0  # [s] pause between attempts to reach the bucket
REQUESTS: Final = 4  # number of requests that fit into one lease time
T = TypeVar("T")


class Ownership:
    """Exclusive ownership of an archive folder and its bucket copy; call `close` at the end.

    Attributes:
        copy: bucket copy of the archive; None without one.
        lease: lease of the copy; None if no other service must be excluded.
        to: name of the standby (waiting service) that takes over when this service stops; "" for
            none.
        leaves: True once this service is ready to hand the archive over to `to`.
    """

    def __init__(
        self, lock_file: BinaryIO, copy: BucketReplica | None, lease: Lease | None = None
    ) -> None:
        self._lock_file = lock_file
        self.copy = copy
        self.lease = lease
        self.to = ""
        self.leaves = False

    @property
    def smallest_epoch(self) -> int:
        """Return the smallest epoch (number in file names) that this owner may use in the names of
        new segments (files of new rows).
        """
        return 0 if self.lease is None else self.lease.term.epoch

    @property
    def may_acknowledge(self) -> bool:
        """Return True if the service may acknowledge data: the next owner of the archive will find
        all data that are on disk and in the bucket now.
        """
        return self.lease is None or self.lease.may_acknowledge

    @property
    def left_s(self) -> float:
        """Return the time [s] for which the service may acknowledge without renewing its lease
        (ownership of the archive's copy); infinite without a lease.
        """
        return math.inf if self.lease is None else self.lease.left_s

    @property
    def is_lost(self) -> bool:
        """Return True if another service has taken over the archive."""
        return self.lease is not None and self.lease.lost

    @property
    def all_holders(self) -> tuple[str, ...]:
        """Return the names of this and all earlier holders of the lease; empty without a lease."""
        return () if self.lease is None else (*self.lease.former_holders, self.lease.service)

    def mark_lost(self) -> None:
        """Record that another service has taken over; the caller knows this from the other
        service's liveliness tokens (signs in Zenoh that it is alive).
        """
        if self.lease is not None:
            self.lease.lost = True

    def release(self) -> None:
        """Release the lease of the archive's copy, if any; the service may acknowledge nothing
        afterwards.
        """
        if self.lease is not None:
            self.lease.release(self.to if self.leaves else "")

    def close(self) -> None:
        """Release the lease (ownership of the bucket copy), and the file lock of the folder."""
        self.release()
        if self.copy is not None:
            self.copy.close()
        self._lock_file.close()


def open_exclusive(config: ServiceConfig, root: Path) -> Ownership:
    """Lock an archive that is used without a lease (ownership in a bucket), and synchronise it with
    its copy, if any.

    Raises:
        InputError: another service has the archive, or its copy cannot be used.
        OSError: the folder cannot be read or written.
    """
    lock_file = lock_archive(root)
    try:
        forget_holder(root)
        return Ownership(lock_file, open_replica(config, root))
    except BaseException:
        lock_file.close()
        raise


# result of `serving.standby_signs`
Signs = tuple[Callable[[], bool], Callable[[str], bool], Callable[[], None]]


def acquire_archive(
    config: ServiceConfig,
    root: Path,
    stop: threading.Event,
    log_line: Callable[[str], None],
    signs: Signs | None = None,
) -> Ownership | None:
    """Lock an archive and, if it has a copy, wait for the lease of the copy. Return the ownership
    of both, or None if `stop` is set first.

    Args:
        config: settings.
        root: folder of the archive.
        stop: event that ends the wait.
        log_line: called with a line of text whenever the reason for waiting changes.
        signs: three functions of a standby (waiting) service, from `serving.standby_signs`; None if
            this service is no standby. The first returns True if a router is reachable. The second
            returns True if the service with the given name is alive. The third is called at each
            check of the lease, so that a watchdog can detect a standby that hangs.

    Raises:
        InputError: another service has the folder or the copy, or the copy cannot be used with
            these settings.
        OSError: the folder cannot be read or written.
    """
    url = config.archive.second
    if url is None:
        if signs is not None:
            raise InputError(
                "standby",
                "needs archive.copy",
                "set archive.copy to the bucket of the active service",
            )
        return open_exclusive(config, root)
    lock_file = lock_archive(root)
    try:
        holding = _Candidate(config, root, stop, log_line).acquire(lock_file, signs)
    except BaseException:
        lock_file.close()
        raise
    if holding is None:
        lock_file.close()
    return holding


class _Candidate:
    """Service that waits for the lease of an archive's bucket copy."""

    def __init__(
        self,
        config: ServiceConfig,
        root: Path,
        stop: threading.Event,
        log_line: Callable[[str], None],
    ) -> None:
        self._config = config
        self._root = root
        self._stop = stop
        self._log_line = log_line
        self._url = str(config.archive.second)
        options = config.archive.options
        is_empty = not any((root / folder).exists() for folder in FOLDERS)
        self._holder, is_known = holder_of(root, self._url)
        self._mirrors = is_empty or is_known  # True if the folder may receive the copy's files
        bucket = ObjectBucket(self._url, options, config.lease_s / REQUESTS, retries=0)
        self._lease = Lease(self._holder, bucket, config.name, config.lease_s)
        self._copy = BucketReplica(root, self._url, options)

    def acquire(self, lock_file: BinaryIO, signs: Signs | None) -> Ownership | None:
        """Wait for the lease and synchronise the folder with the copy. Return the ownership, or
        None if the wait was stopped.

        Raises:
            InputError: the folder belongs to another archive, or the copy cannot be used.
            OSError: the folder cannot be read or written.
        """
        standby = None
        if signs is not None:
            standby = Standby(*signs, lambda: _try_on_disk(self._prefetch)[1])
        try:
            while self._lease.wait(self._stop, self._log_line, self._copy.largest_epoch, standby):
                is_joined, problem = self._take_over(standby)
                if is_joined:
                    return Ownership(lock_file, self._copy, self._lease)
                self._lease.release()
                if not (self._lease.lost or problem):
                    break
                self._lease = self._lease.make_new_lease()
                self._lease.problem = problem
        except CopyError as error:
            self._close()
            raise unusable_copy(self._url, error) from error
        except BaseException:
            self._close()
            raise
        self._close()
        return None

    def _take_over(self, standby: Standby | None) -> tuple[bool | None, str]:
        """Synchronise the folder with the copy under the lease that this service now has. Return
        True if the folder is synchronised, and the problem of a standby's disk, "" for none.
        """
        lease = self._lease
        lease.start_renewal()
        if lease.succeeds and not self._mirrors:
            raise InputError(
                "archive.path",
                f"{self._root} is not the archive of {self._url}",
                "give the service an empty folder",
            )
        self._copy.bucket.attach_lease(lambda: lease.may_acknowledge, lease.assert_not_superseded)
        return (self._join(), "") if standby is None else _try_on_disk(self._join)

    def _prefetch(self) -> None:
        """Copy files that a take-over will need. Saving the holder shows that the disk has space,
        which a take-over needs.
        """
        if self._mirrors:
            self._copy.prefetch()
            save_holder(self._root, self._url, self._holder)

    def _join(self) -> bool:
        is_joined = self._sync_folder()
        if is_joined:
            save_holder(self._root, self._url, self._lease.holder)
            layout.write_epoch(self._root, self._lease.term.epoch)
        return is_joined

    def _sync_folder(self) -> bool:
        """Synchronise the archive's folder with its copy in the bucket. Return False if the wait is
        stopped, or if another service has the lease. A standby (waiting) service retries while the
        bucket cannot be reached.
        """
        lease = self._lease
        owner = None if self._config.standby else self._config.name
        logged = ""
        while not self._stop.is_set():
            try:
                with _wait_for_compaction(self._root) if lease.succeeds else nullcontext():
                    self._copy.sync_under_lease(owner, lease.term, succeeds=lease.succeeds)
            except (CopyError, _BusyError) as error:
                if lease.lost:
                    return False
                if isinstance(error, CopyError) and not self._config.standby:
                    raise
                if str(error) != logged:
                    self._log_line(f"waiting: {error}")
                    logged = str(error)
                self._stop.wait(AGAIN_S)
            else:
                return True
        return False

    def _close(self) -> None:
        self._lease.release()
        self._copy.close()


def _try_on_disk(work: Callable[[], T]) -> tuple[T | None, str]:
    """Let a standby (waiting service) do work that writes to its disk. Return the result of the
    work and an empty text, or None and the problem if the disk does not accept the files.

    Raises:
        CopyError: the bucket does not answer.
    """
    try:
        return work(), ""
    except CopyError:
        raise
    except OSError as error:
        reason = error.strerror or error
        return None, f"cannot store the files of the archive on this disk ({reason})"


class _BusyError(Exception):
    """Error: another process is using the compacted (merged) files of the archive folder."""


def _wait_for_compaction(root: Path) -> BinaryIO:
    """Lock the compacted (merged) files of the archive's folder. This fails while a compaction by
    the folder's former service is running, because it may have read rows that are no longer valid.

    Raises:
        _BusyError: such a compaction is running; try again later.
    """
    try:
        return compaction.lock_compacted(root)
    except InputError as error:
        raise _BusyError(str(error)) from error
