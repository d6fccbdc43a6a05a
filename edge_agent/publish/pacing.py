"""Pacing of one vehicle's batches for one region, so that unanswered batches do not flood the
network. The module is pure (no I/O). A pacer is in one of two states.

"Open", while acknowledgements arrive: new batches are sent immediately. Batches that wait to be
sent again are sent as long as fewer batches are in flight (sent and not answered) than a window
allows. The window grows with each answered batch, and is halved when a batch is not answered in
time (slow start and congestion avoidance, Jacobson 1988: loss indicates overload).

"Silent", after SILENT_S without an answer: new batches stay on disk, and single batches are sent as
probes at intervals that double up to LONGEST_PROBE_S. The first acknowledgement returns to the open
state. Time is monotonic [s].
"""

from __future__ import annotations

import heapq
import math
from collections.abc import Container
from typing import Final

# [s] time without an answer after which a service counts as unavailable. A service writes a segment
# each second, and restarts within several seconds.
SILENT_S: Final = 8.0
FIRST_PROBE_S: Final = 4.0  # [s] interval before the first probe
# [s] longest interval between probes. With it, a thousand cars send eight messages per second to an
# unavailable service. With five minutes, cars returned so slowly that the service was idle between
# them. Their return took longer than the transfer of an hour's backlog.
LONGEST_PROBE_S: Final = 120.0
FIRST_WINDOW: Final = 16.0  # batches in flight: 3 kB, the same as the initial window of TCP
# Batches in flight; new batches (one per vehicle, kind and second) are sent regardless.
LEAST_WINDOW: Final = 8.0
# Batches in flight: 100 kB in one second, the time that a service needs for an answer.
LARGEST_WINDOW: Final = 512.0
HALVED_S: Final = 2.0  # [s] losses within this time count as one sign of overload


class Pacer:
    """Pacing of one vehicle's batches towards the service of one region.

    Attributes:
        in_flight: number of batches in flight: sent, not answered and not timed out.
        is_silent: True while the service does not answer.
    """

    __slots__ = (
        "_answered",
        "_halved_at",
        "_probe_at",
        "_probe_s",
        "_probes",
        "_sent_before",
        "_threshold",
        "_unanswered_since",
        "_waiting",
        "_window",
        "in_flight",
        "is_silent",
    )

    def __init__(self) -> None:
        self.in_flight = 0
        self.is_silent = False
        self._waiting: list[int] = []  # heap of keys; keys of removed batches may remain
        self._window = FIRST_WINDOW
        # Size up to which the window grows by one per answered batch (slow-start threshold).
        self._threshold = LARGEST_WINDOW
        self._unanswered_since: float | None = None  # [s] start of the wait for an answer
        self._halved_at = -float("inf")
        self._answered = False
        # Batches in flight that were sent before the service became silent. Their loss does not
        # indicate overload.
        self._sent_before = 0
        self._probe_at = 0.0
        self._probe_s = FIRST_PROBE_S
        self._probes = 0

    @property
    def is_idle(self) -> bool:
        """Return True if no batch of this vehicle and region is in flight (sent, not answered) and
        no batch waits to be sent.
        """
        return not self.in_flight and not self._waiting

    @property
    def unanswered_since(self) -> float | None:
        """Return the time [s] since which sent batches have been unanswered; None if no batch waits
        for an answer.
        """
        return self._unanswered_since

    @property
    def oldest(self) -> float:
        """Return the key of the oldest batch that waits to be sent; infinite if none waits."""
        return self._waiting[0] if self._waiting else math.inf

    def queue_batch(self, key: int) -> None:
        """Queue a stored batch for sending. `key` is its row number in the outbox (store on disk),
        so that lower keys are older; they are sent first.
        """
        heapq.heappush(self._waiting, key)

    def record_sent(self, now: float) -> None:
        """Record that a batch was sent at time `now` [s] and waits for its answer."""
        self.in_flight += 1
        if self._unanswered_since is None:
            self._unanswered_since = now

    def record_settled(self) -> None:
        """Record that a batch in flight (sent, not answered) was answered. The window (limit of
        batches in flight) may then grow.
        """
        self.in_flight -= 1
        grown = self._window + (1.0 if self._window < self._threshold else 1.0 / self._window)
        self._window = min(grown, LARGEST_WINDOW)

    def record_answer(self) -> None:
        """Record that an acknowledgement arrived for any batch of this vehicle and region. It ends
        the silent state, in which only single batches are sent as probes.
        """
        self._answered = True
        if self.is_silent:
            self.is_silent = False
            self._window = FIRST_WINDOW
            self._threshold = LARGEST_WINDOW
            self._sent_before = self.in_flight

    def record_timeout(self, now: float, jitter: float) -> None:
        """Record that a batch in flight (sent, not answered) was not answered in time. After
        SILENT_S without an answer, enter the silent state, in which only single batches are sent as
        probes. Before that, halve the window.
        """
        self.in_flight -= 1
        if self.is_silent:
            return
        if (
            not self._answered
            and self._unanswered_since is not None
            and now - self._unanswered_since >= SILENT_S
        ):
            self.is_silent = True
            self._probe_s = FIRST_PROBE_S
            self._probe_at = now + jitter * self._probe_s
        elif self._sent_before > 0:
            self._sent_before -= 1
        elif now - self._halved_at >= HALVED_S:
            self._halved_at = now
            self._window = max(self._window / 2.0, LEAST_WINDOW)
            self._threshold = self._window

    def record_reconnect(self, now: float) -> None:
        """Record that a router is available again at time `now` [s]. Batches in flight count as
        lost. In the silent state (no service answers), a probe is sent immediately.
        """
        self.in_flight = 0
        self._unanswered_since = None
        self._probe_at = now
        self._probe_s = FIRST_PROBE_S

    def take_due(self, now: float, jitter: float, most: int, held: Container[int]) -> list[int]:
        """Return the keys of at most `most` batches to send at time `now` [s], oldest first. `held`
        are the keys of the batches in the outbox; other keys are dropped.
        """
        if self._answered:
            self._answered = False
            self._unanswered_since = now if self.in_flight else None
        if self.is_silent:
            return self._take_probe(now, jitter, held)
        out: list[int] = []
        free = min(most, int(self._window) - self.in_flight)
        while self._waiting and len(out) < free:
            key = heapq.heappop(self._waiting)
            if key in held:
                out.append(key)
        return out

    def _take_probe(self, now: float, jitter: float, held: Container[int]) -> list[int]:
        """Return a list of the keys of batches to send as probes at time `now` [s]. The list has
        one key, or none if no probe is due or no batch waits.

        The probe is alternately the oldest and the newest batch, so that a batch that the service
        cannot read does not block all others.
        """
        if now < self._probe_at:
            return []
        self._waiting = sorted({key for key in self._waiting if key in held})
        self._probe_s = min(2.0 * self._probe_s, LONGEST_PROBE_S)
        self._probe_at = now + jitter * self._probe_s
        if not self._waiting:
            return []
        self._probes += 1
        return [self._waiting.pop(0 if self._probes % 2 else -1)]
