"""Schedule that decides when the batches of an outbox (store on disk) are sent again. There is one
`Pacer` (limit of unanswered batches) per vehicle and region, and a time limit for each batch that
was sent and not answered. The module is pure (no I/O); time is monotonic [s].
"""

from __future__ import annotations

import heapq
import random
from collections.abc import Collection, Iterator
from typing import Final

from edge_agent.publish.held_batches import HeldBatch, HeldBatches, Stream
from edge_agent.publish.pacing import Pacer

# [s] time to the first resend. A service writes a segment each second, so an answer may arrive
# until then.
FIRST_RESEND_S: Final = 2.0
# [s] longest time to a resend if the service answers; see `pacing` for a silent service.
LONGEST_RESEND_S: Final = 6.0
# Relative random change of each delay, in both directions. Agents that lost the same router
# therefore do not return at the same moment.
JITTER: Final = 0.25


class ResendSchedule:
    """Schedule of the batches in `held`, the index of the outbox. It knows which batches are in
    flight (sent and not answered), and when they are sent again.
    """

    def __init__(self, held: HeldBatches, first_resend_s: float, seed: int) -> None:
        self.first_resend_s = first_resend_s
        self._held = held
        self._random = random.Random(seed)
        self._pacers: dict[tuple[str, int], Pacer] = {}
        # heap of (time at which a batch in flight counts as lost [s], key)
        self._due_heap: list[tuple[float, int]] = []

    def remove_all(self) -> None:
        """Remove all batches from the schedule."""
        self._pacers = {}
        self._due_heap = []

    def _pacer_of(self, batch: HeldBatch) -> Pacer:
        return self._pacers.setdefault((batch.stream.vehicle, batch.stream.region), Pacer())

    def _random_jitter(self) -> float:
        return self._random.uniform(1 - JITTER, 1 + JITTER)

    def queue_batch(self, key: int) -> None:
        """Queue the batch with the row number `key`. It is sent as soon as its pacer allows."""
        self._pacer_of(self._held[key]).queue_batch(key)

    def mark_in_flight(self, key: int, now: float) -> None:
        """Mark the batch with the row number `key` as in flight at time `now` [s], and set the time
        of its next resend.
        """
        batch = self._held[key]
        delay = min(
            max(LONGEST_RESEND_S, self.first_resend_s),
            self.first_resend_s * 2.0 ** min(batch.attempts, 16),
        )
        batch.attempts += 1
        batch.due = now + delay * self._random_jitter()
        heapq.heappush(self._due_heap, (batch.due, key))
        self._pacer_of(batch).record_sent(now)

    def send_or_queue(self, key: int, now: float) -> bool:
        """Mark the new batch with the row number `key` as in flight, and return True. If the
        service of the batch's region is silent, queue the batch and return False.
        """
        if self._pacer_of(self._held[key]).is_silent:
            self.queue_batch(key)
            return False
        self.mark_in_flight(key, now)
        return True

    def record_answer(self, stream: Stream) -> None:
        """Record that the service of a region acknowledged any batch of a vehicle. Vehicle and
        region are those of `stream`.
        """
        pacer = self._pacers.get((stream.vehicle, stream.region))
        if pacer is not None:
            pacer.record_answer()

    def record_removal(self, batch: HeldBatch) -> None:
        """Record that a batch (message with records) was removed from the outbox. If it was in
        flight, it counts as answered.
        """
        if batch.due is not None:
            self._pacer_of(batch).record_settled()

    def reset_in_flight(self, vehicle: str, now: float) -> None:
        """Treat all batches of a vehicle that are in flight as lost, because the vehicle has just
        reconnected.
        """
        for (name, _), pacer in self._pacers.items():
            if name == vehicle:
                pacer.record_reconnect(now)
        for _, key in self._due_heap:
            if key not in self._held:
                continue
            batch = self._held[key]
            if batch.stream.vehicle == vehicle and batch.due is not None:
                batch.due = None
                batch.attempts = 0
                self.queue_batch(key)

    def expire_batches(self, now: float) -> Iterator[int]:
        """Queue the batches that were not answered before `now` [s], so that they are sent again.

        A batch that the service seems to ignore (`HeldBatches.is_passed_over`) is not queued. Its
        key is yielded, and the caller must remove this batch from the outbox before requesting the
        next key.
        """
        while self._due_heap and self._due_heap[0][0] <= now:
            at, key = heapq.heappop(self._due_heap)
            if key not in self._held or self._held[key].due != at:
                continue
            batch = self._held[key]
            batch.due = None
            self._pacer_of(batch).record_timeout(now, self._random_jitter())
            if self._held.is_passed_over(batch):
                yield key
            else:
                self.queue_batch(key)

    def take_due(self, now: float, limit: int, vehicles: Collection[str] | None) -> list[int]:
        """Mark at most `limit` batches as in flight, and return their keys, oldest first, so that
        the caller sends them at `now` [s]. They belong to `vehicles`, or to any vehicle if that is
        None.

        The oldest batches of all regions come first. A vehicle's records then arrive in the order
        of its drive, as the service's check of impossible paths expects.
        """
        pacers = [
            pacer
            for (vehicle, _), pacer in self._pacers.items()
            if vehicles is None or vehicle in vehicles
        ]
        keys: list[int] = []

        def take_from(pacer: Pacer, most: int, probe_jitter: float = 1.0) -> bool:
            due_keys = pacer.take_due(now, probe_jitter, most, self._held)
            for key in due_keys:
                self.mark_in_flight(key, now)
            keys.extend(due_keys)
            return bool(due_keys)

        for pacer in pacers:
            take_from(pacer, 0, self._random_jitter())  # only probes of silent regions
        by_age = [(pacer.oldest, n) for n, pacer in enumerate(pacers) if not pacer.is_silent]
        heapq.heapify(by_age)
        while by_age and len(keys) < limit:
            _, n = heapq.heappop(by_age)
            if take_from(pacers[n], 1):
                heapq.heappush(by_age, (pacers[n].oldest, n))
        self._pacers = {
            name: pacer
            for name, pacer in self._pacers.items()
            if not pacer.is_idle or pacer.is_silent
        }
        return sorted(keys)

    def unanswered_s(self, now: float) -> float:
        """Return how long sent batches have been unanswered at time `now` [s], for the vehicle and
        region with the longest wait; 0 if no batch waits.
        """
        since = (pacer.unanswered_since for pacer in list(self._pacers.values()))
        return max((now - one for one in since if one is not None), default=0.0)
