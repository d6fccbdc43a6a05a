"""Outbox: stores batches (messages with records) on disk until they are acknowledged, so that no
report is lost or counted twice.

A batch is committed here before it is sent. It is removed only after the service has settled it
(stored or refused it for good). A batch is identified by its stream (vehicle, boot, kind, region)
and its sequence number `seq`, which counts from 1 without gaps in each stream. `boot` is a random
number per run of the agent. Therefore a restarted agent opens new streams and never reuses an
identifier. Batches of an earlier run are sent again under their old identifier. For a recorded
drive, `boot` is a digest of its batches, so that a repeated publication has the same identifiers.

The size is limited: when the payloads exceed the capacity, the oldest states (regular reports of
motion) are dropped first, then the oldest observations, and both are counted. SQLite runs in WAL
mode with a sync per commit. The outbox keeps the exclusive lock of the database file while it is
open, so that two agents never use the same file. Time is an argument, in monotonic seconds.
"""

from __future__ import annotations

import secrets
from collections import Counter
from collections.abc import Collection, Iterable, Sequence
from dataclasses import dataclass, field
from pathlib import Path

from edge_agent.publish.batching import Draft, DriveBatches
from edge_agent.publish.held_batches import HeldBatch, HeldBatches, Stream
from edge_agent.publish.resend_schedule import FIRST_RESEND_S, ResendSchedule
from edge_agent.publish.spool_file import SpoolFile
from schemas.wire import Kind

BOOT_LIMIT = 2**63  # `boot` is below this limit, so that it fits into a signed 64-bit column
# `first_held` in the batches of a recorded drive. A repeat sends all of them again, so the service
# must never conclude that a missing batch will not arrive.
ALL_HELD = 1
# Several days of one vehicle that stores a batch per second and kind.
DEFAULT_CAPACITY_BYTES = 256 * 2**20
# Old states are evicted first because they are worth least, observations last.
EVICTION_ORDER = (Kind.STATE, Kind.OBSERVATION)


@dataclass(frozen=True)
class StoredBatch:
    """Batch on disk that no service has settled (acknowledged or refused by the service). A batch
    that `store` returns is sent at once if it is `fresh`, and otherwise when `due_batches` returns
    it. A batch that `due_batches` returns is `fresh` if this run of the agent has not sent it yet.
    """

    key: int
    stream: Stream
    seq: int
    records: int
    payload: bytes
    fresh: bool = True


@dataclass
class OutboxCounts:
    """Numbers of records that the outbox of this process has handled, by outcome."""

    stored: int = 0
    settled: int = 0
    # dropped for lack of space
    evicted: dict[Kind, int] = field(default_factory=lambda: dict.fromkeys(EVICTION_ORDER, 0))
    damaged: int = 0  # lost by damage of the file, as far as known
    unanswered: int = 0  # given up, because the service answered only later batches
    damages: int = 0  # number of times that the file was found damaged


