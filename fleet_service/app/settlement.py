"""Settlement of admitted batches (messages with records). First, their rows are written to disk as
segments (files of new rows). If the archive has a copy in a bucket (object store), the segments are
also uploaded to this bucket. Only then are the batches acknowledged.
"""

from __future__ import annotations

import math
import threading
from collections.abc import Callable
from typing import Final, TypeVar

from fleet_service.app.intake import Intake
from fleet_service.app.state import SharedState
from fleet_service.app.tasks import Tasks
from fleet_service.archive.format.layout import Cut
from fleet_service.archive.segment_log import SegmentLog
from fleet_service.counts import ServiceCounts
from fleet_service.ingest.dedup import BatchId
from fleet_service.replication.bucket import CopyError
from fleet_service.replication.ownership import Ownership

# Largest number of rows that wait for the disk. Above it, the service takes no message from the
# queue until a segment is written.
WAITING_ROWS: Final = 1_000_000
# Largest number of batches that are on disk but not yet in the bucket: 100 MB.
WAITING_BATCHES: Final = 1_000_000
# [s] Shortest time between the beginnings of two segments. Writing a segment takes 3 ms, and
# reading it at a restart 1.4 ms. With .1 s, a restart would read segments since the last checkpoint
# for 4 s.
LEAST_S: Final = 0.25
WRITE_SHARE: Final = 0.25  # largest share of the time in which segments are written
T = TypeVar("T")


class Settlement:
    """Writing of segments, and the acknowledgements that follow; used by the worker (the thread
    that processes messages).

    Args:
        shared: state of the service.
        intake: owner of the waiting acknowledgements.
        log: segment log (queue) with the rows that wait for the disk.
        holding: ownership of the archive.
        counts: counts of the service.

    Attributes:
        failing: reason why the last segment was not stored, or not copied; else empty.
    """

    def __init__(
        self,
        shared: SharedState,
        intake: Intake,
        log: SegmentLog[BatchId],
        holding: Ownership,
        counts: ServiceCounts,
    ) -> None:
        self._shared = shared
        self._intake = intake
        self._log = log
        self._holding = holding
        self._counts = counts
        self._tasks = Tasks()
        self.failing = ""

    @property
    def is_full(self) -> bool:
        """Return True if the service must not accept more messages for now. Either too many rows
        wait to be written to disk, or too many batches wait to be uploaded to the archive's copy in
        a bucket.
        """
        return self._log.rows >= WAITING_ROWS or self._log.unsettled >= WAITING_BATCHES

    @property
    def unsettled(self) -> int:
        """Return the number of admitted batches that are not on disk yet."""
        return self._log.unsettled

    @property
    def hangs_s(self) -> float:
        """Return the time [s] since the current writing of a segment began; 0 if none is being
        written.
        """
        return self._log.hangs_s

    def until_early_s(self, now_s: float) -> float:
        """Return the time [s] until the waiting rows may be written to disk early, that is, before
        the regular period (setting `segment_s`) ends. Early writing shortens the time until the
        senders receive an acknowledgement.

        At most the share WRITE_SHARE of the time is spent on writing, so a slow write delays the
        next early write. The result is infinite if no rows wait, if a write is running, or if the
        last write failed. `now_s` is the monotonic time [s].
        """
        if self.failing or not self._log.can_begin:
            return math.inf
        return max(
            self._log.begun_s + max(LEAST_S, self._log.write_s / WRITE_SHARE) - now_s,
            0.0,
        )

    def call_when_written(self, wake: Callable[[], None]) -> None:
        """Register the function `wake`. Another thread calls it whenever the writing of a segment
        has ended.
        """
        self._log.on_written = wake

    @property
    def newest_segment(self) -> Cut:
        """Return the position (epoch and number) of the last written segment."""
        return self._log.newest

    def run_between_segments(self, work: Callable[[], T], stop: threading.Event) -> T | None:
        """Let the worker run `work` directly after a segment, when all rows that the service
        accepted are on disk. Return the result of `work`, or None if `stop` is set meanwhile. Other
        threads call this.

        Raises:
            OSError: no segment could be written for too long.
        """
        return self._tasks.run_on_worker(work, stop)

    def flush(self) -> list[tuple[str, bytes]]:
        """Write the waiting rows as durable segments; return (vehicle, bytes) of each
        acknowledgement to send.

        If the disk is full, the failure is counted, nothing is acknowledged, and the next call
        tries again.
        """
        acks = self._acknowledge(self._log.flush)
        if not self.failing:
            self._tasks.run_queued()
        return acks

    def begin_flush(self) -> list[tuple[str, bytes]]:
        """Begin to write the waiting rows; messages may be processed meanwhile. `end_flush` returns
        the acknowledgements.

        If a function waits in `run_between_segments`, do a complete `flush` and return its
        acknowledgements.
        """
        if self._tasks:
            return self.flush()
        self._log.begin()
        return []

    def end_flush(self) -> list[tuple[str, bytes]]:
        """Return the acknowledgements of a flush (writing of rows to disk) that has ended; empty if
        no flush has ended.
        """
        return self._acknowledge(self._log.end) if self._log.ended else []

    def _acknowledge(self, durable: Callable[[], list[BatchId]]) -> list[tuple[str, bytes]]:
        try:
            self._intake.batches.sync()
            self._intake.batches.acknowledge(durable())
        except OSError as error:
            if isinstance(error, CopyError) and self._holding.copy is not None:
                self._counts.failures["copy"] = self._holding.copy.backoff.failures
            else:
                self._counts.failures["segment"] += 1
            self.failing = error.strerror or str(error) or type(error).__name__
        else:
            self.failing = ""
            self._shared.tiles.acknowledge()
        return self._intake.acks.messages(self._intake.now) if self._holding.may_acknowledge else []

    def close(self) -> None:
        """Stop the thread that writes segments."""
        self._log.close()
