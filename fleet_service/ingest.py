"""Messages in: a bounded queue behind the Zenoh subscribers, and the way from bytes to admitted rows.

The subscriber's callback only copies bytes into the queue. When the queue is full the message is dropped and counted;
it is not acknowledged, so that its sender keeps it and sends it again: that is the back-pressure.
"""

from __future__ import annotations

import queue
from collections import Counter, defaultdict
from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import numpy as np
import zenoh

from fleet_service import admit
from fleet_service.acks import Acks
from fleet_service.admit import Clock, Refusal, StreamKey, Streams
from fleet_service.archive.pseudonyms import Pseudonyms, number
from fleet_service.archive.segments import Rows
from schemas.errors import WireError
from schemas.grid import cell_of
from schemas.wire import Batch, Kind, decode


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
    """

    def __init__(self, capacity: int, counts: Counter[str]) -> None:
        self._queue: queue.Queue[Message] = queue.Queue(capacity)
        self._counts = counts

    def callback(self, kind: Kind) -> Callable[[zenoh.Sample], None]:
        """The subscriber's callback for one kind."""

        def take(sample: zenoh.Sample) -> None:
            if sample.kind == zenoh.SampleKind.PUT:
                self.put(Message(kind, str(sample.key_expr), sample.payload.to_bytes(), str(sample.encoding)))

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
    """A decoded batch that is new."""

    vehicle: str
    pseudonym: str
    batch: Batch


class Admitted(NamedTuple):
    """Batches of one kind that were let in, and their rows as the archive wants them (without `late` and `weight`)."""

    candidates: list[Candidate]
    rows: Rows


