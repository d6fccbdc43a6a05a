"""Outbox: stores batches on disk until they are acknowledged, so that no report is lost or counted
twice.

A batch is committed here before it is sent, and is removed only after the service has settled it.
It is identified by its stream (vehicle, boot, kind, region) and its sequence number `seq`, which
counts from 1 without gaps in each stream. `boot` is a random number per start. Therefore a
restarted agent opens new streams and never reuses an identifier. Batches of an earlier start are
sent again under their old identifier.

The size is limited: when the payloads exceed the capacity, the oldest states are dropped first,
then the oldest observations, and both are counted. SQLite runs in WAL mode with a sync per commit.
The outbox keeps the exclusive lock of the database file while it is open, so that two agents never
use the same file. Time is an argument, in monotonic seconds.
"""

from __future__ import annotations

import heapq
import random
import secrets
import sqlite3
from collections import deque
from collections.abc import Collection, Iterable, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import NamedTuple

from edge_agent.publish import spool_file
from edge_agent.publish.batching import Draft
from edge_agent.publish.pacing import Pacer
from schemas.wire import Kind

BOOT_LIMIT = 2**63  # boot fits a signed 64-bit column
# a service writes a segment each second: an answer younger than this is on its way
FIRST_RESEND_S = 2.0
# for an answer of a service that does answer; see `pacing` for one that does not
LONGEST_RESEND_S = 6.0
# A batch that no service can read is answered by none. Once so many later ones of its stream were
# settled, a service is about to take no more (it remembers 65 536 above one that is missing), so
# that this one must go.
PASSED_OVER = 50_000
LEAST_OLDEST = 1000  # keys that may be gone before they are looked through
JITTER = 0.25  # share of the delay, either way: agents that lost one router do not return in step
DEFAULT_CAPACITY_BYTES = 256 * 2**20  # some days of one vehicle at a batch per second and kind
EVICTION_ORDER = (Kind.STATE, Kind.OBSERVATION)  # an old state is worth least, an observation most


class Stream(NamedTuple):
    """Stream of batches with its own sequence numbers, which count from 1: the batches of one
    vehicle, one start, one kind of record and one region (z10 quadint).
    """

    vehicle: str
    boot: int
    kind: Kind
    region: int


@dataclass(frozen=True)
class StoredBatch:
    """Batch on disk that no service has settled (finally answered). A `fresh` batch is sent
    immediately, any other when `due_batches` returns it.
    """

    key: int
    stream: Stream
    seq: int
    records: int
    payload: bytes
    fresh: bool = True


@dataclass
class OutboxCounts:
    """Numbers of records in the outbox's history: stored, settled (finally answered), evicted for
    lack of space, damaged, or never answered.
    """

    stored: int = 0
    settled: int = 0
    evicted: dict[Kind, int] = field(default_factory=lambda: dict.fromkeys(EVICTION_ORDER, 0))
    damaged: int = 0  # records that damage took, as far as it is known
    # records of batches that were given up since nobody answers them, only later ones
    unanswered: int = 0
    damages: int = 0  # times that the file was found damaged


@dataclass(slots=True)
class _Entry:
    """State of a stored batch without its payload. While the batch is in flight (sent and not
    answered), `due` is the time [s] of its next resend.
    """

    stream: Stream
    seq: int
    records: int
    size: int
    attempts: int = 0
    due: float | None = None


@dataclass
class _Sequence:
    """Sequence numbers of one stream (vehicle, start, kind, region): the next free number, and the
    numbers of its batches in the outbox.
    """

    stream: Stream
    next: int = 1
    first: int = 1
    held: dict[int, int] = field(default_factory=dict)

    def first_held(self) -> int:
        """Return the lowest seq that is still in the outbox, or the next free seq if the outbox has
        no batch of the stream.

        The search continues where the last one ended, so each settled seq is skipped only once.
        """
        while self.first < self.next and self.first not in self.held:
            self.first += 1
        return self.first


