"""Zenoh session of one vehicle: it sends batches, receives acknowledgements, and declares the
vehicle's liveliness token (sign that it is connected).
"""

from __future__ import annotations

import logging
import threading
import time
from collections.abc import Callable
from typing import Final

import zenoh

from edge_agent.publish.outbox import StoredBatch
from schemas import keys
from schemas.config import ZenohSettings
from schemas.runtime.link_watch import LinkWatch
from schemas.runtime.zenoh_session import ReasonLog, open_session, quality_of
from schemas.wire import ENCODING, MESSAGES_PER_S, Kind

# [s] pause between two messages: twice the limit of a router, because networks may delay messages
# and deliver them together.
GAP_S: Final = 2.0 / MESSAGES_PER_S

log = logging.getLogger(__name__)
_TOPIC: Final = {Kind.OBSERVATION: keys.TOPICS["obs"], Kind.STATE: keys.TOPICS["state"]}
_KEY: Final = {Kind.OBSERVATION: keys.observation_key, Kind.STATE: keys.state_key}
_QUALITY: Final = {
    kind: {"encoding": zenoh.Encoding(ENCODING[kind]), **quality_of(topic)}
    for kind, topic in _TOPIC.items()
}


class Link:
    """Connection of one vehicle to the network over an open Zenoh `session`. For each
    acknowledgement, Zenoh calls `on_ack(vehicle, payload)` on one of its threads.
    """

    def __init__(
        self,
        session: zenoh.Session,
        vehicle: str,
        on_ack: Callable[[str, bytes], None],
        clock: Callable[[], float] = time.monotonic,
        pause: Callable[[float], None] = time.sleep,
    ) -> None:
        self.session = session
        self._clock = clock
        self._pause = pause
        # earliest time of the next message of each kind [s]
        self._free_at = dict.fromkeys(Kind, 0.0)

        def receive_sample(sample: zenoh.Sample) -> None:
            on_ack(vehicle, sample.payload.to_bytes())

        self.watch = LinkWatch(session, vehicle)
        self._acks = session.declare_subscriber(keys.ack_key(vehicle), receive_sample)
        self._alive = session.liveliness().declare_token(keys.alive_key(vehicle))

    @staticmethod
    def open(
        settings: ZenohSettings,
        vehicle: str,
        on_ack: Callable[[str, bytes], None],
        stop: threading.Event,
        reasons: ReasonLog,
    ) -> Link | None:
        """Wait for a router, open the vehicle's session and return the link. Return None if the
        event `stop` is set before a router answers. The reasons for waiting go to `reasons`.
        """
        session = open_session(settings, stop, vehicle, reasons)
        return None if session is None else Link(session, vehicle, on_ack)

    @property
    def is_connected(self) -> bool:
        """Return True if the vehicle's session is connected to a router now."""
        return self.watch.is_connected

    def put(self, batch: StoredBatch) -> bool:
        """Send a batch; return False if the session does not accept it. Only the acknowledgement
        proves that the batch arrived.

        The call first waits until GAP_S [s] after the vehicle's last message of the same kind,
        because a router drops messages that follow too closely.
        """
        stream = batch.stream
        early = self._free_at[stream.kind] - self._clock()
        if early > 0.0:
            self._pause(early)
        self._free_at[stream.kind] = self._clock() + GAP_S
        key = _KEY[stream.kind](stream.region, stream.vehicle)
        try:
            self.session.put(key, batch.payload, **_QUALITY[stream.kind])
        except zenoh.ZError as error:
            log.warning("%s cannot publish: %s", stream.vehicle, error)
            return False
        return True

    def close(self) -> None:
        """Close the session. An open session would block the exit of the interpreter."""
        self.session.close()
