"""Messages in: a bounded queue behind the Zenoh subscribers, and the way from bytes to admitted rows.

The subscriber's callback only copies bytes into the queue. When the queue is full the message is dropped and counted;
it is not acknowledged, so that its sender keeps it and sends it again: that is the back-pressure.
"""

from __future__ import annotations

import queue
from collections import Counter
from collections.abc import Callable, Sequence
from itertools import compress
from typing import Final, NamedTuple

import numpy as np
import zenoh

from fleet_service import admit
from fleet_service.acks import Acks
from fleet_service.admit import Clock, Refusal
from fleet_service.archive.pseudonyms import Pseudonyms, number
from fleet_service.archive.segments import Rows, stepped
from fleet_service.limits import Limits
from fleet_service.streams import Stream, StreamKey, Streams
from schemas.decoding import Decoded, Head, Heads, decode_many
from schemas.grid import cell_of
from schemas.numeric import BoolArray, IntArray
from schemas.wire import Kind

FIRST_TIME: Final = {Kind.OBSERVATION: "enter_time", Kind.STATE: "time"}  # by which a batch is too old
# Of a turn of the worker, so that a flood does not delay alerts, answers and segments by more than a moment. Most of
# the work is by the record, of which 160 bytes are one.
TURN_MESSAGES: Final = 4096
TURN_BYTES: Final = 768 * 1024
DAY_NS: Final = 86_400 * 10**9
FORGET_NS: Final = 600 * 10**9  # between two looks for streams too old to matter


class Message(NamedTuple):
    """One sample of a subscriber."""

    kind: Kind
    key: str
    payload: bytes
    encoding: str


class Inbox:
    """The bounded queue.

    Args:
        capacity: messages at the most.
        counts: where drops are counted, under `overload`.
        limits: who may send how much.
    """

    def __init__(self, capacity: int, counts: Counter[str], limits: Limits) -> None:
        self._queue: queue.Queue[Message] = queue.Queue(capacity)
        self._counts, self._limits = counts, limits

    def callback(self, kind: Kind) -> Callable[[zenoh.Sample], None]:
        """The subscriber's callback for one kind."""

        def take(sample: zenoh.Sample) -> None:
            key = str(sample.key_expr)
            if sample.kind == zenoh.SampleKind.PUT and self._limits.lets(key, len(sample.payload)):
                self.put(Message(kind, key, sample.payload.to_bytes(), str(sample.encoding)))

        return take

    def put(self, message: Message) -> None:
        """Enqueue, or drop and count."""
        try:
            self._queue.put_nowait(message)
        except queue.Full:
            self._counts["overload"] += 1

    def drain(self, wait_s: float) -> list[Message]:
        """What is there, as much as a turn takes; waits up to `wait_s` for the first."""
        out: list[Message] = []
        size = 0
        try:
            out.append(self._queue.get(timeout=wait_s) if wait_s > 0 else self._queue.get_nowait())
            while len(out) < TURN_MESSAGES and size < TURN_BYTES:
                out.append(self._queue.get_nowait())
                size += len(out[-1].payload)
        except queue.Empty:
            pass
        return out

    def __len__(self) -> int:
        return self._queue.qsize()


class Candidate(NamedTuple):
    """A decoded batch that is new: its place among the decoded, sender, stream, and the time of its first record."""

    place: int
    vehicle: str
    pseudonym: str
    name: StreamKey
    stream: Stream
    seq: int
    time: int


class Admitted(NamedTuple):
    """Batches of one kind that were let in, and their rows as the archive wants them (without `late` and `weight`)."""

    candidates: list[Candidate]
    rows: Rows