class Outbox:
    """Store on disk of the batches of one agent process that no service has settled.

    Attributes:
        path: the outbox's file.
        held: index of the batches, without payloads; its counts may be read on any thread.
        schedule: which batches are in flight (sent and not answered), and when they are sent again.
        counts: numbers of records that were stored, settled or lost.

    Raises:
        InputError: the file belongs to another agent or is not an outbox.
    """

    def __init__(
        self,
        path: Path,
        *,
        capacity_bytes: int = DEFAULT_CAPACITY_BYTES,
        first_resend_s: float = FIRST_RESEND_S,
        boot: int | None = None,
    ) -> None:
        self.boot = boot if boot is not None else secrets.randbelow(BOOT_LIMIT - 1) + 1
        self.path = path
        self.capacity_bytes = capacity_bytes
        self.counts = OutboxCounts()
        self.held = HeldBatches(self.boot)
        self.schedule = ResendSchedule(self.held, first_resend_s, self.boot)
        self._deletable: list[int] = []
        self._file = SpoolFile(path)
        self.counts.damages += self._file.was_damaged
        self._load_batches()

    def _load_batches(self) -> None:
        """Load the batches that the outbox's file contains from an earlier run; all are due at
        once.
        """
        for key, (vehicle, boot, kind, region, seq, records), size in self._file.list_batches():
            stream = Stream(vehicle, boot, Kind(kind), region)
            self.held.add_batch(key, HeldBatch(stream, seq, records, size))
            self.schedule.queue_batch(key)
        self._evict_oldest()

    def recover_file(self) -> None:
        """Replace a damaged file by a new file that has the readable content of the old one, and
        load it. If an error occurs, the caller may call the method again.

        Raises:
            sqlite3.Error, OSError: the disk does not accept the write.
        """
        before = self.held.count_records()
        self._file.recover_content()
        self.counts.damages += 1
        self.held.remove_all()
        self.schedule.remove_all()
        self._deletable = []
        self._load_batches()
        self.counts.damaged += max(before - self.held.count_records(), 0)

    def _drop_batch(self, key: int) -> int:
        """Remove a batch from the outbox, and return the number of its records."""
        batch = self.held.remove_batch(key)
        self.schedule.record_removal(batch)
        self._deletable.append(key)
        return batch.records

    def store(self, drafts: Sequence[Draft], now: float) -> list[StoredBatch]:
        """Assign sequence numbers to new batches (`drafts`), commit them to disk in one
        transaction, and return them. If the commit fails, nothing changes.

        Batches that were evicted at once for lack of space are not returned.

        Raises:
            sqlite3.Error: the disk does not accept the write.
        """
        ahead: dict[Stream, int] = {}
        with self._file.begin_transaction():
            self._file.delete_rows(self._deletable)
            inserted = [self._insert_draft(draft, ahead) for draft in drafts]
        self._deletable.clear()
        stored = []
        for key, stream, seq, draft, payload in inserted:
            self.held.add_batch(key, HeldBatch(stream, seq, draft.records, len(payload)))
            self.counts.stored += draft.records
            fresh = self.schedule.send_or_queue(key, now)
            self.held[key].is_sent = fresh
            stored.append(StoredBatch(key, stream, seq, draft.records, payload, fresh))
        self._evict_oldest()
        return [batch for batch in stored if batch.key in self.held]

    def _insert_draft(
        self, draft: Draft, ahead: dict[Stream, int]
    ) -> tuple[int, Stream, int, Draft, bytes]:
        """Insert a batch without number (`draft`) into the file. Return its key (row number), its
        stream (vehicle, agent run, kind, region), its sequence number, the draft and the payload.

        `ahead` maps each stream to its next sequence number within the present transaction; it is
        updated.
        """
        stream = Stream(draft.vehicle, self.boot, draft.kind, draft.region)
        following, first_held = self.held.next_numbers(stream)
        seq = ahead.get(stream, following)
        payload = draft.encode(seq, first_held)
        key = self._insert_payload(stream, seq, draft.records, payload)
        ahead[stream] = seq + 1
        return key, stream, seq, draft, payload

    def _insert_payload(self, stream: Stream, seq: int, records: int, payload: bytes) -> int:
        name = (stream.vehicle, stream.boot, str(stream.kind), stream.region, seq, records)
        return self._file.insert_row(name, payload)

    def store_drive(self, drive: DriveBatches) -> None:
        """Commit the batches of a recorded drive to disk in one transaction, and queue them. They
        replace those that an earlier attempt left in the outbox. If the commit fails, nothing
        changes.

        Raises:
            sqlite3.Error: the disk does not accept the write.
        """
        last: Counter[Stream] = Counter()
        replaced: set[int] = set()
        inserted: list[tuple[int, HeldBatch]] = []
        with self._file.begin_transaction():
            for draft in drive.drafts:
                stream = Stream(draft.vehicle, drive.boot, draft.kind, draft.region)
                last[stream] += 1
                seq = last[stream]
                earlier = self.held.keys_within(stream, [(seq, seq)])
                self._file.delete_rows(list(earlier))
                replaced |= earlier
                payload = draft.encode(seq, ALL_HELD)
                key = self._insert_payload(stream, seq, draft.records, payload)
                inserted.append((key, HeldBatch(stream, seq, draft.records, len(payload))))
        for key in replaced:
            self._drop_batch(key)
        for key, batch in inserted:
            self.held.add_batch(key, batch)
            self.counts.stored += batch.records
            self.schedule.queue_batch(key)
        self._evict_oldest()

    def reset_in_flight(self, vehicle: str, now: float) -> None:
        """Treat all batches of a vehicle that are in flight as lost, because the vehicle has just
        reconnected.
        """
        self.schedule.reset_in_flight(vehicle, now)

    def _evict_oldest(self) -> None:
        """Drop batches until the capacity is respected: first the oldest batches of states, then
        the oldest batches of observations.
        """
        for kind in EVICTION_ORDER:
            while self.held.bytes > self.capacity_bytes:
                key = self.held.pop_oldest(kind)
                if key is None:
                    break
                self.counts.evicted[kind] += self._drop_batch(key)

    def delete_settled(self) -> None:
        """Delete settled batches from the disk now, instead of with the next `store`.

        Raises:
            sqlite3.Error: the disk does not accept the change.
        """
        if self._deletable:
            with self._file.begin_transaction():
                self._file.delete_rows(self._deletable)
            self._deletable.clear()

    def settle_ranges(self, stream: Stream, ranges: Iterable[tuple[int, int]]) -> int:
        """Remove the batches of a stream whose sequence numbers lie in the inclusive `ranges`.
        Return the number of their records. Numbers that are not in the outbox are ignored.

        The batches are deleted from the disk only with the next `store` or `delete_settled`, so
        that an acknowledgement requires no sync of the disk. If a crash happens before that, the
        batches are sent again, and the service recognises them as already processed.
        """
        if self.held.has_stream(stream):
            self.schedule.record_answer(stream)
        records = sum(self._drop_batch(key) for key in self.held.keys_within(stream, ranges))
        self.counts.settled += records
        return records

    def due_batches(
        self, now: float, limit: int, vehicles: Collection[str] | None = None
    ) -> list[StoredBatch]:
        """Return at most `limit` batches to send at time `now` [s], oldest first. They belong to
        `vehicles`, or to any vehicle if that is None.

        The module `pacing` limits how many batches of a vehicle and region are sent at once.

        Raises:
            sqlite3.Error: the disk cannot be read.
        """
        for key in self.schedule.expire_batches(now):
            self.counts.unanswered += self._drop_batch(key)
        keys = self.schedule.take_due(now, limit, vehicles)
        due = [batch for key in keys if (batch := self.read_batch(key)) is not None]
        for batch in due:
            self.held[batch.key].is_sent = True
        return due

    def read_batch(self, key: int) -> StoredBatch | None:
        """Return the batch with the row number `key`, with its payload. If the row is missing or
        damaged, count the loss and return None.

        Raises:
            sqlite3.Error: the disk cannot be read.
        """
        batch = self.held[key]
        payload = self._file.read_payload(key)
        if payload is None:
            # The stored number of records may be damaged as well, so count at least one.
            self.counts.damaged += max(self._drop_batch(key), 1)
            return None
        return StoredBatch(
            key, batch.stream, batch.seq, batch.records, payload, fresh=not batch.is_sent
        )

    def close(self) -> None:
        """Delete the settled batches (those that the service has answered) and release the file.

        Raises:
            sqlite3.Error: the disk does not accept the last deletions.
        """
        try:
            self.delete_settled()
        finally:
            self._file.close()