class Outbox:
    """Store on disk of the batches of one agent process that no service has settled (finally
    answered).

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
        self.capacity_bytes = capacity_bytes
        self.first_resend_s = first_resend_s
        self.counts = OutboxCounts()
        self._random = random.Random(self.boot)
        self._entries: dict[int, _Entry] = {}
        self._oldest: dict[Kind, deque[int]] = {
            kind: deque() for kind in Kind
        }  # keys in their order, gone ones too
        self._streams: dict[Stream, _Sequence] = {}
        self._pacers: dict[tuple[str, int], Pacer] = {}
        self._later: list[tuple[float, int]] = []  # heap of when what flies is given up
        self._bytes = 0
        self._deletable: list[int] = []
        self._path = path
        self._database, aside = spool_file.open_file(path)
        self.counts.damages += aside is not None
        self._load_batches()

    def _load_batches(self) -> None:
        """Load the batches of an earlier start; all are due at once."""
        rows = self._database.execute(
            "SELECT id, vehicle, boot, kind, region, seq, records, LENGTH(payload) FROM batch "
            "ORDER BY id"
        )
        for key, vehicle, boot, kind, region, seq, records, size in rows:
            self._hold_entry(
                key, _Entry(Stream(vehicle, boot, Kind(kind), region), seq, records, size)
            )
            self._pacer_of(self._entries[key]).queue_batch(key)
        self._evict_oldest()

    def recover_file(self) -> None:
        """Replace a damaged file: continue in a new file that has the readable content of the old
        one. After an error the call may be repeated.

        Raises:
            sqlite3.Error, OSError: the disk does not accept the write.
        """
        self._database.close()
        before = sum(entry.records for entry in self._entries.values())
        self._database, _ = spool_file.recover_file(self._path)
        self.counts.damages += 1
        own = {
            stream: sequence
            for stream, sequence in self._streams.items()
            if stream.boot == self.boot
        }
        for sequence in own.values():
            sequence.held.clear()
        self._entries = {}
        self._oldest = {kind: deque() for kind in Kind}
        self._streams = own
        self._pacers = {}
        self._later = []
        self._deletable = []
        self._bytes = 0
        self._load_batches()
        self.counts.damaged += max(
            before - sum(entry.records for entry in self._entries.values()), 0
        )

    def _pacer_of(self, entry: _Entry) -> Pacer:
        return self._pacers.setdefault((entry.stream.vehicle, entry.stream.region), Pacer())

    def _hold_entry(self, key: int, entry: _Entry) -> None:
        self._entries[key] = entry
        oldest = self._oldest[entry.stream.kind]
        oldest.append(key)
        if len(oldest) > 2 * len(self._entries) + LEAST_OLDEST:
            self._oldest[entry.stream.kind] = deque(one for one in oldest if one in self._entries)
        sequence = self._streams.get(entry.stream)
        if sequence is None:
            sequence = self._streams[entry.stream] = _Sequence(entry.stream)
        entry.stream = sequence.stream
        sequence.held[entry.seq] = key
        sequence.next = max(sequence.next, entry.seq + 1)
        self._bytes += entry.size

    def _drop_entry(self, key: int) -> _Entry:
        entry = self._entries.pop(key)
        sequence = self._streams[entry.stream]
        del sequence.held[entry.seq]
        if not sequence.held and entry.stream.boot != self.boot:
            del self._streams[entry.stream]
        if entry.due is not None:
            self._pacer_of(entry).record_settled()
        self._bytes -= entry.size
        self._deletable.append(key)
        return entry

    @property
    def batches(self) -> int:
        """Return the number of batches in the outbox."""
        return len(self._entries)

    def count_records(self, vehicles: Collection[str], kind: Kind | None = None) -> int:
        """Return the number of records in the outbox that belong to the given vehicles, of one kind
        or of all kinds.
        """
        held = list(self._entries.values())
        return sum(
            e.records
            for e in held
            if e.stream.vehicle in vehicles and kind in (None, e.stream.kind)
        )

    def count_stranded(self, vehicles: Collection[str]) -> int:
        """Return the number of records that are not sent because they belong to other vehicles than
        these, for example after a change of name.
        """
        return sum(
            e.records for e in list(self._entries.values()) if e.stream.vehicle not in vehicles
        )

    @property
    def bytes(self) -> int:
        """Return the total size of the stored payloads [bytes]."""
        return self._bytes

    def unanswered_s(self, now: float) -> float:
        """Return the time [s] for which sent batches have been unanswered, in the region with the
        longest wait; 0 if no batch waits.
        """
        since = (pacer.unanswered_since for pacer in list(self._pacers.values()))
        return max((now - one for one in since if one is not None), default=0.0)

    def store(self, drafts: Sequence[Draft], now: float) -> list[StoredBatch]:
        """Assign sequence numbers to new batches (drafts), and commit them to disk in one
        transaction; if the commit fails, nothing changes.

        Return the stored batches.

        Raises:
            sqlite3.Error: the disk does not accept the write.
        """
        ahead: dict[Stream, int] = {}
        with self._database:
            self._delete_rows()
            held = [self._insert_draft(draft, ahead) for draft in drafts]
        self._deletable.clear()
        for place, batch in enumerate(held):
            entry = _Entry(batch.stream, batch.seq, batch.records, len(batch.payload))
            self._hold_entry(batch.key, entry)
            self.counts.stored += batch.records
            pacer = self._pacer_of(entry)
            if pacer.silent:
                pacer.queue_batch(batch.key)
                held[place] = replace(batch, fresh=False)
            else:
                self._mark_in_flight(batch.key, now)
        self._evict_oldest()
        return [batch for batch in held if batch.key in self._entries]

    def _insert_draft(self, draft: Draft, ahead: dict[Stream, int]) -> StoredBatch:
        stream = Stream(draft.vehicle, self.boot, draft.kind, draft.region)
        known = self._streams.get(stream) or _Sequence(stream)
        seq = ahead.get(stream, known.next)
        payload = draft.encode(seq, known.first_held())
        name = (stream.vehicle, stream.boot, str(stream.kind), stream.region, seq, draft.records)
        cursor = self._database.execute(
            f"INSERT INTO batch ({spool_file.NAME}, payload, checksum) VALUES (?, ?, ?, ?, ?, ?, "
            "?, ?)",
            (*name, payload, spool_file.batch_checksum(name, payload)),
        )
        ahead[stream] = seq + 1
        key = cursor.lastrowid
        if key is None:
            raise sqlite3.DatabaseError("an insert gave no row id")
        return StoredBatch(key, stream, seq, draft.records, payload)

    def _mark_in_flight(self, key: int, now: float) -> None:
        """Mark the batch with this key as in flight (sent and not answered), and set the time of
        its next resend.
        """
        entry = self._entries[key]
        delay = min(
            max(LONGEST_RESEND_S, self.first_resend_s),
            self.first_resend_s * 2.0 ** min(entry.attempts, 16),
        )
        entry.attempts += 1
        entry.due = now + delay * self._random_jitter()
        heapq.heappush(self._later, (entry.due, key))
        self._pacer_of(entry).record_sent(now)

    def _random_jitter(self) -> float:
        return self._random.uniform(1 - JITTER, 1 + JITTER)

    def reset_in_flight(self, vehicle: str, now: float) -> None:
        """Treat all batches of a vehicle that are in flight (sent and not answered) as lost,
        because the vehicle has just reconnected.
        """
        for (name, _), pacer in self._pacers.items():
            if name == vehicle:
                pacer.record_reconnect(now)
        for _, key in self._later:
            entry = self._entries.get(key)
            if entry is not None and entry.stream.vehicle == vehicle and entry.due is not None:
                entry.due = None
                entry.attempts = 0
                self._pacer_of(entry).queue_batch(key)

    def _evict_oldest(self) -> None:
        """Drop batches until the capacity is respected: first the oldest states, then the oldest
        observations.
        """
        for kind in EVICTION_ORDER:
            while self._bytes > self.capacity_bytes and self._oldest[kind]:
                key = self._oldest[kind].popleft()
                if key in self._entries:
                    self.counts.evicted[kind] += self._drop_entry(key).records

    def _delete_rows(self) -> None:
        self._database.executemany(
            "DELETE FROM batch WHERE id = ?", [(key,) for key in self._deletable]
        )

    def delete_settled(self) -> None:
        """Delete settled (finally answered) batches from the disk now, instead of with the next
        `store`.

        Raises:
            sqlite3.Error: the disk does not accept the change.
        """
        if self._deletable:
            with self._database:
                self._delete_rows()
            self._deletable.clear()

    def settle_ranges(self, stream: Stream, ranges: Iterable[tuple[int, int]]) -> int:
        """Remove the batches in inclusive ranges of seq; return the number of their records.
        Unknown numbers are ignored.

        The batches are deleted from the disk only with the next `store` or `delete_settled`, so
        that an acknowledgement requires no sync of the disk. If a crash happens before that, the
        batches are sent again, and the service recognises them as already processed.
        """
        sequence = self._streams.get(stream)
        if sequence is None:
            return 0
        pacer = self._pacers.get((stream.vehicle, stream.region))
        if pacer is not None:
            pacer.record_answer()
        keys = {key for first, last in ranges for key in _keys_within(sequence.held, first, last)}
        records = sum(self._drop_entry(key).records for key in keys)
        self.counts.settled += records
        return records

    def due_batches(
        self, now: float, limit: int, vehicles: Collection[str] | None = None
    ) -> list[StoredBatch]:
        """Return at most `limit` batches to send now, oldest first, of the given vehicles or of all
        vehicles.

        The module `pacing` decides how many batches of a vehicle and region are sent.

        Raises:
            sqlite3.Error: the disk cannot be read.
        """
        while self._later and self._later[0][0] <= now:
            at, key = heapq.heappop(self._later)
            entry = self._entries.get(key)
            if entry is not None and entry.due == at:
                entry.due = None
                self._pacer_of(entry).record_timeout(now, self._random_jitter())
                if self._is_passed_over(entry):
                    self.counts.unanswered += self._drop_entry(key).records
                else:
                    self._pacer_of(entry).queue_batch(key)
        keys: list[int] = []
        for (vehicle, _), pacer in self._pacers.items():
            if vehicles is None or vehicle in vehicles:
                taken = pacer.take_due(now, self._random_jitter(), limit - len(keys), self._entries)
                for key in taken:
                    self._mark_in_flight(key, now)
                keys += taken
        self._pacers = {
            name: pacer for name, pacer in self._pacers.items() if not pacer.is_idle or pacer.silent
        }
        return [batch for key in sorted(keys) if (batch := self._read_batch(key)) is not None]

    def _is_passed_over(self, entry: _Entry) -> bool:
        """Return True if the service seems to ignore this batch: it is the oldest of its stream
        (same vehicle, start, kind, region) in the outbox, and PASSED_OVER later batches of the
        stream were settled.
        """
        sequence = self._streams[entry.stream]
        later = sequence.next - entry.seq - len(sequence.held)
        return later >= PASSED_OVER and sequence.first_held() == entry.seq

    def held_batches(self) -> list[StoredBatch]:
        """Return all batches in the outbox, oldest first.

        Raises:
            sqlite3.Error: the disk cannot be read.
        """
        return [
            batch for key in list(self._entries) if (batch := self._read_batch(key)) is not None
        ]

    def _read_batch(self, key: int) -> StoredBatch | None:
        """Return a batch with its payload. If its row is missing or damaged, count the loss and
        return None.
        """
        entry = self._entries[key]
        query = f"SELECT {spool_file.NAME}, payload, checksum FROM batch WHERE id = ?"
        row = self._database.execute(query, (key,)).fetchone()
        if row is None or (
            row[-1] is not None and spool_file.batch_checksum(row[:6], row[6]) != row[-1]
        ):
            self.counts.damaged += max(
                self._drop_entry(key).records, 1
            )  # the number may be what is damaged
            return None
        return StoredBatch(key, entry.stream, entry.seq, entry.records, row[6])

    def close(self) -> None:
        """Delete the settled batches and release the file.

        Raises:
            sqlite3.Error: the disk does not accept the last deletions.
        """
        try:
            self.delete_settled()
        finally:
            self._database.close()


def _keys_within(held: dict[int, int], first: int, last: int) -> list[int]:
    """Return the keys of the batches in the outbox with a sequence number in [first, last]. The
    work does not grow with the range, because a hostile service may send a very large one.
    """
    if last - first < len(held):
        return [held[seq] for seq in range(first, last + 1) if seq in held]
    return [key for seq, key in held.items() if first <= seq <= last]
