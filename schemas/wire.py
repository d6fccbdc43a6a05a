"""Bytes ↔ columns. Python is touched per message and per column, never per record.

A batch travels as protobuf (`application/protobuf;gripmap.v1.ObservationBatch`) or as the JSON mapping of the same
message (`application/json`), so that a person can publish with one line. A column that the sender left out is filled:
floats with NaN, the cell and the sector from the pose, the leaving time from the entering one.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from enum import StrEnum
from typing import Any, Final

import numpy as np
from google.protobuf import json_format
from google.protobuf.message import DecodeError, Message
from numpy.typing import NDArray

from schemas import grid, mugrid, tables
from schemas.errors import WireError
from schemas.proto import gripmap_pb2 as pb

JSON: Final = "application/json"
ARROW: Final = "application/vnd.apache.arrow.stream"
GEOJSON: Final = "application/geo+json"
MAX_ROWS: Final = 50
MAX_BYTES: Final = 64 * 1024  # fifty records take 8 kB as protobuf, 40 kB as JSON


class Kind(StrEnum):
    """Kind of a batch; the value is its chunk in the key."""

    OBSERVATION = "obs"
    STATE = "state"


Columns = dict[str, NDArray[Any]]

_MESSAGES: Final[dict[Kind, type[Any]]] = {Kind.OBSERVATION: pb.ObservationBatch, Kind.STATE: pb.StateBatch}
_FIELDS: Final = {Kind.OBSERVATION: tables.OBSERVATION, Kind.STATE: tables.STATE}
_NEEDED: Final = {
    Kind.OBSERVATION: ("enter_time", "latitude", "longitude"),
    Kind.STATE: ("time", "latitude", "longitude"),
}
_ABSENT: Final = {"abs_active": -1}  # what an absent integer reads as, where it is not 0
_PB_KIND: Final = {Kind.OBSERVATION: pb.KIND_OBSERVATION, Kind.STATE: pb.KIND_STATE}
_KIND_OF: Final = {number: kind for kind, number in _PB_KIND.items()}


def encoding_of(message: type[Any]) -> str:
    """Zenoh encoding of a protobuf message."""
    return f"application/protobuf;{message.DESCRIPTOR.full_name}"


ENCODING: Final = {kind: encoding_of(message) for kind, message in _MESSAGES.items()}
ACK_ENCODING: Final = encoding_of(pb.Ack)
ALERT_ENCODING: Final = encoding_of(pb.Alert)


def column_types(kind: Kind) -> dict[str, np.dtype[Any]]:
    """Name and numpy type of every column of a batch; times are int64 ns, the likelihood is uint8 (n, 32)."""
    special: dict[Any, type] = {tables.NS: np.int64, tables.LIKELIHOOD: np.uint8}
    return {f.name: np.dtype(special.get(f.type) or f.type.to_pandas_dtype()) for f in _FIELDS[kind]}


@dataclass(frozen=True)
class Batch:
    """One to fifty records of one vehicle in one region.

    `columns` holds every column of the kind's table, shape (n,); `log_likelihood` is (n, 32), or (n, 0) where absent.
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
        """Number of records."""
        return len(self.columns["latitude"])


def encode(batch: Batch) -> bytes:
    """Protobuf bytes of a batch.

    Raises:
        WireError: columns of unequal length, too many records, or a column that the kind does not have.
    """
    n, types = batch.rows, column_types(batch.kind)
    if not 1 <= n <= MAX_ROWS:
        raise WireError("rows", f"a batch of {n} records", f"send 1 to {MAX_ROWS}")
    if unknown := batch.columns.keys() - types.keys():
        raise WireError(sorted(unknown)[0], "is no column of this kind", f"use {', '.join(types)}")
    message = _MESSAGES[batch.kind](
        vehicle=batch.vehicle, boot=batch.boot, region=batch.region, seq=batch.seq,
        first_held=batch.first_held, estimator=batch.estimator,
    )  # fmt: skip
    for name, column in batch.columns.items():
        if len(column) != n:
            raise WireError(name, f"has {len(column)} records, latitude has {n}", "give every column the same length")
        if name == "log_likelihood":
            message.log_likelihood = np.ascontiguousarray(column, dtype=np.uint8).tobytes()
        else:
            getattr(message, name).extend(column.tolist())
    data: bytes = message.SerializeToString()
    return data


def decode(payload: bytes, encoding: str, kind: Kind) -> Batch:
    """Read a batch; the inverse of `encode` for every column that was sent.

    Raises:
        WireError: too large, not the message, no needed column, or columns of unequal length.
    """
    message = _parse(payload, encoding, _MESSAGES[kind](), ENCODING[kind])
    columns = _columns(message, kind)
    region = message.region or int(grid.region_of(_first_cell(columns)))
    return Batch(
        kind, message.vehicle, message.boot, region, message.seq, max(message.first_held, 1), columns, message.estimator
    )


def _parse(payload: bytes, encoding: str, message: Any, expected: str) -> Any:  # noqa: ANN401 protobuf messages are untyped
    if len(payload) > MAX_BYTES:
        raise WireError("payload", f"{len(payload)} bytes", f"send at most {MAX_BYTES}")
    try:
        if encoding == JSON:
            return json_format.Parse(payload, message, max_recursion_depth=8)
        if encoding not in (expected, "application/protobuf", "zenoh/bytes", ""):
            raise WireError("encoding", f"{encoding[:80]!r}", f"use {expected} or {JSON}")
        message.ParseFromString(payload)
    except (DecodeError, json_format.ParseError, UnicodeDecodeError, RecursionError, OverflowError) as error:
        reason = str(error).splitlines()[0][:120] if str(error) else type(error).__name__
        problem = f"is no {message.DESCRIPTOR.name} ({reason})"
        raise WireError("payload", problem, "encode it as its .proto says") from error
    return message


