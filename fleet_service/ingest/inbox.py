"""Inbox: a bounded queue for messages that Zenoh subscribers receive, and the conversion of these
messages into accepted rows.

The subscriber's callback only copies bytes into the queue. If the queue is full, the message is
dropped and counted. It is not acknowledged, so its sender keeps it and sends it again. In this way,
an overloaded service slows its senders down (back-pressure).
"""

from __future__ import annotations

import queue
from collections.abc import Callable, Collection, Sequence
from contextlib import suppress
from itertools import compress
from threading import Lock
from time import monotonic, sleep
from typing import Final, NamedTuple

import numpy as np
import zenoh

from fleet_service.archive.format.layout import DAY_NS, FIRST_TIME, MAP_DAYS, TIME
from fleet_service.archive.format.segments import Rows, round_to_steps
from fleet_service.archive.identity import erasures
from fleet_service.archive.identity.pseudonyms import Pseudonyms, pseudonym_number, pseudonym_texts
from fleet_service.archive.identity.vehicle_ids import VehicleIds
from fleet_service.counts import ServiceCounts
from fleet_service.ingest import validation
from fleet_service.ingest.acks import Acks
from fleet_service.ingest.batch_decoder import decode_many
from fleet_service.ingest.budgets import STREAMS_AT_ONCE, STREAMS_PER_HOUR, TokenBuckets
from fleet_service.ingest.dedup import BatchId, SequenceTracker, SequenceTrackers
from fleet_service.ingest.rate_limit import RateLimiter
from fleet_service.ingest.validation import Clock, Refusal
from schemas.errors import InputError
from schemas.grid import cell_of
from schemas.keys import Parsed
from schemas.numeric import BoolArray, IntArray
from schemas.thresholds import NS, US_STEP
from schemas.wire import MAX_BYTES, Kind
from schemas.wire.batches import Decoded, Head, Heads, head_of

# Limits for one step of the worker, so that a flood of messages delays alerts, answers and segments
# only briefly. The cost is mainly per record; 160 bytes count as one record.
STEP_MESSAGES: Final = 4096
STEP_BYTES: Final = 768 * 1024
# [s] Shortest time between the beginnings of two steps, unless GATHERED messages are waiting. Even
# a step with one message costs as much as a hundred records.
STEP_S: Final = 0.01
GATHERED: Final = 64
# Largest size of all waiting messages. They take half a minute of work, however many they are.
QUEUE_BYTES: Final = 64 << 20
FORGET_NS: Final = 600 * NS  # [ns] period in which streams that are too old are dropped
# [ns] Time for which streams are remembered. After a restart, the service reads whole days again
# and must recognise all their batches.
KNOWN_NS: Final = (MAP_DAYS + 2) * DAY_NS


class Message(NamedTuple):
    """One message that a Zenoh subscriber received."""

    kind: Kind
    key: str
    payload: bytes
    encoding: str


