"""The log: rows that wait for the disk. The order is the guarantee: rows, fsynced segment, then
settled.

A thread of its own writes segments, so that messages are processed meanwhile. Only batches returned
by `end` are settled.
"""

from __future__ import annotations

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
    """Rows that are written together, by kind, and their batches."""

    def __init__(self) -> None:
        self.waiting: dict[Kind, list[Rows]] = {kind: [] for kind in Kind}
        self.batches: list[Batch] = []
        self.segments: list[Path] = []

    @property
    def rows(self) -> int:
        """Return the number of rows that are not written yet."""
        return sum(len(part["row"]) for waiting in list(self.waiting.values()) for part in waiting)

    def take(self, other: _Load[Batch]) -> None:
        """Append the waiting rows and the segments of another load."""
        for kind, waiting in other.waiting.items():
            self.waiting[kind] = self.waiting[kind] + waiting
        self.batches += other.batches

    def write(self, writer: Writer, upload: Upload | None) -> None:
        """Write each kind that is not written yet, then make all of it durable, by `upload` too."""
        for kind, waiting in self.waiting.items():
            if waiting:
                rows = {
                    name: np.concatenate([part[name] for part in waiting]) for name in waiting[0]
                }
                self.segments.append(writer.write(kind, rows))
                self.waiting[kind] = []
        writer.sync()
        if upload is not None:
            upload(self.segments)


class SegmentLog(Generic[Batch]):
    """Log of one run of one service, for one thread; another thread does the disk's work.

    Args:
        root: of the archive.
        shard: name of the service.
        upload: makes segments durable in a second place; with one, a batch is settled when it is in
            both places.
        epoch: smallest epoch, from the lease.
    """

    def __init__(
        self, root: Path, shard: str, upload: Upload | None = None, epoch: int = 0
    ) -> None:
        self._writer = Writer(root, shard, epoch)
        self._upload = upload
        self._next: _Load[Batch] = _Load()
        self._load: _Load[Batch] = _Load()  # what was handed over
        self._written: Future[None] | None = None
        self._begun = 0.0
        self._thread = ThreadPoolExecutor(1, "segments")

    @property
    def newest(self) -> Cut:
        """Return the last written segment."""
        return self._writer.newest

    @property
    def hangs_s(self) -> float:
        """Return the time [s] since the current write began; 0 without one."""
        return (
            0.0 if self._written is None or self._written.done() else time.monotonic() - self._begun
        )

    @property
    def rows(self) -> int:
        """Return the number of waiting rows."""
        return self._next.rows + self._load.rows

    @property
    def unsettled(self) -> int:
        """Return the number of waiting batches."""
        return len(self._next.batches) + len(self._load.batches)

    @property
    def ended(self) -> bool:
        """Return True if a write was begun and has ended, successfully or not."""
        return self._written is not None and self._written.done()

    def add(self, kind: Kind, rows: Rows, batches: Sequence[Batch]) -> None:
        """Queue rows, and the batches they belong to, for the next write."""
        self._next.waiting[kind].append(rows)
        self._next.batches += batches

    def begin(self) -> None:
        """Start writing waiting rows and rows that failed before; do nothing while a write is not
        collected by `end`."""
        if self._written is None:
            self._load.take(self._next)
            self._next = _Load()
            self._begun = time.monotonic()
            self._written = self._thread.submit(self._load.write, self._writer, self._upload)

    def end(self) -> list[Batch]:
        """Wait for the current write; return the batches that it made durable, each once.

        Raises:
            OSError: the disk is full or broken, or the copy is not reached; rows that are not
                durable wait for the next write.
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
        """Write all waiting rows; return the batches that became durable, each once.

        Raises:
            OSError: as for `end`.
        """
        durable = self.end()
        self._next.batches[:0] = durable  # they are reported with the rest, which may fail
        self.begin()
        return self.end()

    def close(self) -> None:
        """Stop the thread after its current write."""
        self._thread.shutdown()
