"""Zenoh session of one vehicle: sends its batches, receives its acknowledgements, declares its liveliness token."""

from __future__ import annotations

import logging
import threading
from collections.abc import Callable
from typing import Final

import zenoh

from edge_agent.publish.outbox import StoredBatch
from schemas import keys
from schemas.config import ZenohSettings
from schemas.runtime.zenoh_session import open_session
from schemas.wire import ENCODING, Kind

log = logging.getLogger(__name__)
_TOPIC: Final = {Kind.OBSERVATION: keys.TOPICS["obs"], Kind.STATE: keys.TOPICS["state"]}
_KEY: Final = {Kind.OBSERVATION: keys.observation_key, Kind.STATE: keys.state_key}
_QUALITY: Final = {
    kind: (
        zenoh.Encoding(ENCODING[kind]),
        getattr(zenoh.Priority, topic.priority),
        zenoh.CongestionControl.BLOCK if topic.block else zenoh.CongestionControl.DROP,
    )
    for kind, topic in _TOPIC.items()
}


class Link:
    """Open `session` of one vehicle; `on_ack(vehicle, payload)` is called on a thread of Zenoh."""

    def __init__(self, session: zenoh.Session, vehicle: str, on_ack: Callable[[str, bytes], None]) -> None:
        self.session = session

        def heard(sample: zenoh.Sample) -> None:
            on_ack(vehicle, sample.payload.to_bytes())

        self._acks = session.declare_subscriber(keys.ack_key(vehicle), heard)
        self._alive = session.liveliness().declare_token(keys.alive_key(vehicle))

    @staticmethod
    def open(
        settings: ZenohSettings, vehicle: str, on_ack: Callable[[str, bytes], None], stop: threading.Event
    ) -> Link | None:
        """Wait for a router and open the session; None if `stop` was set before."""
        session = open_session(settings, stop, vehicle)
        return None if session is None else Link(session, vehicle, on_ack)

    @property
    def connected(self) -> bool:
        """True if a router is connected now."""
        return bool(self.session.info.routers_zid())

    def put(self, batch: StoredBatch) -> bool:
        """Send a batch; False if the session refuses. Only the acknowledgement proves that it arrived."""
        stream = batch.stream
        encoding, priority, congestion = _QUALITY[stream.kind]
        key = _KEY[stream.kind](stream.region, stream.vehicle)
        try:
            self.session.put(key, batch.payload, encoding=encoding, priority=priority, congestion_control=congestion)
        except zenoh.ZError as error:
            log.warning("%s cannot put: %s", stream.vehicle, error)
            return False
        return True

    def close(self) -> None:
        """Close the session; an open one would hang the interpreter at exit."""
        self.session.close()
