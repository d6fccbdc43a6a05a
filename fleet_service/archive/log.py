"""Rows that wait for the disk, and the order that the promise rests on: rows, fsynced segment, then settled."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Generic, TypeVar

import numpy as np

from fleet_service.archive.segments import Rows, Writer
from schemas.wire import Kind

Batch = TypeVar("Batch")


class Log(Generic[Batch]):
    """The log of one run of one service.

    Args:
        root: of the archive.
        shard: name of the service.
    """

    def __init__(self, root: Path, shard: str) -> None:
        self._writer = Writer(root, shard)
        self._waiting: dict[Kind, list[Rows]] = {kind: [] for kind in Kind}
        self._unsettled: list[Batch] = []
        self.rows = 0  # that wait

    @property
    def unsettled(self) -> int:
        """Batches that wait."""
        return len(self._unsettled)

    def add(self, kind: Kind, rows: Rows, batches: Sequence[Batch]) -> None:
        """Let rows wait for the next `flush`, and the batches that they are of."""
        self._waiting[kind].append(rows)
        self._unsettled += batches
        self.rows += len(rows["row"])

    def flush(self) -> list[Batch]:
        """Write what waits; returns the batches that are durable by it, each once.

        Raises:
            OSError: the disk is full or broken; what is not durable waits for the next call.
        """
        for kind, waiting in self._waiting.items():
            if waiting:
                rows = {name: np.concatenate([part[name] for part in waiting]) for name in waiting[0]}
                self._writer.write(kind, rows)
                self.rows -= len(rows["row"])
                waiting.clear()
        self._writer.sync()
        durable, self._unsettled = self._unsettled, []
        return durable
