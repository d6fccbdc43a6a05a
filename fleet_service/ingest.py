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
from fleet_service.streams import StreamKey, Streams
from schemas import keys
from schemas.decoding import Decoded, Head, decode_many
from schemas.grid import cell_of
from schemas.numeric import IntArray
from schemas.wire import Kind

FIRST_TIME: Final = {Kind.OBSERVATION: "enter_time", Kind.STATE: "time"}  # by which a batch is too old
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

    def drain(self, wait_s: float, most: int) -> list[Message]:
        """What is there, at most `most`; waits up to `wait_s` for the first."""
        out: list[Message] = []
        try:
            out.append(self._queue.get(timeout=wait_s) if wait_s > 0 else self._queue.get_nowait())
            while len(out) < most:
                out.append(self._queue.get_nowait())
        except queue.Empty:
            pass
        return out

    def __len__(self) -> int:
        return self._queue.qsize()


class Candidate(NamedTuple):
    """A decoded batch that is new: its sender, its stream, what it says of itself, and the time of its first record."""

    vehicle: str
    pseudonym: str
    stream: StreamKey
    head: Head
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
        self._forgot = 0

    def admit(self, messages: Sequence[Message], clock: Clock) -> dict[Kind, Admitted]:
        """Rows of the good and new batches, by kind."""
        if clock.now - self._forgot > FORGET_NS:
            self._forgot = clock.now
            self._streams.forget(clock.now - clock.oldest)
        out = {}
        for kind in Kind:
            ours = [m for m in messages if m.kind is kind]
            if ours and (admitted := self._admit(kind, ours, clock)).candidates:
                out[kind] = admitted
        return out

    def settled(self, candidates: Sequence[Candidate]) -> None:
        """The candidates' rows are on disk: acknowledge them."""
        for candidate in candidates:
            self._pending.discard((candidate.stream, candidate.head.seq))
            self._acks.durable(candidate.vehicle, candidate.head)

    def _admit(self, kind: Kind, messages: list[Message], clock: Clock) -> Admitted:
        owners = [admit.owner_of(message.key) for message in messages]
        self._count("key", owners.count(None))
        known = [at for at, owner in enumerate(owners) if owner is not None]
        found = decode_many(kind, [(messages[at].payload, messages[at].encoding) for at in known])
        for _, error in found.errors:
            self._count(error.field)
        starts = np.cumsum(found.sizes) - found.sizes
        times: list[int] = found.columns[FIRST_TIME[kind]][starts].tolist()
        candidates: dict[tuple[StreamKey, int], Candidate] = {}
        chosen: list[int] = []
        for at, (place, head, time) in enumerate(zip(found.places, found.heads, times, strict=True)):
            candidate = self._candidate(owners[known[place]], head, time, clock)
            if candidate is not None:
                if candidates.setdefault((candidate.stream, head.seq), candidate) is candidate:
                    chosen.append(at)
                else:
                    self._counts["duplicates"] += 1
        return self._rows(kind, list(candidates.values()), found, chosen, clock)

    def _candidate(self, owner: keys.Parsed | None, head: Head, time: int, clock: Clock) -> Candidate | None:
        assert owner is not None
        assert owner.who is not None
        refusal = admit.check_identity(owner, head)
        if refusal is None and not clock.now - clock.oldest <= time <= clock.now + clock.ahead:
            refusal = Refusal("time", 0, "time: too old or in the future; set the clock")
        if refusal is not None:
            self._refuse(owner.who, head, refusal)
            return None
        try:
            pseudonym = self._pseudonyms.of(owner.who, time)
        except OSError:  # no key, no row: the sender keeps the batch until the disk is well again
            self._counts["key_failures"] += 1
            return None
        name = (number(pseudonym), head.boot, head.kind, head.region)
        stream = self._streams[name]
        stream.raise_to(head.first_held)
        if stream.admitted(head.seq):
            self._counts["duplicates"] += 1
            if (name, head.seq) not in self._pending:
                self._acks.durable(owner.who, head)
            return None
        return Candidate(owner.who, pseudonym, name, head, time)

    def _rows(
        self, kind: Kind, candidates: list[Candidate], found: Decoded, chosen: list[int], clock: Clock
    ) -> Admitted:
        rows, sizes = _chosen(found, chosen)
        owner = np.repeat(np.arange(len(candidates)), sizes)
        rows["region"] = np.array([c.head.region for c in candidates], np.int64)[owner]
        broken, rules = admit.check_rows(kind, rows, rows["region"], clock)
        rows["row"] = (np.arange(len(owner)) - (np.cumsum(sizes) - sizes)[owner]).astype(np.int32)
        bad: set[int] = set()
        for index in np.flatnonzero(broken >= 0).tolist():  # only refused rows are visited one by one
            if int(owner[index]) not in bad:
                bad.add(int(owner[index]))
                refusal = rules[broken[index]]._replace(row=int(rows["row"][index]))
                self._refuse(candidates[owner[index]].vehicle, candidates[owner[index]].head, refusal)
        bad.update(place for place, c in enumerate(candidates) if place not in bad and not self._note(c))
        if bad:
            good = np.array([place not in bad for place in range(len(candidates))], bool)
            rows = {name: column[good[owner]] for name, column in rows.items()}
            candidates, sizes = list(compress(candidates, good)), sizes[good]
        return Admitted(candidates, _named(kind, candidates, rows, sizes, clock))

    def _note(self, candidate: Candidate) -> bool:
        """Whether there is room to remember the batch; without, it is not acknowledged: older ones must come first."""
        seq = candidate.head.seq
        if not self._streams[candidate.stream].admit(seq, candidate.time):
            self._counts["too_many_gaps"] += 1
            return False
        self._pending.add((candidate.stream, seq))
        return True

    def _refuse(self, vehicle: str, head: Head, refusal: Refusal) -> None:
        if refusal.rule != "vehicle":  # else the name in the batch is not the sender's, and nor is the stream
            self._acks.rejected(vehicle, head, refusal.row, refusal.reason)
        self._count(refusal.rule)

    def _count(self, rule: str, times: int = 1) -> None:
        if times:
            self._counts[f"refused.{rule}"] += times


def _chosen(found: Decoded, chosen: list[int]) -> tuple[Rows, IntArray]:
    """Rows of the chosen batches, and the sizes of these."""
    rows: Rows = {**found.columns, "told": found.told}
    if len(chosen) == len(found.sizes):
        return rows, found.sizes
    kept = np.zeros(len(found.sizes), bool)
    kept[chosen] = True
    mine = np.repeat(kept, found.sizes)
    return {name: column[mine] for name, column in rows.items()}, found.sizes[kept]


def _named(kind: Kind, candidates: list[Candidate], rows: Rows, sizes: IntArray, clock: Clock) -> Rows:
    """Rows with what their batches say of themselves, as the archive wants them."""
    owner = np.repeat(np.arange(len(candidates)), sizes)
    heads = [c.head for c in candidates]
    rows["vehicle"] = np.array([c.pseudonym for c in candidates], np.str_)[owner]
    rows["vehicle_number"] = np.array([c.stream[0] for c in candidates], np.int64)[owner]
    rows["estimator"] = np.array([head.estimator[:64] for head in heads], np.str_)[owner]
    for name in ("boot", "seq", "first_held"):
        rows[name] = np.array([getattr(head, name) for head in heads], np.int64)[owner]
    rows["received_at"] = np.full(len(owner), clock.now, np.int64)
    if kind is Kind.STATE:
        rows["cell"] = cell_of(rows["latitude"], rows["longitude"])
    return stepped(rows)
