"""In-memory index of the batches in an outbox (store on disk), without their payloads. A batch is
found by its key (row number in the file), by its stream (vehicle, agent run, kind, region), or in
order of age. The module is pure (no I/O).
"""

from __future__ import annotations

from collections import deque
from collections.abc import Collection, Iterable, Iterator
from dataclasses import dataclass, field
from typing import Final, NamedTuple

from schemas.wire import Kind

# An unanswered batch is given up when this number of later batches of its stream was settled. A
# service does not answer a batch that it cannot read. It remembers 65 536 numbers above the first
# missing one, and would then accept no further batches.
PASSED_OVER: Final = 50_000
LEAST_OLDEST: Final = 1000  # number of keys before the list is searched for removed ones


class Stream(NamedTuple):
    """Identity of a stream of batches, whose sequence numbers count from 1. A stream has all
    batches of one vehicle, one run of the agent (`boot`, a random number), one kind of record and
    one region (quadint, zoom 10).
    """

    vehicle: str
    boot: int
    kind: Kind
    region: int


@dataclass(slots=True)
class HeldBatch:
    """Data of a batch in the outbox, without its payload. `due` is the time [s] at which the batch
    is sent again if no answer came. It is None while the batch is not in flight (sent and not
    answered). `is_sent` is True once this run of the agent has sent the batch.
    """

    stream: Stream
    seq: int
    records: int
    size: int
    attempts: int = 0
    due: float | None = None
    is_sent: bool = False


@dataclass
class _Sequence:
    """Sequence numbers of one stream: the next free number, and the key of each of its batches in
    the outbox by sequence number.
    """

    stream: Stream
    next: int = 1
    first: int = 1
    batch_keys: dict[int, int] = field(default_factory=dict)

    def first_held(self) -> int:
        """Return the lowest sequence number of a batch of this stream that is still in the outbox.
        If there is none, return the next free number.

        Each call continues the search where the last call ended, so that each number is skipped
        only once.
        """
        while self.first < self.next and self.first not in self.batch_keys:
            self.first += 1
        return self.first


class HeldBatches:
    """Index of the batches in an outbox by their key, the row number in the file.

    Attributes:
        bytes: total size of the payloads [bytes].
    """

    def __init__(self, boot: int) -> None:
        self.bytes = 0
        self._boot = boot
        self._entries: dict[int, HeldBatch] = {}
        # keys in order of age; keys of removed batches may remain
        self._oldest: dict[Kind, deque[int]] = {kind: deque() for kind in Kind}
        self._streams: dict[Stream, _Sequence] = {}

    def __len__(self) -> int:
        return len(self._entries)

    def __contains__(self, key: object) -> bool:
        return key in self._entries

    def __getitem__(self, key: int) -> HeldBatch:
        return self._entries[key]

    def __iter__(self) -> Iterator[int]:
        return iter(self._entries)

    def add_batch(self, key: int, batch: HeldBatch) -> None:
        """Add a batch (message with records) to the index. `key` is its row number in the outbox's
        file.
        """
        self._entries[key] = batch
        oldest = self._oldest[batch.stream.kind]
        oldest.append(key)
        if len(oldest) > 2 * len(self._entries) + LEAST_OLDEST:
            self._oldest[batch.stream.kind] = deque(one for one in oldest if one in self._entries)
        sequence = self._streams.get(batch.stream)
        if sequence is None:
            sequence = _Sequence(batch.stream)
            self._streams[batch.stream] = sequence
        batch.stream = sequence.stream
        sequence.batch_keys[batch.seq] = key
        sequence.next = max(sequence.next, batch.seq + 1)
        self.bytes += batch.size

    def remove_batch(self, key: int) -> HeldBatch:
        """Remove the batch with the row number `key` from the index, and return the batch."""
        batch = self._entries.pop(key)
        sequence = self._streams[batch.stream]
        del sequence.batch_keys[batch.seq]
        if not sequence.batch_keys and batch.stream.boot != self._boot:
            del self._streams[batch.stream]
        self.bytes -= batch.size
        return batch

    def remove_all(self) -> None:
        """Remove all batches (messages not yet answered) from the index. The streams (vehicle,
        kind, region) of the present run of the agent keep their next sequence numbers.
        """
        own = {
            stream: sequence
            for stream, sequence in self._streams.items()
            if stream.boot == self._boot
        }
        for sequence in own.values():
            sequence.batch_keys.clear()
        self._entries = {}
        self._oldest = {kind: deque() for kind in Kind}
        self._streams = own
        self.bytes = 0

    def has_stream(self, stream: Stream) -> bool:
        """Return True if the index knows the stream: it had batches in this run of the agent, or
        batches of an earlier run are still in the outbox.
        """
        return stream in self._streams

    def next_numbers(self, stream: Stream) -> tuple[int, int]:
        """Return two sequence numbers of a stream: the next free number, and the lowest number of a
        batch in the outbox.
        """
        known = self._streams.get(stream) or _Sequence(stream)
        return known.next, known.first_held()

    def keys_within(self, stream: Stream, ranges: Iterable[tuple[int, int]]) -> set[int]:
        """Return the keys of the batches in the outbox that belong to a stream and whose sequence
        numbers lie in one of the inclusive `ranges`.
        """
        sequence = self._streams.get(stream)
        if sequence is None:
            return set()
        held = sequence.batch_keys
        return {key for first, last in ranges for key in _keys_within(held, first, last)}

    def pop_oldest(self, kind: Kind) -> int | None:
        """Return the key of the oldest batch of a kind, or None if there is none. The method also
        removes the key from the list sorted by age, so that the next call returns the next oldest
        batch.
        """
        oldest = self._oldest[kind]
        while oldest:
            key = oldest.popleft()
            if key in self._entries:
                return key
        return None

    def is_passed_over(self, batch: HeldBatch) -> bool:
        """Return True if the service seems to ignore this batch. That is the case if the batch is
        the oldest one of its stream in the outbox, and PASSED_OVER later batches of the stream were
        settled (acknowledged or refused by the service).
        """
        sequence = self._streams[batch.stream]
        later = sequence.next - batch.seq - len(sequence.batch_keys)
        return later >= PASSED_OVER and sequence.first_held() == batch.seq

    def count_records(
        self, vehicles: Collection[str] | None = None, kind: Kind | None = None
    ) -> int:
        """Return the number of records that belong to the given vehicles, or to all vehicles, of
        one kind or of all kinds. The method may be called on any thread.
        """
        return sum(
            one.records
            for one in list(self._entries.values())
            if (vehicles is None or one.stream.vehicle in vehicles)
            and kind in (None, one.stream.kind)
        )

    def count_stranded(self, vehicles: Collection[str]) -> int:
        """Return the number of records that are not sent because their vehicle is not one of
        `vehicles`, for example after a change of name. The method may be called on any thread.
        """
        return sum(
            one.records
            for one in list(self._entries.values())
            if one.stream.vehicle not in vehicles
        )


def _keys_within(held: dict[int, int], first: int, last: int) -> list[int]:
    """Return the keys of the batches with a sequence number in [first, last]. `held` maps sequence
    numbers to keys. The work is limited by the size of `held`, because a hostile service may send a
    very large range.
    """
    if last - first < len(held):
        return [held[seq] for seq in range(first, last + 1) if seq in held]
    return [key for seq, key in held.items() if first <= seq <= last]
