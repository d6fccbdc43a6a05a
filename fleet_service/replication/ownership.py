"""Exclusive ownership of an archive by a running service: of the folder by a file lock, and of the
bucket copy, if any, by a lease (ownership limited in time).
"""

from __future__ import annotations

import math
import threading
from collections.abc import Callable
from contextlib import nullcontext
from functools import partial
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
        holding = _acquire_under_lease(config, root, stop, log_line, signs, lock_file)
    except BaseException:
        lock_file.close()
        raise
    if holding is None:
        lock_file.close()
    return holding


def _acquire_under_lease(
    config: ServiceConfig,
    root: Path,
    stop: threading.Event,
    log_line: Callable[[str], None],
    signs: Signs | None,
    lock_file: BinaryIO,
) -> Ownership | None:
    url = str(config.archive.second)
    options = config.archive.options
    empty = not any((root / folder).exists() for folder in FOLDERS)
    holder, known = holder_of(root, url)
    bucket = ObjectBucket(url, options, config.lease_s / REQUESTS, retries=0)
    lease = Lease(holder, bucket, config.name, config.lease_s)
    copy = BucketReplica(root, url, options)
    mirrors = empty or known

    def prefetch() -> None:
        if mirrors:
            copy.prefetch()
            save_holder(root, url, holder)  # shows that the disk has space, which a take-over needs

    def join() -> bool:
        is_joined = _sync_folder(config, root, copy, lease, stop, log_line)
        if is_joined:
            save_holder(root, url, lease.holder)
            layout.write_epoch(root, lease.term.epoch)
        return is_joined

    standby = None if signs is None else Standby(*signs, lambda: _try_on_disk(prefetch)[1])
    try:
        while lease.wait(stop, log_line, copy.largest_epoch, standby):
            lease.start_renewal()
            if lease.succeeds and not mirrors:
                raise InputError(
                    "archive.path",
                    f"{root} is not the archive of {url}",
                    "give the service an empty folder",
                )
            copy.bucket.attach_lease(partial(_may_acknowledge, lease), lease.assert_not_superseded)
            is_joined, problem = (join(), "") if standby is None else _try_on_disk(join)
            if is_joined:
                return Ownership(lock_file, copy, lease)
            lease.release()
            if not (lease.lost or problem):
                break
            lease = lease.make_new_lease()
            lease.problem = problem
    except CopyError as error:
        _release_and_close(lease, copy)
        raise unusable_copy(url, error) from error
    except BaseException:
        _release_and_close(lease, copy)
        raise
    _release_and_close(lease, copy)
    return None


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


def _may_acknowledge(lease: Lease) -> bool:
    return lease.may_acknowledge


def _release_and_close(lease: Lease, copy: BucketReplica) -> None:
    lease.release()
    copy.close()


def _sync_folder(
    config: ServiceConfig,
    root: Path,
    copy: BucketReplica,
    lease: Lease,
    stop: threading.Event,
    log_line: Callable[[str], None],
) -> bool:
    """Synchronise the archive's folder with its copy in the bucket. Return False if `stop` is set,
    or if another service has the lease. A standby (waiting) service retries while the bucket cannot
    be reached.
    """
    logged = ""
    while not stop.is_set():
        try:
            with _wait_for_compaction(root) if lease.succeeds else nullcontext():
                copy.sync_under_lease(
                    None if config.standby else config.name, lease.term, succeeds=lease.succeeds
                )
        except (CopyError, _BusyError) as error:
            if lease.lost:
                return False
            if isinstance(error, CopyError) and not config.standby:
                raise
            if str(error) != logged:
                log_line(f"waiting: {error}")
                logged = str(error)
            stop.wait(AGAIN_S)
        else:
            return True
    return False


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
