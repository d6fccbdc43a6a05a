"""Rows that wait for the disk, and the order that the promise rests on: rows, fsynced segment, then settled.

Segments are written in a thread of their own, so that messages are taken meanwhile; only what `end` gives is settled.
"""

from __future__ import annotations

import time
from collections.abc import Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from pathlib import Path
from typing import Generic, TypeVar

import numpy as np

from fleet_service.archive.copies import Copy
from fleet_service.archive.layout import Cut
from fleet_service.archive.segments import Rows, Writer
from schemas.wire import Kind

Batch = TypeVar("Batch")


class _Load(Generic[Batch]):
    """Rows that are written together, by kind, and the batches that they are of."""

    def __init__(self) -> None:
        self.waiting: dict[Kind, list[Rows]] = {kind: [] for kind in Kind}
        self.batches: list[Batch] = []
        self.segments: list[Path] = []

    @property
    def rows(self) -> int:
        """How many are not written yet."""
        return sum(len(part["row"]) for waiting in list(self.waiting.values()) for part in waiting)

    def take(self, other: _Load[Batch]) -> None:
        """Take over what another holds."""
        for kind, waiting in other.waiting.items():
            self.waiting[kind] = self.waiting[kind] + waiting
        self.batches += other.batches

    def write(self, writer: Writer, copy: Copy | None) -> None:
        """Write each kind that is not written yet, then make all of it durable, in the second place too."""
        for kind, waiting in self.waiting.items():
            if waiting:
                rows = {name: np.concatenate([part[name] for part in waiting]) for name in waiting[0]}
                self.segments.append(writer.write(kind, rows))
                self.waiting[kind] = []
        writer.sync()
        if copy is not None:
            copy.settle(self.segments)


class SegmentLog(Generic[Batch]):
    """The log of one run of one service, for one thread; the disk's work is done in another.

    Args:
        root: of the archive.
        shard: name of the service.
        copy: of the archive; with one, durable is what is in both places.
        epoch: at the least, as a lease has it.
    """

    def __init__(self, root: Path, shard: str, copy: Copy | None = None, epoch: int = 0) -> None:
        self._writer, self._copy = Writer(root, shard, epoch), copy
        self._next: _Load[Batch] = _Load()
        self._load: _Load[Batch] = _Load()  # what was handed over
        self._written: Future[None] | None = None
        self._begun = 0.0
        self._thread = ThreadPoolExecutor(1, "segments")

    @property
    def newest(self) -> Cut:
        """The segment that was written last."""
        return self._writer.newest

    @property
    def hangs_s(self) -> float:
        """For how long the write that was begun has not ended [s]."""
        return 0.0 if self._written is None or self._written.done() else time.monotonic() - self._begun

    @property
    def rows(self) -> int:
        """Rows that wait."""
        return self._next.rows + self._load.rows

    @property
    def unsettled(self) -> int:
        """Batches that wait."""
        return len(self._next.batches) + len(self._load.batches)

    @property
    def ended(self) -> bool:
        """Whether a write was begun and has ended, one way or the other."""
        return self._written is not None and self._written.done()

    def add(self, kind: Kind, rows: Rows, batches: Sequence[Batch]) -> None:
        """Let rows wait for the next write, and the batches that they are of."""
        self._next.waiting[kind].append(rows)
        self._next.batches += batches

    def begin(self) -> None:
        """Hand over what waits, and what failed before; nothing happens while a write has not been ended."""
        if self._written is None:
            self._load.take(self._next)
            self._next = _Load()
            self._begun = time.monotonic()
            self._written = self._thread.submit(self._load.write, self._writer, self._copy)

    def end(self) -> list[Batch]:
        """Wait for the write that was begun; returns the batches that are durable by it, each once.

        Raises:
            OSError: the disk is full or broken, or the copy is not reached; what is not durable waits for the next.
        """
        if self._written is None:
            return []
        written, self._written = self._written, None
        written.result()
        durable, self._load = self._load.batches, _Load()
        return durable

    def flush(self) -> list[Batch]:
        """Write all that waits; returns the batches that are durable by it, each once.

        Raises:
            OSError: as `end`.
        """
        durable = self.end()
        self._next.batches[:0] = durable  # they are reported with the rest, which may fail
        self.begin()
        return self.end()

    def close(self) -> None:
        """Let the thread go when it has written."""
        self._thread.shutdown()