class Inbox:
    """Bounded queue of received messages.

    Args:
        capacity: maximum number of messages. Threads that call `put` at the same instant may exceed
            it by one each, because the check takes no lock.
        counts: counts of the service; dropped messages are counted in `overload`.
        limits: rate limits per vehicle.
    """

    def __init__(self, capacity: int, counts: ServiceCounts, limits: RateLimiter) -> None:
        # SimpleQueue has no Python locks and costs a fifth. None only wakes the thread in `drain`.
        self._queue: queue.SimpleQueue[Message | None] = queue.SimpleQueue()
        self._capacity = capacity
        self._counts = counts
        self._limits = limits
        self._bytes = 0
        self._guard = Lock()
        self._drained_at = 0.0

    def callback(self, kind: Kind) -> Callable[[zenoh.Sample], None]:
        """Return the function to be called for each message, for a Zenoh subscriber that receives
        batches (messages with records) of one kind (observations or states).
        """

        def take(sample: zenoh.Sample) -> None:
            key = str(sample.key_expr)
            payload = sample.payload
            encoding = str(sample.encoding)
            if len(payload) > MAX_BYTES:
                self._counts.refused["payload"] += 1
            elif sample.kind == zenoh.SampleKind.PUT and self._limits.allows(
                key, len(payload), encoding
            ):
                self.put(Message(kind, key, payload.to_bytes(), encoding))

        return take

    def put(self, message: Message) -> None:
        """Add a message to the queue; if the queue is full, drop the message and count it."""
        if self._queue.qsize() >= self._capacity or self._bytes >= QUEUE_BYTES:
            self._counts.overload += 1
            return
        with self._guard:
            self._bytes += len(message.payload)
        self._queue.put(message)

    def wake(self) -> None:
        """Let a thread that waits in `drain` for messages continue at once."""
        self._queue.put(None)

    def drain(self, wait_s: float) -> list[Message]:
        """Return the messages in the queue, at most as many as one processing step handles. Wait up
        to `wait_s` [s] for the first message, and until STEP_S after the previous call for more. A
        call of `wake` ends the first wait.
        """
        out: list[Message] = []
        size = 0
        try:
            if wait_s > 0:
                first = self._queue.get(timeout=wait_s)
                if first is not None:
                    out.append(first)
                    early_s = self._drained_at + STEP_S - monotonic()
                    if early_s > 0 and self._queue.qsize() < GATHERED:
                        sleep(early_s)
                    self._drained_at = monotonic()
            while len(out) < STEP_MESSAGES and size < STEP_BYTES:
                message = self._queue.get_nowait()
                if message is not None:
                    out.append(message)
                    size += len(message.payload)
        except queue.Empty:
            pass
        with self._guard:
            self._bytes -= sum(len(message.payload) for message in out)
        return out

    def __len__(self) -> int:
        return self._queue.qsize()


class AcceptedBatches(NamedTuple):
    """Accepted batches of one kind, and their rows for the archive (without the columns `late` and
    `weight`).
    """

    batches: list[BatchId]
    rows: Rows


