"""Record of accepted batches (messages with records), which detects duplicates. Each stream
(batches of one vehicle, start, kind and region) has a watermark and runs of numbers. No batch with
a sequence number up to the watermark is expected any more. A run consists of consecutive accepted
sequence numbers above it. Pure (no I/O).

The record's size is bounded by accepted data. Every run above a watermark contains a batch in the
archive, a stream has at most MAX_GAPS runs, and a stream is dropped when its newest record is older
than the service accepts.

A sender's numbers continue in a new month, but its pseudonym changes, so a new stream begins. If
the sender does not state `first_held`, all its later numbers are one run above the watermark 0.
"""

from __future__ import annotations

from bisect import bisect_left, bisect_right
from collections.abc import Iterator, Mapping
from itertools import pairwise
from typing import Final, NamedTuple

import numpy as np

from fleet_service.ingest.grouping import group_rows, largest_of
from schemas.numeric import BoolArray, IntArray
from schemas.wire import Kind

# Largest number of gaps between the accepted numbers of a stream. An agent sends old batches first,
# so after an outage only some hundreds of numbers are missing.
MAX_GAPS: Final = 1 << 16
_KINDS: Final = tuple(Kind)
_NONE: Final[tuple[int, ...]] = ()
# pseudonym of the vehicle and of its start (as numbers), kind, region
StreamKey = tuple[int, int, Kind, int]


class SequenceTracker:
    """Accepted batches of one stream.

    Attributes:
        key: name of the stream.
        vehicle: enrolled name of the sender; empty until it sends.
        boot: identifier of the vehicle's start, as sent; 0 until it sends.
        witness: permanent number that identifies the vehicle in the map; 0 until the vehicle sends.
        low: watermark: each sequence number up to this one is accepted, or will never arrive.
        runs: runs of accepted sequence numbers above the watermark: for each run its first number
            and the number after its last one, ascending.
        newest: newest time of an accepted record [ns]; it decides when the stream is dropped.
    """

    __slots__ = ("boot", "key", "low", "newest", "runs", "vehicle", "witness")

    def __init__(self, key: StreamKey) -> None:
        self.key = key
        self.vehicle = ""
        self.boot = 0
        self.witness = 0
        self.low = 0
        self.newest = 0
        self.runs: list[int] | tuple[int, ...] = _NONE

    def has_accepted(self, seq: int) -> bool:
        """Return True if the batch of this stream with this sequence number was accepted before."""
        # An odd number of limits up to `seq` means that it lies in a run.
        return seq <= self.low or bisect_right(self.runs, seq) % 2 == 1

    def accept(self, seq: int, time: int = 0) -> bool:
        """Record the sequence number of an accepted batch, and the newest time of the batch's
        records [ns]. Return False and record nothing if the number would begin another run and the
        stream has MAX_GAPS runs.
        """
        if seq == self.low + 1:
            self.raise_to(seq + 1)
        elif seq > self.low and not self._add_above(seq):
            return False
        if time > self.newest:
            self.newest = time
        return True

    def add(self, seqs: list[int]) -> None:
        """Mark sequence numbers of batches of this stream, given in ascending order, as
        accepted.
        """
        # the most frequent case: consecutive numbers
        if seqs[0] == self.low + 1 and seqs[-1] - seqs[0] == len(seqs) - 1:
            self.raise_to(seqs[-1] + 1)
        else:
            for seq in seqs:
                self.accept(seq)

    def raise_to(self, first_held: int) -> None:
        """Raise the watermark (number up to which no batch is expected any more), because sequence
        numbers below `first_held` will never arrive.
        """
        if first_held - 1 > self.low:
            place = bisect_right(self.runs, first_held)
            is_in_run = place % 2 == 1
            self.low = self.runs[place] - 1 if is_in_run else first_held - 1
            self.runs = self.runs[place + is_in_run :] or _NONE

    def _add_above(self, seq: int) -> bool:
        """Add a number above the watermark, and join runs that then touch. Return False and add
        nothing if this would exceed MAX_GAPS runs.
        """
        begin = bisect_left(self.runs, seq)
        end = bisect_right(self.runs, seq + 1)
        limits = [seq] if begin % 2 == 0 else []
        limits += [seq + 1] if end % 2 == 0 else []
        if len(self.runs) + len(limits) - (end - begin) > 2 * MAX_GAPS:
            return False
        if not isinstance(self.runs, list):
            self.runs = []
        self.runs[begin:end] = limits
        return True


BatchId = tuple[SequenceTracker, int]  # stream and sequence number


class ArchivedRows(NamedTuple):
    """Columns (n,) of archived rows that identify their batches; `time` [ns] is the time of each
    record.
    """

    vehicle: IntArray
    boot: IntArray
    region: IntArray
    seq: IntArray
    first_held: IntArray
    time: IntArray


