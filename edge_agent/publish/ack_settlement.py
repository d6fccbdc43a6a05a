"""Processing of acknowledgements from fleet services. An acknowledgement settles batches (messages
with records): they are removed from the outbox (store on disk). It also shows how far the vehicle's
clock is behind the service's clock.
"""

from __future__ import annotations

import logging
import queue
import time
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Final

from edge_agent.publish.held_batches import Stream
from edge_agent.publish.outbox import Outbox
from schemas.errors import WireError
from schemas.thresholds import NS
from schemas.wire import Kind, StreamAck, decode_ack

# [s] largest difference between the clocks of service and vehicle. A service rejects records that
# are further in the future.
CLOCK_OFF_S: Final = 30.0

log = logging.getLogger(__name__)


@dataclass
class Counts:
    """Counts of the publisher. `offered`, `published`, `acknowledged`, `rejected` and `dropped` are
    numbers of records of each kind. `late` is the number of batches (messages) with records that
    were older than the map's limit when they arrived. The map gives such records less weight or
    ignores them. `resent_batches` is the number of batches that were sent again.
    """

    offered: dict[Kind, int] = field(default_factory=lambda: dict.fromkeys(Kind, 0))
    published: dict[Kind, int] = field(default_factory=lambda: dict.fromkeys(Kind, 0))
    acknowledged: dict[Kind, int] = field(default_factory=lambda: dict.fromkeys(Kind, 0))
    rejected: dict[Kind, int] = field(default_factory=lambda: dict.fromkeys(Kind, 0))
    dropped: dict[Kind, int] = field(default_factory=lambda: dict.fromkeys(Kind, 0))
    # Numbers of batches, not of records.
    late: dict[Kind, int] = field(default_factory=lambda: dict.fromkeys(Kind, 0))
    resent_batches: int = 0
    bad_acks: int = 0
    failures: int = 0  # errors in the sending thread, which continues


class AckSettlement:
    """Queue of received acknowledgements. The sender thread takes them from the queue and removes
    the acknowledged batches from the outbox.

    Attributes:
        clock_behind_s: time [s] by which the vehicle's clock is behind that of the service that
            answered last.
    """

    def __init__(
        self, outbox: Outbox, counts: Counts, wall: Callable[[], int] = time.time_ns
    ) -> None:
        self._outbox = outbox
        self._counts = counts
        self._wall = wall
        self._acks: queue.SimpleQueue[tuple[str, bytes]] = queue.SimpleQueue()
        self.clock_behind_s = 0.0

    def receive_ack(self, vehicle: str, payload: bytes) -> None:
        """Queue the `payload` of an acknowledgement that `vehicle` received. Zenoh calls this
        method on one of its own threads.
        """
        self._acks.put((vehicle, payload))

    def settle_received(self) -> None:
        """Apply all queued acknowledgements to the outbox. An acknowledgement that is unreadable or
        names another vehicle is ignored and counted.
        """
        while not self._acks.empty():
            vehicle, payload = self._acks.get()
            try:
                ack_vehicle, streams = decode_ack(payload)
            except WireError as error:
                self._counts.bad_acks += 1
                log.warning("an acknowledgement for %s cannot be read: %s", vehicle, error)
                continue
            if ack_vehicle != vehicle:
                self._counts.bad_acks += 1
                continue
            for ack in streams:
                self._settle_stream(vehicle, ack)

    def _settle_stream(self, vehicle: str, ack: StreamAck) -> None:
        counts = self._counts
        stream = Stream(vehicle, ack.boot, ack.kind, ack.region)
        counts.acknowledged[ack.kind] += self._outbox.settle_ranges(stream, ack.durable)
        counts.late[ack.kind] += sum(last - first + 1 for first, last in ack.late)
        self._compare_clocks(ack.time)
        for seq, row, reason in ack.rejected:
            records = self._outbox.settle_ranges(stream, [(seq, seq)])
            counts.rejected[ack.kind] += records
            if records:
                log.warning(
                    "%s batch %d of %s was rejected at row %d: %s",
                    ack.kind,
                    seq,
                    vehicle,
                    row,
                    reason,
                )

    def _compare_clocks(self, reported: int) -> None:
        """Store the difference between the vehicle's clock and the time [ns UTC] that a service
        reported, and log a large difference. A reported time of 0 means unknown.

        The comparison assumes that an acknowledgement is about a second old on arrival.
        """
        if not reported:
            return
        behind = (reported - self._wall()) / NS
        if abs(behind) > CLOCK_OFF_S and abs(behind - self.clock_behind_s) > CLOCK_OFF_S:
            log.warning(describe_clock(behind))
        self.clock_behind_s = behind


def describe_clock(behind_s: float) -> str:
    """Return the sentence for the user about a clock that is `behind_s` seconds behind the
    service's; negative if it is ahead.
    """
    side = "behind" if behind_s > 0.0 else "ahead of"
    return (
        f"the clock is {abs(behind_s):.0f} s {side} the service's: reports arrive late or are "
        "refused"
    )
