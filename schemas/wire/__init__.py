"""The messages of the contract as bytes: batches, acknowledgements, alerts; tiles: `schemas.wire.tile`."""

from schemas.wire.batches import decode
from schemas.wire.codec import (
    ACK_ENCODING,
    ALERT_ENCODING,
    ARROW,
    ENCODING,
    GEOJSON,
    JSON,
    MAX_BYTES,
    MAX_ROWS,
    MESSAGES,
    MESSAGES_PER_S,
    NEEDED,
    PLAIN,
    STANDING_ENCODING,
    WEATHER_ENCODING,
    Alert,
    Batch,
    Columns,
    Kind,
    StreamAck,
    column_types,
    decode_ack,
    decode_alert,
    decode_standing,
    encode,
    encode_ack,
    encode_alert,
    encode_standing,
    parse,
)

__all__ = [
    "ACK_ENCODING", "ALERT_ENCODING", "ARROW", "ENCODING", "GEOJSON", "JSON", "MAX_BYTES", "MAX_ROWS", "MESSAGES",
    "MESSAGES_PER_S",
    "NEEDED", "PLAIN", "STANDING_ENCODING", "WEATHER_ENCODING", "Alert", "Batch", "Columns", "Kind", "StreamAck",
    "column_types", "decode", "decode_ack", "decode_alert", "decode_standing", "encode", "encode_ack", "encode_alert",
    "encode_standing", "parse",
]  # fmt: skip
