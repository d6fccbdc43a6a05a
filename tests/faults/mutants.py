"""Malformed messages and queries, made from valid ones by changes of bytes, fields, text, encodings
and keys.
"""

from __future__ import annotations

import random
from collections.abc import Callable
from typing import Any, Final

from google.protobuf import json_format

from fleet_service.ingest.inbox import Message
from schemas import grid, keys, wire
from schemas.proto import gripmap_pb2 as pb
from schemas.wire import Kind
from tests.fleet_service.examples import LATITUDE, LONGITUDE, REGION, SECOND, batch, key
from tests.schemas.examples import batch as whole_batch

Random = random.Random
PLACES: Final = 64
_MESSAGE: Final[dict[Kind, Any]] = {
    Kind.OBSERVATION: pb.ObservationBatch,
    Kind.STATE: pb.StateBatch,
}
_NUMBERS: Final = (
    float("nan"),
    float("inf"),
    -float("inf"),
    0.0,
    -0.0,
    -1.0,
    1e-320,
    0.049,
    1.21,
    2.0001,
    90.0,
    180.0,
    181.0,
    400.0,
    1e9,
    1e38,
    1e308,
    3.15,
)
_WHOLE: Final = (
    0,
    -1,
    1,
    3,
    4,
    5,
    255,
    2**31 - 1,
    -(2**31),
    2**62,
    2**63 - 1,
    -(2**63),
    1 << 42,
    REGION,
    REGION + 1,
)
_TEXT: Final = (
    "",
    "*",
    "**",
    "$*",
    "../../etc/passwd",
    "<script>alert(1)</script>",
    "sim-000\n",
    "\0",
    "é",
    "a" * 4000,
    "0123",
    "rogue-1/../x",
    "'; drop table",
    "{name}",
    "@/**",
)
_ENCODINGS: Final = (
    "",
    wire.JSON,
    wire.ARROW,
    "application/protobuf",
    "zenoh/bytes",
    "text/html",
    wire.ACK_ENCODING,
    *wire.ENCODING.values(),
    "x" * 300,
)


class Mutants:
    """Source of malformed messages of the vehicles `rogue-NN`. A test may set `now` [ns], which is
    the time that the messages state.
    """

    def __init__(self, seed: int, now: int) -> None:
        self._random = random.Random(seed)
        self.now = now
        self._seq = 0

    def make_message(self) -> Message:
        """Return the next malformed message: a valid one in which some bytes or fields were changed
        at random.
        """
        r = self._random
        kind = r.choice(list(Kind))
        name = f"rogue-{r.randrange(50):02}"
        payload, encoding = self._make_payload(kind, name)
        place = key(name) if kind is Kind.OBSERVATION else keys.state_key(REGION, name)
        if r.random() < 0.05:
            place = _changed_key(r, place)
        if r.random() < 0.05:
            encoding = r.choice(_ENCODINGS)
        return Message(
            r.choice(list(Kind)) if r.random() < 0.02 else kind, place, payload, encoding
        )

    def _make_payload(self, kind: Kind, name: str) -> tuple[bytes, str]:
        r = self._random
        message = self._make_valid(kind, name)
        if r.random() < 0.1:
            text = json_format.MessageToJson(message, preserving_proto_field_name=True)
            return _changed_text(r, text).encode("utf-8", "replace"), wire.JSON
        if r.random() < 0.5:
            for _ in range(r.choice((1, 1, 2, 5))):
                _change_field(r, message)
            return message.SerializeToString(), wire.ENCODING[kind]
        return changed_bytes(r, message.SerializeToString()), wire.ENCODING[kind]

    # protobuf messages have no types.
    def _make_valid(self, kind: Kind, name: str) -> Any:  # noqa: ANN401
        self._seq += 1
        message = _MESSAGE[kind]()
        message.CopyFrom(self._random.choice(_VALID[kind]))
        message.vehicle = name
        message.seq = self._seq
        message.boot = self._random.choice((5, 6, 7))
        rows = len(message.latitude)
        if kind is Kind.OBSERVATION:
            message.leave_time[:] = [self.now] * rows
            message.enter_time[:] = [self.now - SECOND] * rows
        else:
            message.time[:] = [self.now] * rows
        return message

    def make_query(self) -> dict[str, str]:
        """Return the parameters of a malformed query."""
        r = self._random
        asked = dict(r.sample(list(_QUERY.items()), r.randrange(1, 4)))
        for _ in range(r.choice((1, 1, 2, 4))):
            name = r.choice(list(asked))
            value = asked[name]
            act = r.randrange(6)
            if act == 0:
                asked[name] = r.choice(_TEXT)
            elif act == 1:
                asked[name] = value.replace(
                    r.choice(value or "0"), r.choice((*"-.,|:eEZ+ 9", "nan", "inf", "1e999", "")), 1
                )
            elif act == 2:
                asked[name] = (value * r.choice((2, 50, 2000)))[:100_000]
            elif act == 3:
                asked[r.choice(_TEXT)] = value
            elif act == 4:
                asked[name] = "".join(chr(r.randrange(1, 0x2FF)) for _ in range(r.randrange(20)))
            else:
                asked[name] = str(r.choice((*_NUMBERS, *_WHOLE)))
        return asked