class Intake:
    """Decodes, asks the questions of `admit`, counts and settles refusals.

    Args:
        streams: what was admitted before; is brought up to date.
        pseudonyms: of the vehicles.
        counts: refusals by rule, under `refused.RULE`, and duplicates.
        acks: takes the refusals and what is durable already.
    """

    def __init__(self, streams: Streams, pseudonyms: Pseudonyms, counts: Counter[str], acks: Acks) -> None:
        self._streams, self._pseudonyms, self._counts, self._acks = streams, pseudonyms, counts, acks

    def admit(self, messages: Sequence[Message], clock: Clock) -> dict[Kind, Admitted]:
        """Rows of the good and new batches, by kind."""
        fresh: dict[Kind, dict[tuple[StreamKey, int], Candidate]] = defaultdict(dict)
        for message in messages:
            candidate = self._candidate(message, clock)
            if candidate is not None:
                batch = candidate.batch
                if fresh[batch.kind].setdefault((self._stream(candidate), batch.seq), candidate) is not candidate:
                    self._counts["duplicates"] += 1
        return {kind: self._rows(kind, list(found.values()), clock) for kind, found in fresh.items() if found}

    def settled(self, candidates: Sequence[Candidate]) -> None:
        """The candidates' rows are on disk: acknowledge them."""
        for candidate in candidates:
            self._streams[self._stream(candidate)].pending.discard(candidate.batch.seq)
            self._acks.durable(candidate.vehicle, candidate.batch)

    @staticmethod
    def _stream(candidate: Candidate) -> StreamKey:
        batch = candidate.batch
        return number(candidate.pseudonym), batch.boot, batch.kind, batch.region

    def _candidate(self, message: Message, clock: Clock) -> Candidate | None:
        owner = admit.owner_of(message.key)
        if owner is None or owner.who is None:
            self._count("key")
            return None
        try:
            batch = decode(message.payload, message.encoding, message.kind)
        except WireError as error:
            self._count(error.field)
            return None
        vehicle, refusal = owner.who, admit.check_identity(owner, batch) or _untimely(batch, clock)
        if refusal is not None:
            self._refuse(vehicle, batch, refusal)
            return None
        try:
            pseudonym = self._pseudonyms.of(vehicle, _time(batch))
        except OSError:  # no key, no row: the sender keeps the batch until the disk is well again
            self._counts["key_failures"] += 1
            return None
        candidate = Candidate(vehicle, pseudonym, batch)
        stream = self._streams[self._stream(candidate)]
        stream.raise_to(batch.first_held)
        if stream.admitted(batch.seq):
            self._counts["duplicates"] += 1
            if batch.seq not in stream.pending:
                self._acks.durable(vehicle, batch)
            return None
        return candidate

    def _rows(self, kind: Kind, candidates: list[Candidate], clock: Clock) -> Admitted:
        columns = [admit.rows_of(c.batch) for c in candidates]
        sizes = np.array([c.batch.rows for c in candidates])
        rows: Rows = {name: np.concatenate([column[name] for column in columns]) for name in columns[0]}
        owner = np.repeat(np.arange(len(candidates)), sizes)
        rows["region"] = np.array([c.batch.region for c in candidates], np.int64)[owner]
        broken, rules = admit.check_rows(kind, rows, rows["region"], clock)
        starts = np.cumsum(sizes) - sizes
        rows["row"] = (np.arange(len(owner)) - starts[owner]).astype(np.int32)
        bad: set[int] = set()
        for index in np.flatnonzero(broken >= 0).tolist():  # only refused rows are visited one by one
            if int(owner[index]) not in bad:
                bad.add(int(owner[index]))
                refusal = rules[broken[index]]._replace(row=int(rows["row"][index]))
                self._refuse(candidates[owner[index]].vehicle, candidates[owner[index]].batch, refusal)
        for place, candidate in enumerate(candidates):
            if place not in bad and not self._note(candidate):
                bad.add(place)
        return self._kept(kind, candidates, rows, owner, bad, clock)

    def _note(self, candidate: Candidate) -> bool:
        stream, batch = self._streams[self._stream(candidate)], candidate.batch
        if not stream.admit(batch.seq):
            reason = "seq: too far beyond first_held; settle older batches first"
            self._refuse(candidate.vehicle, batch, Refusal("seq", admit.BATCH, reason))
            return False
        stream.pending.add(batch.seq)
        return True

    def _kept(
        self,
        kind: Kind,
        candidates: list[Candidate],
        rows: Rows,
        owner: np.ndarray[Any, Any],
        bad: set[int],
        clock: Clock,
    ) -> Admitted:
        batches = [c.batch for c in candidates]
        rows["vehicle"] = np.array([c.pseudonym for c in candidates])[owner]
        rows["vehicle_number"] = np.array([number(c.pseudonym) for c in candidates], np.int64)[owner]
        rows["estimator"] = np.array([b.estimator[:64] for b in batches])[owner]
        for name in ("boot", "seq", "first_held"):
            rows[name] = np.array([getattr(b, name) for b in batches], np.int64)[owner]
        rows["received_at"] = np.full(len(owner), clock.now, np.int64)
        if bad:
            good = ~np.isin(owner, list(bad))
            rows = {name: column[good] for name, column in rows.items()}
        if kind is Kind.STATE:
            rows["cell"] = cell_of(rows["latitude"], rows["longitude"])
        return Admitted([c for place, c in enumerate(candidates) if place not in bad], rows)

    def _refuse(self, vehicle: str, batch: Batch, refusal: Refusal) -> None:
        if refusal.rule != "vehicle":  # else the name in the batch is not the sender's, and nor is the stream
            self._acks.rejected(vehicle, batch, refusal.row, refusal.reason)
        self._count(refusal.rule)

    def _count(self, rule: str) -> None:
        self._counts[f"refused.{rule}"] += 1


def _time(batch: Batch) -> int:
    return int(batch.columns["enter_time" if batch.kind is Kind.OBSERVATION else "time"][0])


def _untimely(batch: Batch, clock: Clock) -> Refusal | None:
    if clock.now - clock.oldest <= _time(batch) <= clock.now + clock.ahead:
        return None
    return Refusal("time", 0, "time: too old or in the future; set the clock")
