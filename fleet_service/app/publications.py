"""Publication of acknowledgements, alerts and map tiles in a Zenoh session."""

from __future__ import annotations

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


def publish_acks(session: zenoh.Session, acks: list[tuple[str, bytes]]) -> None:
    """Publish acknowledgements, each a pair (vehicle, payload), to their vehicles."""
    for vehicle, ack in acks:
        session.put(keys.ack_key(vehicle), ack, **_ACK)


def publish_alerts(session: zenoh.Session, alerts: list[Alert]) -> None:
    """Publish alerts, each under the key of its tile."""
    for alert in alerts:
        key = keys.alert_key(int(grid.tile_of(alert.cell)))
        session.put(key, wire.encode_alert(alert), **_ALERT)


def publish_tile(session: zenoh.Session, tile: int, stream: bytes) -> None:
    """Publish the encoded cells of a map tile."""
    session.put(keys.map_key(tile), stream, **_TILE)