def _columns(message: Message, kind: Kind) -> Columns:
    needed = _NEEDED[kind]
    n = len(getattr(message, needed[0]))
    if not 1 <= n <= MAX_ROWS:
        raise WireError(needed[0], f"{n} records", f"send 1 to {MAX_ROWS}")
    columns: Columns = {}
    for name, dtype in column_types(kind).items():
        sent = getattr(message, name)
        if name == "log_likelihood":
            columns[name] = _likelihood(sent, n)
        elif len(sent) == n:
            columns[name] = _numbers(name, sent, dtype)
        elif len(sent) or name in needed:
            raise WireError(name, f"has {len(sent)} records, {needed[0]} has {n}", "give every column the same length")
        else:
            columns[name] = np.full(n, np.nan if dtype.kind == "f" else _ABSENT.get(name, 0), dtype)
    return _derive(message, columns, kind)


def _numbers(name: str, sent: Any, dtype: np.dtype[Any]) -> NDArray[Any]:  # noqa: ANN401
    try:
        return np.fromiter(sent, dtype, len(sent))
    except OverflowError as error:
        raise WireError(name, f"does not fit {dtype}", "use the values that the .proto names") from error


def _likelihood(sent: bytes, n: int) -> NDArray[np.uint8]:
    if len(sent) not in (0, n * mugrid.BINS):
        raise WireError("log_likelihood", f"{len(sent)} bytes for {n} records", f"send {mugrid.BINS} a record, or none")
    return np.frombuffer(sent, np.uint8).reshape(n, -1)


def _derive(message: Message, columns: Columns, kind: Kind) -> Columns:
    """Fill what follows from the pose, where the sender left it out."""
    if kind is Kind.OBSERVATION:
        if not message.leave_time:  # type: ignore[attr-defined]
            columns["leave_time"] = columns["enter_time"].copy()
        if not message.cell:  # type: ignore[attr-defined]
            columns["cell"] = grid.cell_of(*_finite_position(columns))
        if not message.sector and np.isfinite(columns["yaw"]).all():  # type: ignore[attr-defined]
            columns["sector"] = grid.sector_of(columns["yaw"])
    return columns


def _first_cell(columns: Columns) -> int:
    if "cell" in columns:
        return int(columns["cell"][0])
    latitude, longitude = _finite_position(columns)
    return int(grid.cell_of(latitude[0], longitude[0]))


def _finite_position(columns: Columns) -> tuple[NDArray[Any], NDArray[Any]]:
    for name in ("latitude", "longitude"):
        if not np.isfinite(columns[name]).all() or np.abs(columns[name]).max() > 180.0:
            raise WireError(name, "is not a position", "send finite degrees")
    return columns["latitude"], columns["longitude"]


@dataclass(frozen=True)
class StreamAck:
    """Settled batches of one stream: ranges of seq, both ends included, and (seq, row, reason) of the refused ones."""

    boot: int
    kind: Kind
    region: int
    durable: tuple[tuple[int, int], ...] = ()
    rejected: tuple[tuple[int, int, str], ...] = ()


def encode_ack(vehicle: str, streams: list[StreamAck]) -> bytes:
    """Protobuf bytes of an acknowledgement."""
    message = pb.Ack(vehicle=vehicle)
    for stream in streams:
        message.streams.add(
            boot=stream.boot, kind=_PB_KIND[stream.kind], region=stream.region,
            durable=[pb.SeqRange(first=first, last=last) for first, last in stream.durable],
            rejected=[pb.Rejection(seq=seq, row=row, reason=reason) for seq, row, reason in stream.rejected],
        )  # fmt: skip
    return message.SerializeToString()


def decode_ack(payload: bytes) -> tuple[str, list[StreamAck]]:
    """Vehicle and streams of an acknowledgement.

    Raises:
        WireError: not an Ack, or of a kind that this version does not know.
    """
    message = _parse(payload, ACK_ENCODING, pb.Ack(), ACK_ENCODING)
    if any(stream.kind not in _KIND_OF for stream in message.streams):
        raise WireError("kind", "is unknown", "use KIND_OBSERVATION or KIND_STATE")
    return message.vehicle, [
        StreamAck(
            stream.boot, _KIND_OF[stream.kind], stream.region,
            tuple((r.first, r.last) for r in stream.durable),
            tuple((r.seq, r.row, r.reason) for r in stream.rejected),
        )
        for stream in message.streams
    ]  # fmt: skip


@dataclass(frozen=True)
class Alert:
    """A cell became slippery (`raised`), or ceased to be, and why; see the message of the same name."""

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
    """Protobuf bytes of an alert."""
    return pb.Alert(**vars(alert)).SerializeToString()


def decode_alert(payload: bytes) -> Alert:
    """Read an alert.

    Raises:
        WireError: not an Alert.
    """
    message = _parse(payload, ALERT_ENCODING, pb.Alert(), ALERT_ENCODING)
    return Alert(**{name: getattr(message, name) for name in Alert.__dataclass_fields__})