def _make_states() -> Any:  # noqa: ANN401
    state = pb.StateBatch.FromString(wire.encode(whole_batch(Kind.STATE)))
    state.region = REGION
    state.first_held = 1
    state.latitude[:] = [57.7] * len(state.time)
    state.longitude[:] = [11.97] * len(state.time)
    return state


def _shift_columns(place: int, rows: int) -> dict[str, Any]:
    """Return the position and cell columns of `rows` rows. All rows have the same position, which
    lies `place` times 2e-4 degrees east of (LATITUDE, LONGITUDE).
    """
    longitude = LONGITUDE + 2e-4 * place
    return {
        "longitude": [longitude] * rows,
        "cell": [int(grid.cell_of(LATITUDE, longitude))] * rows,
    }


_VALID: Final = {
    Kind.OBSERVATION: [
        pb.ObservationBatch.FromString(
            wire.encode(
                batch(
                    "rogue-00",
                    1,
                    0,
                    mu,
                    with_likelihood=with_likelihood,
                    **_shift_columns(place, len(mu)),
                )
            )
        )
        for mu in ([0.8], [0.2], [0.3, 0.9], [0.5, 0.6, 0.7, 0.8, 0.9])
        for with_likelihood in (True, False)
        for place in range(PLACES)
    ],
    Kind.STATE: [_make_states()],
}
_QUERY: Final = {
    "bbox": "11.9,57.6,12.0,57.8",
    "route": "11.96,57.7|11.98,57.7",
    "min_vehicles": "2",
    "format": "json",
    "at": "2026-01-31T07:00:00Z",
    "basis": "borrowed",
}


def changed_bytes(r: Random, data: bytes) -> bytes:
    """Return a copy of `data` in which a few bytes were changed, removed, repeated or inserted."""
    out = bytearray(data)
    for _ in range(r.choice((1, 1, 1, 2, 4, 16))):
        at = r.randrange(len(out)) if out else 0
        act = r.randrange(7)
        if act == 0 and out:
            out[at] = r.randrange(256)
        elif act == 1 and out:
            out[at] ^= 1 << r.randrange(8)
        elif act == 2:
            del out[at : at + r.randrange(1, 40)]
        elif act == 3:
            out[at:at] = r.randbytes(r.randrange(1, 40))
        elif act == 4:
            del out[at:]
        elif act == 5:
            out += out[at : at + 200]
        elif len(out) < 2000:
            out *= 2
    return bytes(out)


def _change_field(r: Random, message: Any) -> None:  # noqa: ANN401
    field = r.choice(message.DESCRIPTOR.fields)
    many = field.is_repeated
    kinds = type(field)
    pool: Callable[[], Any]
    if field.type == kinds.TYPE_STRING:
        setattr(message, field.name, r.choice(_TEXT))
        return
    if field.type == kinds.TYPE_BYTES:
        setattr(message, field.name, r.randbytes(r.choice((0, 1, 31, 32, 33, 64, 320, 5000))))
        return
    if field.cpp_type in (kinds.CPPTYPE_DOUBLE, kinds.CPPTYPE_FLOAT):
        pool = lambda: r.choice(_NUMBERS)  # noqa: E731
    else:
        bits = 31 if field.cpp_type == kinds.CPPTYPE_INT32 else 63
        pool = lambda: max(-(1 << bits), min(r.choice(_WHOLE), (1 << bits) - 1))  # noqa: E731
    if not many:
        setattr(message, field.name, pool())
        return
    column = getattr(message, field.name)
    act = r.randrange(5)
    if act == 0 and len(column):
        column[r.randrange(len(column))] = pool()
    elif act == 1:
        column[:] = [pool() for _ in range(len(column))]
    elif act == 2:
        del column[:]
    elif act == 3:
        column.extend([pool() for _ in range(r.choice((1, 1, 2, 2, 60, 60, 60, 1000)))])
    elif len(column):
        column.pop()


def _changed_text(r: Random, text: str) -> str:
    act = r.randrange(8)
    if act == 0:
        return text.replace(": [", ": " + "[" * r.choice((2, 50, 3000)), 1)
    if act == 1:
        return text[: r.randrange(len(text))]
    if act == 2:
        return text.replace(
            "1",
            r.choice(("1e999", "NaN", '"Infinity"', "9" * 5000, "true", "null", "-1e-400")),
            r.choice((1, 3)),
        )
    if act == 3:
        return text.replace("}", ', "estimator": ' + '{"a":' * r.choice((1, 40, 2000)) + "}", 1)
    if act == 4:
        return text.replace('"', r.choice(("'", "", '""', "\\u0000")), r.randrange(1, 6))
    if act == 5:
        return r.choice(
            (
                "",
                "null",
                "[]",
                "{}",
                "[" * 50_000,
                '{"' + "a" * 60_000 + '":1}',
                "\ud800",
                "1",
                '"x"',
            )
        )
    if act == 6:
        return text + text
    at = r.randrange(len(text))
    return text[:at] + r.choice(_TEXT) + text[at:]


def _changed_key(r: Random, place: str) -> str:
    parts = place.split("/")
    at = r.randrange(len(parts))
    parts[at] = r.choice((*_TEXT[1:], "rogue-99", "4444", "012", "obs", "state", "map"))
    if r.random() < 0.2:
        del parts[r.randrange(len(parts))]
    return "/".join(parts)
