"""Encoding of batches, acknowledgements and alerts as bytes, and decoding of acknowledgements and
alerts. `schemas.wire.batches` decodes batches.

A batch is sent as protobuf (`application/protobuf;gripmap.v1.ObservationBatch`) or as the JSON
mapping of the same message (`application/json`), so that a person can publish one from a command
line.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from enum import StrEnum
from functools import cache
from typing import Any, Final, NamedTuple

import numpy as np
from google.protobuf import json_format
from google.protobuf.message import DecodeError
from numpy.typing import NDArray

from schemas import message_columns
from schemas.errors import WireError
from schemas.proto import gripmap_pb2 as pb

JSON: Final = "application/json"
# Encodings that mean protobuf; the key then says which message type it is.
PLAIN: Final = (
    "application/protobuf",
    "zenoh/bytes",
    "",
)
ARROW: Final = "application/vnd.apache.arrow.stream"
GEOJSON: Final = "application/geo+json"
MAX_ROWS: Final = 50
# Enough for an alert on each of the 65 536 cells and sectors of a z14 tile.
MAX_STANDING_BYTES: Final = 8 << 20
# Largest rate per kind and session over QUIC. A router drops messages that exceed it.
MESSAGES_PER_S: Final = 100.0
MAX_BYTES: Final = 64 * 1024  # 50 records take 8 kB as protobuf and 40 kB as JSON


class Kind(StrEnum):
    """Kind of the records in a batch: observations or states. The enum value is also the chunk
    (part between slashes) of the Zenoh key that names the kind.
    """

    OBSERVATION = "obs"
    STATE = "state"

    # The hash of an Enum is Python code and slow. A `Kind` is hashed often, as a part of each
    # stream's name.
    __hash__ = str.__hash__


Columns = dict[str, NDArray[Any]]

MESSAGES: Final[dict[Kind, type[Any]]] = {
    Kind.OBSERVATION: pb.ObservationBatch,
    Kind.STATE: pb.StateBatch,
}
# Columns that every batch must have. The length of the first one is the number of records.
NEEDED: Final = {
    Kind.OBSERVATION: ("enter_time", "latitude", "longitude"),
    Kind.STATE: ("time", "latitude", "longitude"),
}
_COLUMNS: Final = {
    Kind.OBSERVATION: message_columns.OBSERVATION,
    Kind.STATE: message_columns.STATE,
}
_TYPES: Final = {message_columns.TIME: "int64", message_columns.LIKELIHOOD: "uint8"}
_PB_KIND: Final = {Kind.OBSERVATION: pb.KIND_OBSERVATION, Kind.STATE: pb.KIND_STATE}
_KIND_OF: Final = {number: kind for kind, number in _PB_KIND.items()}


def encoding_of(message: type[Any]) -> str:
    """Return the name of the Zenoh encoding of a protobuf message type."""
    return f"application/protobuf;{message.DESCRIPTOR.full_name}"


ENCODING: Final = {kind: encoding_of(message) for kind, message in MESSAGES.items()}
ACK_ENCODING: Final = encoding_of(pb.Ack)
ALERT_ENCODING: Final = encoding_of(pb.Alert)
STANDING_ENCODING: Final = encoding_of(pb.StandingAlerts)
WEATHER_ENCODING: Final = encoding_of(pb.Weather)


@cache
def column_types(kind: Kind) -> dict[str, np.dtype[Any]]:
    """Return the NumPy type of every column, by name, in a batch of this kind of records. Times are
    int64 [ns]; the log-likelihood of friction is uint8, (n, 32).
    """
    return {
        column.name: np.dtype(_TYPES.get(column.type, column.type)) for column in _COLUMNS[kind]
    }


@dataclass(frozen=True)
class Batch:
    """One to fifty records of one vehicle in one region.

    `columns` holds, by name, every column of the table for this kind of records, shape (n,). The
    column `log_likelihood` is (n, 32), or (n, 0) if the batch has no log-likelihoods.
    """

    kind: Kind
    vehicle: str
    boot: int
    region: int
    seq: int
    first_held: int
    columns: Columns = field(repr=False)
    estimator: str = ""

    @property
    def rows(self) -> int:
        """Return the number of records (observations or states) in the batch."""
        return len(self.columns["latitude"])


def encode(batch: Batch) -> bytes:
    """Return the protobuf bytes of a batch (message with records of one vehicle).

    Raises:
        WireError: the columns have unequal lengths, there are too many records, or records of this
            kind do not have one of the columns.
    """
    n = batch.rows
    types = column_types(batch.kind)
    if not 1 <= n <= MAX_ROWS:
        raise WireError("rows", f"a batch of {n} records", f"send 1 to {MAX_ROWS}")
    if unknown := batch.columns.keys() - types.keys():
        raise WireError(
            sorted(unknown)[0], "is not a column of this kind", f"use {', '.join(types)}"
        )
    message = MESSAGES[batch.kind](
        vehicle=batch.vehicle,
        boot=batch.boot,
        region=batch.region,
        seq=batch.seq,
        first_held=batch.first_held,
        estimator=batch.estimator,
    )
    for name, column in batch.columns.items():
        if len(column) != n:
            raise WireError(
                name,
                f"has {len(column)} records, latitude has {n}",
                "give every column the same length",
            )
        if name == "log_likelihood":
            message.log_likelihood = np.ascontiguousarray(column, dtype=np.uint8).tobytes()
        else:
            getattr(message, name).extend(column.tolist())
    data: bytes = message.SerializeToString()
    return data


# protobuf messages have no types.
def parse(payload: bytes, encoding: str, message: type[Any], expected: str) -> Any:  # noqa: ANN401
    """Parse a message of type `message` from its bytes. The bytes are read as protobuf if the
    received `encoding` equals `expected` or names no message type, and as JSON if it is the JSON
    encoding.

    Raises:
        WireError: the payload is too large, has another encoding, or is not the expected message.
    """
    if len(payload) > MAX_BYTES:
        raise WireError("payload", f"{len(payload)} bytes", f"send at most {MAX_BYTES}")
    try:
        if encoding == expected or encoding in PLAIN:
            return message.FromString(payload)
        if encoding == JSON:
            return json_format.Parse(payload, message(), max_recursion_depth=8)
    except (
        DecodeError,
        json_format.ParseError,
        UnicodeDecodeError,
        RecursionError,
        OverflowError,
    ) as error:
        reason = str(error).splitlines()[0][:120] if str(error) else type(error).__name__
        problem = f"is no {message.DESCRIPTOR.name} ({reason})"
        raise WireError("payload", problem, "encode it as defined in the .proto file") from error
    raise WireError("encoding", f"{encoding[:80]!r}", f"use {expected} or {JSON}")


class StreamAck(NamedTuple):
    """Acknowledged batches of one stream, given by sequence numbers (`seq`). A stream contains the
    batches of one vehicle that have the same `boot`, `kind` and `region`.

    Attributes:
        boot, kind, region: random number that the agent draws at each start, kind of the records,
            region.
        durable: ranges of batches that are stored safely, both ends included.
        rejected: for each refused record, its batch's sequence number, its row, and the reason.
        late: ranges of durable batches that arrived too late for the map's normal update.
        time: time of sending by the service's clock [ns]; 0 if unknown.
    """

    boot: int
    kind: Kind
    region: int
    durable: tuple[tuple[int, int], ...] = ()
    rejected: tuple[tuple[int, int, str], ...] = ()
    late: tuple[tuple[int, int], ...] = ()
    time: int = 0


def encode_ack(vehicle: str, streams: list[StreamAck], time: int = 0) -> bytes:
    """Return the protobuf bytes of an acknowledgement; `time` is the service's clock at sending
    [ns].
    """
    message = pb.Ack(vehicle=vehicle, time=time)
    for stream in streams:
        # Setting fields one by one takes half the time of keyword arguments.
        part = message.streams.add()
        part.boot = stream.boot
        part.kind = _PB_KIND[stream.kind]
        part.region = stream.region
        for first, last in stream.durable:
            run = part.durable.add()
            run.first = first
            run.last = last
        for seq, row, reason in stream.rejected:
            part.rejected.add(seq=seq, row=row, reason=reason)
        for first, last in stream.late:
            part.late.add(first=first, last=last)
    return message.SerializeToString()


def decode_ack(payload: bytes) -> tuple[str, list[StreamAck]]:
    """Decode the bytes of an acknowledgement; return the name of its vehicle, and the acknowledged
    batches per stream.

    Raises:
        WireError: the payload is not an Ack message, or has a kind of batch that this version does
            not know.
    """
    message = parse(payload, ACK_ENCODING, pb.Ack, ACK_ENCODING)
    if any(stream.kind not in _KIND_OF for stream in message.streams):
        raise WireError("kind", "is unknown", "use KIND_OBSERVATION or KIND_STATE")
    return message.vehicle, [
        StreamAck(
            stream.boot,
            _KIND_OF[stream.kind],
            stream.region,
            tuple((r.first, r.last) for r in stream.durable),
            tuple((r.seq, r.row, r.reason) for r in stream.rejected),
            tuple((r.first, r.last) for r in stream.late),
            message.time,
        )
        for stream in message.streams
    ]


@dataclass(frozen=True)
class Alert:
    """Alert that a map cell, in one heading sector, became slippery (`raised` is True) or is no
    longer slippery (False), with the reason. The fields have the meaning of those in the protobuf
    message `Alert`.
    """

    cell: int
    sector: int
    raised: bool
    time: int
    mu: float
    mu_lower: float
    mu_upper: float
    p_slippery: float
    vehicles: int
    latitude: float
    longitude: float
    reason: str


def encode_alert(alert: Alert) -> bytes:
    """Return the protobuf bytes of an alert."""
    return pb.Alert(**vars(alert)).SerializeToString()


def decode_alert(payload: bytes) -> Alert:
    """Decode the bytes of a message with one alert; return the alert.

    Raises:
        WireError: the payload is not an Alert message.
    """
    return _alert_of_message(parse(payload, ALERT_ENCODING, pb.Alert, ALERT_ENCODING))


def encode_standing(alerts: Sequence[Alert]) -> bytes:
    """Return the protobuf bytes of a message with the active alerts of a tile."""
    return pb.StandingAlerts(
        alerts=[pb.Alert(**vars(alert)) for alert in alerts]
    ).SerializeToString()


def decode_standing(payload: bytes) -> list[Alert]:
    """Decode the bytes of a message with all active alerts of a map tile; return these alerts.

    Raises:
        WireError: the payload is not a StandingAlerts message, or too large.
    """
    if len(payload) > MAX_STANDING_BYTES:
        raise WireError("payload", f"{len(payload)} bytes", f"send at most {MAX_STANDING_BYTES}")
    message = pb.StandingAlerts()
    try:
        message.ParseFromString(payload)
    except DecodeError as error:
        raise WireError(
            "payload", "is no StandingAlerts", "encode it as defined in the .proto file"
        ) from error
    return [_alert_of_message(alert) for alert in message.alerts]


def _alert_of_message(message: Any) -> Alert:  # noqa: ANN401 protobuf has no types
    return Alert(**{name: getattr(message, name) for name in Alert.__dataclass_fields__})