class SequenceTrackers:
    """Accepted batches of all streams of one service."""

    def __init__(self) -> None:
        self._streams: dict[StreamKey, SequenceTracker] = {}

    def __getitem__(self, key: StreamKey) -> SequenceTracker:
        stream = self._streams.get(key)
        if stream is None:
            stream = SequenceTracker(key)
            self._streams[key] = stream
        return stream

    def __contains__(self, key: StreamKey) -> bool:
        return key in self._streams

    def __len__(self) -> int:
        return len(self._streams)

    def __iter__(self) -> Iterator[SequenceTracker]:
        return iter(self._streams.values())

    @property
    def newest(self) -> int:
        """Return the time of the newest accepted batch [ns], or 0."""
        return max((stream.newest for stream in self._streams.values()), default=0)

    def find_accepted(self, kind: Kind, names: IntArray) -> BoolArray:
        """Return a mask (n,): True for batches that were accepted before. `names` is (n, 4):
        numbers of the vehicle, of the vehicle's start and of the region, and sequence number.
        """
        get = self._streams.get
        found = (get((vehicle, boot, kind, region)) for vehicle, boot, region, _ in names.tolist())
        return np.array(
            [
                one is not None and one.has_accepted(seq)
                for one, seq in zip(found, names[:, 3].tolist(), strict=True)
            ],
            bool,
        )

    def columns(self) -> tuple[dict[str, IntArray], IntArray]:
        """Return two items: all streams as columns (n,), and the runs of accepted sequence numbers
        above the watermarks (numbers up to which no batch is expected any more) of all streams in
        one array (k, 2): first number of the run, and the number after its last one. The column
        `above` is the number of rows of this array that belong to each stream.
        """
        streams = list(self._streams.values())
        table = {
            "vehicle": [stream.key[0] for stream in streams],
            "boot": [stream.key[1] for stream in streams],
            "kind": [_KINDS.index(stream.key[2]) for stream in streams],
            "region": [stream.key[3] for stream in streams],
            "low": [stream.low for stream in streams],
            "newest": [stream.newest for stream in streams],
            "above": [len(stream.runs) // 2 for stream in streams],
        }
        limits = np.array([limit for stream in streams for limit in stream.runs], np.int64)
        columns = {name: np.array(values, np.int64) for name, values in table.items()}
        return columns, limits.reshape(-1, 2)

    @staticmethod
    def of(columns: Mapping[str, IntArray], above: IntArray) -> SequenceTrackers:
        """Return the streams that are described by `columns` and `above`, the result of the method
        `columns`.
        """
        out = SequenceTrackers()
        at = 0
        order = ("vehicle", "boot", "kind", "region", "low", "newest", "above")
        for vehicle, boot, kind, region, low, newest, n in zip(
            *(columns[name].tolist() for name in order), strict=True
        ):
            stream = out[vehicle, boot, _KINDS[kind], region]
            stream.low = low
            stream.newest = newest
            if n:
                stream.runs = above[at : at + n].ravel().tolist()
                at += n
        return out

    def forget(self, before: int) -> None:
        """Drop streams whose newest record is older than `before` [ns]. Duplicates of their batches
        are still not accepted, because they are refused as too old.
        """
        for key in [key for key, stream in self._streams.items() if stream.newest < before]:
            del self._streams[key]

    def restore(
        self,
        kind: Kind,
        rows: ArchivedRows,
    ) -> None:
        """Record the batches of archived rows of one kind, (n,), as accepted; rows may be in any
        order.
        """
        vehicle, boot, region, seq, first_held, time = rows
        if not len(seq):
            return
        group, first = group_rows(vehicle, boot, region)
        streams = [
            self[one, start, kind, where]
            for one, start, where in zip(
                *(column[first].tolist() for column in (vehicle, boot, region)), strict=True
            )
        ]
        lowest = largest_of(first_held, group, len(first)).tolist()
        newest = largest_of(time, group, len(first)).tolist()
        for stream, least, last in zip(streams, lowest, newest, strict=True):
            stream.raise_to(least)
            stream.newest = max(stream.newest, last)
        # Only few rows are above the watermark, because senders store little.
        above = np.flatnonzero(seq > np.array([stream.low for stream in streams])[group])
        above = above[np.lexsort((seq[above], group[above]))]
        of = group[above]
        numbers = seq[above]
        is_new = (np.diff(of, prepend=-1) != 0) | (np.diff(numbers, prepend=0) != 0)
        of = of[is_new]
        numbers = numbers[is_new]
        starts = np.flatnonzero(np.diff(of, prepend=-1))
        for start, stop in pairwise([*starts.tolist(), len(of)]):
            streams[of[start]].add(numbers[start:stop].tolist())