class Intake:
    """Decodes, asks the questions of `admit`, counts and settles refusals. Python is touched per message, not per row.

    Args:
        streams: what was admitted before; is brought up to date.
        pseudonyms: of the vehicles.
        counts: refusals by rule, under `refused.RULE`, and duplicates.
        acks: takes the refusals and what is durable already.
    """

    def __init__(self, streams: Streams, pseudonyms: Pseudonyms, counts: Counter[str], acks: Acks) -> None:
        self._streams, self._pseudonyms, self._counts, self._acks = streams, pseudonyms, counts, acks
        self._pending: set[tuple[StreamKey, int]] = set()  # admitted, not yet on disk
        self._known: dict[tuple[str, int], tuple[str, int]] = {}  # pseudonyms and their numbers, by vehicle and day
        self._forgot = 0

    def admit(self, messages: Sequence[Message], clock: Clock) -> dict[Kind, Admitted]:
        """Rows of the good and new batches, by kind."""
        if clock.now - self._forgot > FORGET_NS:
            self._forgot = clock.now
            self._streams.forget(clock.now - clock.oldest)
            self._known.clear()
        out = {}
        for kind in Kind:
            ours = [m for m in messages if m.kind is kind]
            if ours and (admitted := self._admit(kind, ours, clock)).candidates:
                out[kind] = admitted
        return out

    def settled(self, candidates: Sequence[Candidate]) -> None:
        """The candidates' rows are on disk: acknowledge them."""
        for candidate in candidates:
            self._pending.discard((candidate.name, candidate.seq))
            self._acks.durable(candidate.vehicle, candidate.name[1:], candidate.seq)

    def _admit(self, kind: Kind, messages: list[Message], clock: Clock) -> Admitted:
        keyed = [(message, owner) for message in messages if (owner := admit.owner_of(message.key)) is not None]
        self._count("key", len(messages) - len(keyed))
        found = decode_many(kind, [(message.payload, message.encoding) for message, _ in keyed])
        for _, error in found.errors:
            self._count(error.field)
        time = found.columns[FIRST_TIME[kind]][np.cumsum(found.sizes) - found.sizes]
        owners = [keyed[place][1] for place in found.places]
        broken, rules = admit.check_heads(kind, owners, found.heads, time, clock)
        for place in np.flatnonzero(broken >= 0).tolist():
            self._refuse(str(owners[place].who), found.heads.at(place), rules[broken[place]])
        return self._rows(kind, self._new(kind, found.heads, time, broken < 0), found, clock)

    def _new(self, kind: Kind, heads: Heads, time: IntArray, good: BoolArray) -> list[Candidate]:
        """Those of the good batches that were not admitted before, each once."""
        out: dict[tuple[StreamKey, int], Candidate] = {}
        numbers = (heads.boot, heads.region, heads.seq, heads.first_held, time, time // DAY_NS)
        batches = zip(range(len(good)), heads.vehicle, *(column.tolist() for column in numbers), strict=True)
        known, streams, pending, again = self._known, self._streams, self._pending, 0
        for place, vehicle, boot, region, seq, first_held, at, day in compress(batches, good.tolist()):
            who = known.get((vehicle, day)) or self._look_up(vehicle, at, day)
            if who is None:
                continue
            pseudonym, of = who
            name = (of, boot, kind, region)
            stream = streams[name]
            stream.raise_to(first_held)
            if stream.admitted(seq):
                again += 1
                if (name, seq) not in pending:
                    self._acks.durable(vehicle, name[1:], seq)
            elif (name, seq) in out:
                again += 1
            else:
                out[name, seq] = Candidate(place, vehicle, pseudonym, name, stream, seq, at)
        if again:
            self._counts["duplicates"] += again
        return list(out.values())

    def _look_up(self, vehicle: str, time: int, day: int) -> tuple[str, int] | None:
        """Pseudonym and number of a vehicle; None without a key: it keeps its batch until the disk is well again."""
        try:
            pseudonym = self._pseudonyms.of(vehicle, time)
        except OSError:
            self._counts["key_failures"] += 1
            return None
        found = self._known[vehicle, day] = pseudonym, number(pseudonym)
        return found

    def _rows(self, kind: Kind, candidates: list[Candidate], found: Decoded, clock: Clock) -> Admitted:
        rows, heads, sizes = _chosen(found, candidates)
        owner = np.repeat(np.arange(len(candidates)), sizes)
        rows["region"] = heads.region[owner]
        broken, rules = admit.check_rows(kind, rows, rows["region"], clock)
        rows["row"] = (np.arange(len(owner)) - (np.cumsum(sizes) - sizes)[owner]).astype(np.int32)
        bad: set[int] = set()
        for index in np.flatnonzero(broken >= 0).tolist():  # only refused rows are visited one by one
            place = int(owner[index])
            if place not in bad:
                bad.add(place)
                refusal = rules[broken[index]]._replace(row=int(rows["row"][index]))
                self._refuse(candidates[place].vehicle, heads.at(place), refusal)
        bad.update(place for place, c in enumerate(candidates) if place not in bad and not self._note(c))
        if bad:
            good = np.array([place not in bad for place in range(len(candidates))], bool)
            rows = {name: column[good[owner]] for name, column in rows.items()}
            candidates, heads, sizes = list(compress(candidates, good)), heads.take(good), sizes[good]
        return Admitted(candidates, _named(kind, candidates, heads, rows, sizes, clock))

    def _note(self, candidate: Candidate) -> bool:
        """Whether there is room to remember the batch; without, it is not acknowledged: older ones must come first."""
        if not candidate.stream.admit(candidate.seq, candidate.time):
            self._counts["too_many_gaps"] += 1
            return False
        self._pending.add((candidate.name, candidate.seq))
        return True

    def _refuse(self, vehicle: str, head: Head, refusal: Refusal) -> None:
        if refusal.rule != "vehicle":  # else the name in the batch is not the sender's, and nor is the stream
            self._acks.rejected(vehicle, head, refusal.row, refusal.reason)
        self._count(refusal.rule)

    def _count(self, rule: str, times: int = 1) -> None:
        if times:
            self._counts[f"refused.{rule}"] += times


def _chosen(found: Decoded, candidates: list[Candidate]) -> tuple[Rows, Heads, IntArray]:
    """Rows, heads and sizes of the chosen batches."""
    rows: Rows = {**found.columns, "told": found.told}
    if len(candidates) == len(found.sizes):
        return rows, found.heads, found.sizes
    kept = np.zeros(len(found.sizes), bool)
    kept[[candidate.place for candidate in candidates]] = True
    mine = np.repeat(kept, found.sizes)
    return {name: column[mine] for name, column in rows.items()}, found.heads.take(kept), found.sizes[kept]


def _named(kind: Kind, candidates: list[Candidate], heads: Heads, rows: Rows, sizes: IntArray, clock: Clock) -> Rows:
    """Rows with what their batches say of themselves, as the archive wants them."""
    owner = np.repeat(np.arange(len(candidates)), sizes)
    rows["vehicle"] = np.array([c.pseudonym for c in candidates], np.str_)[owner]
    rows["vehicle_number"] = np.array([c.name[0] for c in candidates], np.int64)[owner]
    rows["estimator"] = np.array([name[:64] for name in heads.estimator], np.str_)[owner]
    rows |= {"boot": heads.boot[owner], "seq": heads.seq[owner], "first_held": heads.first_held[owner]}
    rows["received_at"] = np.full(len(owner), clock.now, np.int64)
    if kind is Kind.STATE:
        rows["cell"] = cell_of(rows["latitude"], rows["longitude"])
    return stepped(rows)
