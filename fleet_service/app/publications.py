"""Publication of acknowledgements, alerts and map tiles in a Zenoh session."""

from __future__ import annotations

import zenoh

from schemas import grid, keys, wire
from schemas.runtime import zenoh_session
from schemas.wire import Alert


def publish_acks(session: zenoh.Session, acks: list[tuple[str, bytes]]) -> None:
    """Publish acknowledgements, each a pair (vehicle, payload), to their vehicles."""
    for vehicle, ack in acks:
        _publish_message(session, keys.ack_key(vehicle), ack, wire.ACK_ENCODING)


def publish_alerts(session: zenoh.Session, alerts: list[Alert]) -> None:
    """Publish alerts, each under the key of its tile."""
    for alert in alerts:
        _publish_message(
            session,
            keys.alert_key(int(grid.tile_of(alert.cell))),
            wire.encode_alert(alert),
            wire.ALERT_ENCODING,
        )


def publish_tile(session: zenoh.Session, tile: int, stream: bytes) -> None:
    """Publish the encoded cells of a map tile."""
    _publish_message(session, keys.map_key(tile), stream, wire.ARROW)


def _publish_message(session: zenoh.Session, key: str, payload: bytes, encoding: str) -> None:
    """Publish a message with the quality of service (such as priority) that is defined for the
    topic of its key.
    """
    session.put(key, payload, encoding=encoding, **zenoh_session.quality_of(keys.parse(key).topic))
