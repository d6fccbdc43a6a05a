"""Tests of the compiled decoder: it decodes every message that it accepts exactly like the protobuf
module.
"""

from __future__ import annotations

import struct
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from fleet_service.ingest.batch_decoder import decode_many
from fleet_service.ingest.protobuf_scan import NUMBERS, TEXTS, gather_values, walk_fields
from schemas import mugrid
from schemas.errors import WireError
from schemas.proto import gripmap_pb2 as pb
from schemas.wire import ENCODING, MESSAGES, NEEDED, Kind, column_types, decode

KINDS = st.sampled_from(list(Kind))
_I64 = st.integers(-(2**63), 2**63 - 1)
_I32 = st.one_of(st.integers(-3, 5), st.integers(-(2**31), 2**31 - 1))
_FLOAT = st.floats(width=32)


@st.composite
# protobuf messages have no types.
def draw_message(draw: Callable[[Any], Any], kind: Kind) -> Any:  # noqa: ANN401
    """Return a random message of the given kind, observations or states. Its records have some of
    the columns, with arbitrary values.
    """
    rows = draw(st.integers(1, 4))
    message = MESSAGES[kind](
        vehicle=draw(st.sampled_from(["sim-001", "", "a" * 200])),
        estimator=draw(st.sampled_from(["", "ckf"])),
        boot=draw(_I64),
        region=draw(_I64),
        seq=draw(_I64),
        first_held=draw(_I64),
    )
    for name, dtype in column_types(kind).items():
        if name not in NEEDED[kind] and not draw(st.booleans()):
            continue
        if name == "log_likelihood":
            message.log_likelihood = draw(st.binary(min_size=32 * rows, max_size=32 * rows))
        else:
            integer = _I64 if dtype.itemsize == 8 else _I32
            element = _FLOAT if dtype.kind == "f" else integer
            getattr(message, name).extend(draw(st.lists(element, min_size=rows, max_size=rows)))
    return message


def is_agreed(kind: Kind, payload: bytes) -> bool:
    """Return True if the service's compiled decoder accepts the bytes of a message. Fail if its
    result then differs from that of the protobuf library.
    """
    data = np.frombuffer(payload, np.uint8)
    found = walk_fields(kind, data, np.array([len(payload)]))
    if not found.understood[0]:
        return False
    message = MESSAGES[kind].FromString(payload)
    assert found.numbers[0].tolist() == [getattr(message, name) for name in NUMBERS]
    texts = [payload[begin:end].decode() for begin, end in found.texts[0].tolist()]
    assert texts == [getattr(message, name) for name in TEXTS]
    for at, (name, dtype) in enumerate(column_types(kind).items()):
        values = getattr(message, name)
        rows = int(found.sizes[0])
        if not len(values):
            assert not found.counts[0, at]
        elif name == "log_likelihood":
            into = np.zeros((rows, mugrid.BINS), np.uint8)
            gather_values(data, found, at, kind, into)
            assert into.tobytes() == values
        else:
            wide = dtype if dtype.kind == "f" else np.dtype(np.int64)
            column = np.zeros(rows, wide)
            gather_values(data, found, at, kind, column)
            assert column.tobytes() == np.array(list(values), wide).tobytes()
    return True


@given(KINDS.flatmap(lambda kind: st.tuples(st.just(kind), draw_message(kind))))
def test_decoder_reads_messages_of_the_protobuf_module_exactly(
    case: tuple[Kind, Any],
) -> None:
    kind, message = case
    assert is_agreed(kind, message.SerializeToString())


