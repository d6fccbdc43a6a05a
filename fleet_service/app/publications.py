"""Publication of acknowledgements, alerts and map tiles in a Zenoh session."""

from __future__ import annotations

from collections import deque
from typing import Final

import zenoh

from schemas import grid, keys, wire
from schemas.runtime.zenoh_session import quality_of
from schemas.wire import Alert

_ACK: Final = {"encoding": zenoh.Encoding(wire.ACK_ENCODING), **quality_of(keys.TOPICS["ack"])}
_ALERT: Final = {
    "encoding": zenoh.Encoding(wire.ALERT_ENCODING),
    **quality_of(keys.TOPICS["alert"]),
}
_TILE: Final = {"encoding": zenoh.Encoding(wire.ARROW), **quality_of(keys.TOPICS["map"])}
# Number of acknowledgements that are published at once, if less than four times as many wait. They
# take about 2 ms.
_ACKS_AT_ONCE: Final = 64


class WaitingAcks:
    """Acknowledgements that wait for their publication.

    A segment (file of new rows) releases up to thousands of them at once. They are published in
    parts, so that messages that may raise an alert are processed in between.
    """

    def __init__(self) -> None:
        self._acks: deque[tuple[str, bytes]] = deque()

    def __len__(self) -> int:
        return len(self._acks)

    def add(self, acks: list[tuple[str, bytes]]) -> None:
        """Append acknowledgements, each a pair (vehicle, payload)."""
        self._acks.extend(acks)

    def publish_part(self, session: zenoh.Session) -> None:
        """Publish a quarter of the waiting acknowledgements, but at least the next _ACKS_AT_ONCE,
        to their vehicles.
        """
        self._publish(session, max(_ACKS_AT_ONCE, len(self._acks) // 4))

    def publish_all(self, session: zenoh.Session) -> None:
        """Publish all waiting acknowledgements to their vehicles."""
        self._publish(session, len(self._acks))

    def _publish(self, session: zenoh.Session, most: int) -> None:
        for _ in range(min(most, len(self._acks))):
            vehicle, ack = self._acks.popleft()
            session.put(keys.ack_key(vehicle), ack, **_ACK)


def publish_alerts(session: zenoh.Session, alerts: list[Alert]) -> None:
    """Publish alerts, each under the key of its tile."""
    for alert in alerts:
        key = keys.alert_key(int(grid.tile_of(alert.cell)))
        session.put(key, wire.encode_alert(alert), **_ALERT)


def publish_tile(session: zenoh.Session, tile: int, stream: bytes) -> None:
    """Publish the encoded cells of a map tile."""
    session.put(keys.map_key(tile), stream, **_TILE)