class BatchIntake:
    """Intake of batches: decodes and validates messages, detects duplicates, and refuses invalid
    batches. Python code runs per message, not per row.

    Args:
        streams: accepted batches per stream (batches of one vehicle, start, kind and region);
            updated.
        pseudonyms: pseudonyms that replace the vehicles' names in the archive.
        counts: counts of the service; refusals are counted in `refused[RULE]`.
        acks: collects refusals, and acknowledgements of duplicates that are already durable.
        publishers: senders that report many places at once, so that their streams have no limit.
    """

    def __init__(
        self,
        streams: SequenceTrackers,
        pseudonyms: Pseudonyms,
        counts: ServiceCounts,
        acks: Acks,
        publishers: Collection[str] = (),
    ) -> None:
        self._streams = streams
        self._pseudonyms = pseudonyms
        self._counts = counts
        self._acks = acks
        self._publishers = publishers
        self._witnesses = VehicleIds(pseudonyms.folder)
        self._erased = erasures.read_erasures(pseudonyms.folder)
        self._budget = TokenBuckets(STREAMS_AT_ONCE, STREAMS_PER_HOUR)
        self._pending: set[BatchId] = set()  # batches that are accepted but not yet on disk
        self._known: dict[Kind, dict[tuple[str, int, int, int], SequenceTracker]] = {
            kind: {} for kind in Kind
        }
        self._forgot = 0
        self._now = 0.0
        # newest time that each vehicle reported in the last call [ns]
        self.times: dict[str, int] = {}

    def accept(self, messages: Sequence[Message], clock: Clock) -> dict[Kind, AcceptedBatches]:
        """Decode and check messages. Return the rows of those batches that are valid and new, by
        kind. Invalid batches are refused, and repeated ones are counted.
        """
        self.times.clear()
        self._now = clock.now / NS
        if abs(clock.now - self._forgot) > FORGET_NS:
            self._forget(clock)
        out = {}
        for kind in Kind:
            ours = [m for m in messages if m.kind is kind]
            if ours and (accepted := self._accept(kind, ours, clock)).batches:
                out[kind] = accepted
        return out

    def witness_of(self, name: str) -> int:
        """Return the permanent number by which the map knows a sender.

        Raises:
            OSError: the file that contains the secret key of these numbers can neither be read nor
                written.
        """
        return self._witnesses.number_of(name)

    def sync(self) -> None:
        """Write the numbers and pseudonyms (names in the archive) of the vehicles of accepted
        batches durably to disk.

        Raises:
            OSError: the disk is full or broken.
        """
        self._witnesses.sync()

    def acknowledge(self, batches: Sequence[BatchId]) -> None:
        """Queue acknowledgements for batches whose rows are now durable on disk."""
        self._pending.difference_update(batches)
        self._acks.record_durable(batches)

    def _accept(self, kind: Kind, messages: list[Message], clock: Clock) -> AcceptedBatches:
        found_owners = [validation.owner_of(message.key) for message in messages]
        if None in found_owners:
            self._count("key", found_owners.count(None))
            messages = [
                message
                for message, owner in zip(messages, found_owners, strict=True)
                if owner is not None
            ]
        found = decode_many(kind, [(message.payload, message.encoding) for message in messages])
        owners = [owner for owner in found_owners if owner is not None]
        for index, error in found.errors:
            self._refuse_unusable(kind, owners[index], messages[index], error)
        if found.errors:
            owners = [owners[index] for index in found.indices]
        time = found.columns[FIRST_TIME[kind]][np.cumsum(found.sizes) - found.sizes]
        broken, rules = validation.check_heads(kind, owners, found.heads, time, clock)
        self._record_times(owners, time)
        for place in np.flatnonzero(broken >= 0).tolist():
            refusal = rules[broken[place]]
            if validation.is_doubted(refusal, int(time[place]), clock):
                self._counts.clock_doubted += 1
            else:
                self._refuse(str(owners[place].name), found.heads.at(place), refusal)
        is_valid = broken < 0
        for place in np.flatnonzero(is_valid & self._is_erased(owners, time)).tolist():
            is_valid[place] = False
            self._refuse(str(owners[place].name), found.heads.at(place), validation.ERASED)
        new = self._select_new(kind, found.heads, time, is_valid)
        return self._admit_rows(kind, new, found, clock) if new else AcceptedBatches([], {})

    def _forget(self, clock: Clock) -> None:
        """Drop streams (batches of one vehicle, start and region) that are too old to matter. Also
        drop cached stream names of days before yesterday, because hardly any such data arrive.

        Active streams are not copied, because scattered copies would enlarge the process by some
        megabytes each time.
        """
        self._forgot = clock.now
        self._streams.forget(min(clock.horizon, self._streams.newest - KNOWN_NS))
        yesterday = clock.now // DAY_NS - 1
        for known in self._known.values():
            old = [
                name
                for name, stream in known.items()
                if name[3] < yesterday or stream.key not in self._streams
            ]
            for name in old:
                del known[name]

    def _is_erased(self, owners: Sequence[Parsed], time: IntArray) -> BoolArray:
        """Return a mask of batches (n,), True for a batch that must be refused because data of its
        time were erased: the data of all vehicles, or those of the vehicle that sent the batch.
        """
        out = erasures.in_spans(self._erased.months, time)
        if self._erased.vehicles:
            for place in np.flatnonzero(~out).tolist():
                # Without the month's key, `_select_new` does not accept the batch.
                with suppress(OSError):
                    pseudonym = self._pseudonyms.of(str(owners[place].name), int(time[place]))
                    out[place] = int(time[place]) < self._erased.vehicles.get(
                        pseudonym_number(pseudonym), 0
                    )
        return out

    def _record_times(self, owners: Sequence[Parsed], time: IntArray) -> None:
        for owner, measured in zip(owners, time.tolist(), strict=True):
            name = str(owner.name)
            self.times[name] = max(self.times.get(name, 0), measured)

    def _select_new(
        self, kind: Kind, heads: Heads, time: IntArray, is_valid: BoolArray
    ) -> dict[BatchId, int]:
        """Return the batches that are valid (mask `is_valid`) and that were not accepted before,
        each once, with their positions in `heads` (fields of the batches other than records).
        """
        out: dict[BatchId, int] = {}
        numbers = (heads.boot, heads.region, time // DAY_NS, heads.seq, heads.first_held)
        batches = zip(
            range(len(is_valid)),
            heads.vehicle,
            *(column.tolist() for column in numbers),
            strict=True,
        )
        known = self._known[kind]
        pending = self._pending
        again = 0
        for place, vehicle, boot, region, day, seq, first_held in compress(
            batches, is_valid.tolist()
        ):
            name = vehicle, boot, region, day
            stream = known.get(name) or self._look_up(kind, name, int(time[place]))
            if stream is None:
                continue
            stream.raise_to(first_held)
            batch = stream, seq
            if stream.has_accepted(seq):
                again += 1
                if batch not in pending:
                    self._acks.record_durable([batch])
            elif batch in out:
                again += 1
            else:
                out[batch] = place
        if again:
            self._counts.duplicates += again
        return out

    def _look_up(
        self, kind: Kind, name: tuple[str, int, int, int], time: int
    ) -> SequenceTracker | None:
        """Return the stream of a (vehicle, start, region, day): the record of its accepted batches.
        Return None in two cases, in which the vehicle keeps its batch and sends it again later:

        - The key for the vehicle's pseudonym cannot be read. A batch is accepted when the disk
        works again.
        - The vehicle has opened too many streams. It may open STREAMS_PER_HOUR more every hour.
        """
        vehicle, boot, region, _ = name
        try:
            pseudonym = pseudonym_number(self._pseudonyms.of(vehicle, time))
            boot_pseudonym = self._pseudonyms.boot(vehicle, boot, time)
            witness = self._witnesses.id_of(vehicle, self._pseudonyms.month(time), pseudonym)
        except OSError:
            self._counts.key_failures += 1
            return None
        key = (pseudonym, boot, kind, region)
        if key not in self._streams:  # older archives contain the unchanged start numbers
            key = (pseudonym, boot_pseudonym, kind, region)
        is_limited = key not in self._streams and vehicle not in self._publishers
        if is_limited and not self._budget.take(witness, 1, self._now):
            self._counts.too_many_streams += 1
            return None
        stream = self._streams[key]
        self._known[kind][name] = stream
        stream.vehicle = vehicle
        stream.boot = boot
        stream.witness = witness
        return stream

    def _admit_rows(
        self, kind: Kind, new: dict[BatchId, int], found: Decoded, clock: Clock
    ) -> AcceptedBatches:
        batches = list(new)
        rows, heads, sizes = _select_batches(found, list(new.values()))
        rows["region"] = np.repeat(heads.region, sizes)
        broken, rules = validation.check_rows(kind, rows, rows["region"], clock)
        rows["row"] = np.arange(len(rows["region"]), dtype=np.int32)
        rows["row"] -= np.repeat((np.cumsum(sizes) - sizes).astype(np.int32), sizes)
        is_valid = np.ones(len(batches), bool)
        owner = np.repeat(np.arange(len(batches)), sizes)
        # Only refused rows are processed one by one.
        for index in np.flatnonzero(broken >= 0).tolist():
            place = int(owner[index])
            if is_valid[place]:
                is_valid[place] = False
                refusal = rules[broken[index]]._replace(row=int(rows["row"][index]))
                if validation.is_doubted(refusal, int(rows[TIME[kind]][index]), clock):
                    self._counts.clock_doubted += 1
                else:
                    self._refuse(batches[place][0].vehicle, heads.at(place), refusal)
        for place in np.flatnonzero(
            validation.too_long(rows[TIME[kind]], sizes) & is_valid
        ).tolist():
            is_valid[place] = False
            self._refuse(batches[place][0].vehicle, heads.at(place), validation.TOO_LONG)
        newest = _newest_times(rows[FIRST_TIME[kind]], sizes).tolist()
        for place, at in compress(enumerate(newest), is_valid.tolist()):
            stream, seq = batches[place]
            # If there is no space to record the batch, older batches must come first. The batch is
            # not rejected, so the sender repeats it.
            if not stream.accept(seq, at):
                self._counts.too_many_gaps += 1
                is_valid[place] = False
        if not is_valid.all():
            rows = {name: column[is_valid[owner]] for name, column in rows.items()}
            batches = list(compress(batches, is_valid))
            heads = heads.take(is_valid)
            sizes = sizes[is_valid]
        self._pending.update(batches)
        return AcceptedBatches(batches, _with_identity(kind, batches, heads, rows, sizes, clock))

    def _refuse(self, vehicle: str, head: Head, refusal: Refusal) -> None:
        # A batch that breaks the rule "vehicle" names another vehicle than its sender. A rejection
        # would stop the batches of that vehicle.
        if refusal.rule != "vehicle":
            self._acks.record_rejected(vehicle, head, refusal.row, refusal.reason)
        self._count(refusal.rule)

    def _refuse_unusable(
        self, kind: Kind, owner: Parsed, message: Message, error: InputError
    ) -> None:
        """Refuse a batch whose records cannot be used. If its sender and sequence number can be
        read, send a rejection, because otherwise the vehicle would send the batch for ever. If they
        cannot be read, only count the refusal.
        """
        head = head_of(kind, message.payload, message.encoding)
        region = owner.quadint
        if (
            head is not None
            and region is not None
            and head.vehicle == owner.name
            and head.region in (0, region)
            and head.boot >= 0
            and head.seq >= 1
        ):
            self._acks.record_rejected(
                head.vehicle,
                head._replace(region=region),
                validation.BATCH,
                str(error)[:150],
            )
        self._count(error.field)

    def _count(self, rule: str, times: int = 1) -> None:
        if times:
            self._counts.refused[rule] += times


def _newest_times(time: IntArray, sizes: IntArray) -> IntArray:
    """Return the time of the newest record of each batch (k,) [ns], rounded as in the archive, so
    that a restart computes the same times.
    """
    newest = np.maximum.reduceat(time, np.cumsum(sizes) - sizes)
    return np.asarray(newest // US_STEP * US_STEP)


def _select_batches(found: Decoded, indices: list[int]) -> tuple[Rows, Heads, IntArray]:
    """Return rows, heads (other fields) and numbers of rows of the batches at the positions
    `indices` (ascending).
    """
    rows: Rows = {**found.columns, "with_likelihood": found.with_likelihood}
    if len(indices) == len(found.sizes):
        return rows, found.heads, found.sizes
    kept = np.zeros(len(found.sizes), bool)
    kept[indices] = True
    mine = np.repeat(kept, found.sizes)
    return (
        {name: column[mine] for name, column in rows.items()},
        found.heads.take(kept),
        found.sizes[kept],
    )


def _with_identity(
    kind: Kind, batches: list[BatchId], heads: Heads, rows: Rows, sizes: IntArray, clock: Clock
) -> Rows:
    """Add to the rows the columns that identify their batches (vehicle, start, region, sequence
    number), in the form in which the archive stores them; return all columns.
    """
    numbers = np.array([stream.key[0] for stream, _ in batches], np.int64)
    identity = {
        "vehicle": pseudonym_texts(numbers),
        "witness": np.array([stream.witness for stream, _ in batches], np.int64),
        "estimator": np.array(heads.estimator, np.bytes_),
        "boot": np.array([stream.key[1] for stream, _ in batches], np.int64),
        "seq": heads.seq,
        "first_held": heads.first_held,
    }
    rows |= {name: np.repeat(values, sizes) for name, values in identity.items()}
    rows["received_at"] = np.full(len(rows["row"]), clock.now, np.int64)
    if kind is Kind.STATE:
        rows["cell"] = cell_of(rows["latitude"], rows["longitude"])
    return round_to_steps(rows)