@given(
    KINDS.flatmap(lambda kind: st.tuples(st.just(kind), draw_message(kind))),
    st.lists(st.tuples(st.integers(0, 2000), st.integers(0, 255)), max_size=4),
    st.integers(0, 2000),
    st.binary(max_size=12),
)
def test_decoder_agrees_with_the_protobuf_module_on_damaged_bytes(
    case: tuple[Kind, Any], flips: list[tuple[int, int]], cut: int, inserted: bytes
) -> None:
    kind, message = case
    payload = bytearray(message.SerializeToString())
    for place, value in flips:
        payload[place % len(payload)] = value
    is_agreed(kind, bytes(payload))
    place = cut % len(payload)
    is_agreed(kind, bytes(payload[:place]))
    is_agreed(kind, bytes(payload[:place]) + inserted + bytes(payload[place:]))


@given(st.binary(max_size=200), KINDS)
def test_decoder_agrees_with_the_protobuf_module_on_any_bytes(payload: bytes, kind: Kind) -> None:
    is_agreed(kind, payload)


def _make_example() -> Any:  # noqa: ANN401
    message = pb.ObservationBatch(vehicle="sim-001", boot=7, region=5, seq=3, first_held=2)
    message.enter_time.extend([1, 2])
    message.latitude.extend([57.0, 57.0])
    message.longitude.extend([12.0, 12.0])
    message.health.extend([-1, 2])
    message.sector.extend([0, 1])
    return message


def _encode_run(number: int, body: bytes) -> bytes:
    return bytes([(number << 3 & 127 | 2) | 128, number >> 4, len(body)]) + body


@pytest.mark.parametrize(
    "more",
    [
        _encode_run(40, b"unknown"),
        _encode_run(31, bytes([1, 1])),  # health a second time, which appends to the column
        _encode_run(25, struct.pack("<2f", 1.0, 2.0)) + _encode_run(25, b""),
        b"\x98\x00" + b"\x01",  # tag of field 3, encoded longer than necessary
        bytes([25 << 3 & 127 | 5 | 128, 25 >> 4]) + struct.pack("<f", 1.0),  # speed, not packed
        bytes([2 << 3 | 1]) + bytes(8),  # boot a second time, which replaces the first
        _encode_run(33, b"\x00" * 7),
        _encode_run(32, b"\x80" * 9 + b"\x02" + b"\x00"),  # a number of more than 64 bits
        _encode_run(32, b"\x80\x80\x80\x80\x10" + b"\x00"),  # a number of more than 32 bits
    ],
)
def test_unusual_encodings_are_left_to_the_protobuf_module(more: bytes) -> None:
    payload = _make_example().SerializeToString()
    assert is_agreed(Kind.OBSERVATION, payload)
    assert not is_agreed(Kind.OBSERVATION, payload + more)
    with_error = decode_many(Kind.OBSERVATION, [(payload, ""), (payload + more, ""), (payload, "")])
    assert with_error.indices[0] == 0
    assert with_error.indices[-1] == 2


def test_unknown_fields_and_unpacked_columns_are_read() -> None:
    message = _make_example()
    plain = decode(message.SerializeToString(), "", Kind.OBSERVATION)
    unpacked = b"".join(
        bytes([25 << 3 & 127 | 5 | 128, 25 >> 4]) + struct.pack("<f", v) for v in (3.0, 4.0)
    )
    odd = decode(
        _encode_run(40, b"later version") + message.SerializeToString() + unpacked,
        "",
        Kind.OBSERVATION,
    )
    assert odd.columns["speed"].tolist() == [3.0, 4.0]
    assert (odd.vehicle, odd.boot, odd.seq) == (plain.vehicle, plain.boot, plain.seq)
    assert odd.columns["health"].tolist() == [-1, 2]


def test_non_ascii_names_go_to_the_library_and_broken_ones_are_refused() -> None:
    message = _make_example()
    message.vehicle = "müller"
    payload = message.SerializeToString()
    assert not is_agreed(Kind.OBSERVATION, payload)
    assert decode(payload, ENCODING[Kind.OBSERVATION], Kind.OBSERVATION).vehicle == "müller"
    with pytest.raises(WireError, match="^payload: "):
        decode(payload.replace("ü".encode(), b"\xff\xff"), "", Kind.OBSERVATION)
