"""Segment log: queue of admitted rows that a thread writes to disk as segments (Parquet files). A
batch (message with records) is acknowledged only after its rows are in a segment that is synced to
disk.

Messages can be processed while a segment is written. Only batches that `end` returns may be
acknowledged.
"""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from pathlib import Path
from typing import Generic, TypeVar

import numpy as np

from fleet_service.archive.format.layout import Cut
from fleet_service.archive.format.segments import Rows, Writer
from schemas.wire import Kind

Batch = TypeVar("Batch")
Upload = Callable[[Sequence[Path]], None]


class _Load(Generic[Batch]):
    """Load: rows that are written to disk together, by kind (observations or states), and the
    batches to which the rows belong.
    """

    def __init__(self) -> None:
        self.waiting: dict[Kind, list[Rows]] = {kind: [] for kind in Kind}
        self.batches: list[Batch] = []
        self.segments: list[Path] = []

    @property
    def rows(self) -> int:
        """Return how many rows of this load (rows that are written together) have not been written
        to disk yet.
        """
        return sum(len(part["row"]) for waiting in list(self.waiting.values()) for part in waiting)

    def take(self, other: _Load[Batch]) -> None:
        """Append the content of another load to this one. A load consists of rows that wait for the
        disk, their batches (messages), and segments (files of rows) that are already written.
        """
        for kind, waiting in other.waiting.items():
            self.waiting[kind] = self.waiting[kind] + waiting
        self.batches += other.batches

    def write(self, writer: Writer, upload: Upload | None) -> None:
        """Write one segment per kind that has waiting rows. Then make all segments (files of new
        rows) durable: on disk and, if `upload` is given, also in another storage.
        """
        try:
            for kind, waiting in self.waiting.items():
                if waiting:
                    rows = {
                        name: np.concatenate([part[name] for part in waiting])
                        for name in waiting[0]
                    }
                    self.segments.append(writer.write(kind, rows))
                    self.waiting[kind] = []
            writer.sync()
        finally:
            # A full disk must not stop the upload of segments that earlier attempts have written,
            # because compaction, which frees disk space, waits for it.
            if upload is not None:
                upload(self.segments)


class SegmentLog(Generic[Batch]):
    """Segment log of one run of one service. An internal thread writes to disk. All methods must be
    called from one other thread.

    Args:
        root: folder of the archive.
        shard: name of the service.
        upload: function that copies segments to another storage, such as a bucket (object store).
            If given, a batch is durable only when it is on disk and there.
        epoch: smallest allowed epoch, the number in segment names that increases with every start
            of a service. If services own the archive in turn by a lease, pass the epoch of the
            lease; without a lease pass 0.

    Attributes:
        on_written: called in the internal thread when a write has ended, successfully or not.
        begun_s: monotonic time [s] at which the newest write began; writes without rows are
            ignored.
        write_s: duration [s] of the newest completed write; writes without rows are ignored.
    """

    def __init__(
        self, root: Path, shard: str, upload: Upload | None = None, epoch: int = 0
    ) -> None:
        self._writer = Writer(root, shard, epoch)
        self._upload = upload
        self._next: _Load[Batch] = _Load()
        self._load: _Load[Batch] = _Load()  # rows and batches that are being written
        self._written: Future[None] | None = None
        self._began = 0.0
        self.begun_s = -math.inf
        self.write_s = 0.0
        self._thread = ThreadPoolExecutor(1, "segments")
        self.on_written: Callable[[], None] = lambda: None

    @property
    def newest(self) -> Cut:
        """Return the position of the last written segment in the sequence of all segments."""
        return self._writer.newest

    @property
    def hangs_s(self) -> float:
        """Return the time [s] since the current write began; 0 if no write is running."""
        return (
            0.0 if self._written is None or self._written.done() else time.monotonic() - self._began
        )

    @property
    def rows(self) -> int:
        """Return the number of accepted rows that are not yet durable on disk."""
        return self._next.rows + self._load.rows

    @property
    def unsettled(self) -> int:
        """Return the number of accepted batches that are not yet durable: written to disk and, if
        `upload` is given, also copied to the other storage.
        """
        return len(self._next.batches) + len(self._load.batches)

    @property
    def can_begin(self) -> bool:
        """Return True if batches wait to be written to disk, and no earlier write still has to be
        collected with `end`.
        """
        return self._written is None and bool(self._next.batches)

    @property
    def ended(self) -> bool:
        """Return True if a write to disk was begun and has ended, successfully or not."""
        return self._written is not None and self._written.done()

    def add(self, kind: Kind, rows: Rows, batches: Sequence[Batch]) -> None:
        """Add rows, and the batches to which they belong, to the queue for the next write."""
        self._next.waiting[kind].append(rows)
        self._next.batches += batches

    def begin(self) -> None:
        """Start writing the waiting rows to disk, including rows whose write failed before. Do
        nothing if the result of the previous write has not been collected with `end`.
        """
        if self._written is None:
            self._load.take(self._next)
            self._next = _Load()
            self._began = time.monotonic()
            if self._load.batches:
                self.begun_s = self._began
            self._written = self._thread.submit(self._write, self._load)
            self._written.add_done_callback(lambda _: self.on_written())

    def _write(self, load: _Load[Batch]) -> None:
        try:
            load.write(self._writer, self._upload)
        finally:
            if load.batches:
                self.write_s = time.monotonic() - self._began

    def end(self) -> list[Batch]:
        """Wait for the current write to disk; return the batches (messages) that it made durable.
        Each batch is returned once.

        Raises:
            OSError: the disk is full or broken, or `upload` could not copy the segments. Rows that
                are not durable wait for the next write.
        """
        if self._written is None:
            return []
        written = self._written
        self._written = None
        written.result()
        durable = self._load.batches
        self._load = _Load()
        return durable

    def flush(self) -> list[Batch]:
        """Write all waiting rows to disk and wait until this is done; return the batches that
        became durable. Each batch is returned once.

        Raises:
            OSError: the disk is full or broken; rows that are not durable wait for the next write.
        """
        durable = self.end()
        # Return these batches with those of the next write, because that write may fail.
        self._next.batches[:0] = durable
        self.begin()
        return self.end()

    def close(self) -> None:
        """Stop the thread that writes segments, after its current write."""
        self._thread.shutdown()
