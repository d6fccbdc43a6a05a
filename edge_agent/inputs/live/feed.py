"""Base of a live source: a thread that listens, reopens a lost connection, and stores the received
messages.

Times are seconds on the monotonic clock of the host (this computer). If the time stamps of a source
are at most BELIEVED_S old on arrival, its clock is assumed to agree with the host's, and the stamps
are used unchanged. For any other source, the difference between its clock and the host's is
estimated: of the messages in the present and the previous period of WHILE_S, the one with the
smallest delay is assumed to have arrived without delay (minimum of the delays, as in Cristian,
Distrib. Comput. 3 (1989)).
"""

from __future__ import annotations

import logging
import threading
import time
from abc import ABC, abstractmethod
from collections import deque
from dataclasses import dataclass, field
from typing import Any, Final, TypeAlias

from edge_agent.inputs.recording import Series
from schemas.runtime.steady_clock import elapsed_seconds
from schemas.thresholds import NS

BELIEVED_S: Final = 1.0  # [s] maximum delay at which the stamps of a source are used unchanged
# [s] Stamps of the host's own clock may be later than their arrival by this much.
EARLY_S: Final = 0.01
WHILE_S: Final = 10.0  # [s] period after which the smallest delay is determined again
RETRY_S: Final = 0.5  # [s] pause before a lost source is opened again
TICK_S: Final = 0.1  # [s] longest time until a thread notices that it must stop
SILENT_S: Final = 2.0  # [s] silence after which a source counts as lost
# messages that may wait for the estimation loop, minutes of a CAN bus
MOST_WAITING: Final = 200_000
LEAVE_S: Final = 2.0  # [s] time to wait for the thread at the end

Received: TypeAlias = tuple[float, Any]
"""A received message: its time [s of the host's clock], and its content."""

log = logging.getLogger(__name__)


@dataclass(frozen=True)
class HostClock:
    """Clock of the host (this computer). It stores the UTC time [ns] at which it was started, and
    the reading of a steady clock [s] at that moment.
    """

    start_ns: int = field(default_factory=time.time_ns)
    steady_s: float = field(default_factory=elapsed_seconds)

    def now(self) -> float:
        """Return the time [s] since the start of the host's clock."""
        return elapsed_seconds() - self.steady_s

    def seconds_of(self, stamp_ns: int) -> float:
        """Return the time [s] from the start of the host's clock to the instant `stamp_ns` [ns
        UTC].
        """
        return (stamp_ns - self.start_ns) / NS


class Stamps:
    """Conversion of the time stamps of one live source to the clock of the host (this computer)."""

    def __init__(self) -> None:
        self._previous_min_delay = float("inf")
        self._current_min_delay = float("inf")
        self._turn_time = 0.0

    @property
    def added_s(self) -> float:
        """Return the time [s] that is added to the source's time stamps; 0 where the stamps are
        used unchanged.
        """
        min_delay = min(self._previous_min_delay, self._current_min_delay)
        return 0.0 if -EARLY_S <= min_delay < BELIEVED_S or min_delay == float("inf") else min_delay

    def host_time(self, stamp: float, arrival: float) -> float:
        """Convert the time stamp [s] of a message from the clock of its source to the clock of this
        host [s]. The message arrived at `arrival` [s] by the host's clock.
        """
        if arrival - self._turn_time > WHILE_S:
            self._previous_min_delay = self._current_min_delay
            self._current_min_delay = float("inf")
            self._turn_time = arrival
        self._current_min_delay = min(self._current_min_delay, arrival - stamp)
        return stamp + self.added_s


class Feed(ABC):
    """Base class of live sources. Call `start` once, `take` repeatedly, and `close` once.

    Attributes:
        name: the source as given on the command line.
        received_count: number of messages received.
        lost: number of messages known to be missing.
        broken: number of messages that could not be read.
        openings: number of times that the source was opened.
        losses: number of times that the connection was lost.
    """

    def __init__(self, name: str, clock: HostClock) -> None:
        self.name = name
        self.clock = clock
        self.received_count = 0
        self.lost = 0
        self.broken = 0
        self.openings = 0
        self.losses = 0
        self.stopping = threading.Event()
        self.stamps = Stamps()
        self.last = 0.0  # time of the last message [s of the host's clock]
        self.newest = 0.0  # latest time stamp [s of the host's clock]
        self._reasons: set[str] = set()
        self._waiting: deque[Received] = deque()
        self._thread = threading.Thread(target=self._listen_loop, name=name, daemon=True)

    @abstractmethod
    def listen(self) -> None:
        """Open the live source, increment `openings`, and call `store_message` for each message
        until the event `stopping` is set.

        If this method returns earlier or raises, the source counts as lost and is opened again.
        """

    @abstractmethod
    def series(self, received: list[Received]) -> dict[str, Series]:
        """Return the signals (times and values) from the messages `received`, by name."""

    def start(self) -> None:
        """Start the thread that listens to the live source."""
        self.last = self.clock.now()
        self._thread.start()

    def close(self) -> None:
        """Stop listening to the live source. Wait at most LEAVE_S [s] for the listening thread,
        because it may hang in a driver.
        """
        self.stopping.set()
        self._thread.join(LEAVE_S)

    @property
    def is_listening(self) -> bool:
        """Return True if the listening thread is still running. After `close`, True means that the
        thread hangs in a driver, whose library may block the exit of the process.
        """
        return self._thread.is_alive()

    def store_message(self, stamp_ns: int, message: object) -> None:
        """Store a received message for the next call of `take`. `stamp_ns` is the time stamp that
        the source gave to the message [ns UTC].
        """
        self.last = self.clock.now()
        self.received_count += 1
        if len(self._waiting) >= MOST_WAITING:
            self._waiting.popleft()
            self.lost += 1
        placed = self.stamps.host_time(self.clock.seconds_of(stamp_ns), self.last)
        self._waiting.append((placed, message))
        self.newest = max(self.newest, placed)

    def unreadable(self, reason: str) -> None:
        """Count a message of the live source that cannot be read. Log `reason` (a description of
        the error), unless the same reason was logged before.
        """
        self.broken += 1
        self.log_problem(reason)

    def take(self) -> dict[str, Series]:
        """Return the signals, by name, that the source has received since the last call of this
        method.
        """
        received = [self._waiting.popleft() for _ in range(len(self._waiting))]
        return self.series(received) if received else {}

    @property
    def silence_message(self) -> str | None:
        """Return a message if the live source has delivered nothing for SILENT_S; else None."""
        silent = self.clock.now() - self.last
        return f"{self.name} has sent nothing for {silent:.0f} s" if silent > SILENT_S else None

    def _listen_loop(self) -> None:
        while not self.stopping.is_set():
            reason = "the source ended"
            try:
                self.listen()
            # A driver or a remote service may raise any error, and a lost source must not stop the
            # agent.
            except Exception as error:  # noqa: BLE001
                reason = (str(error) or type(error).__name__).splitlines()[0][:200]
            if not self.stopping.is_set():
                self.losses += 1
                self.log_problem(f"lost ({reason}); trying again")
            self.stopping.wait(RETRY_S)

    def log_problem(self, reason: str) -> None:
        """Log a problem with the live source. Each different `reason` is logged only once."""
        if reason not in self._reasons and len(self._reasons) < 50:
            self._reasons.add(reason)
            log.warning("%s: %s", self.name, reason)
