"""Tests of the wire format, in every version ever sent. A decoded message must equal the encoded
one, and other bytes must be refused with a reason.
"""

from __future__ import annotations

import contextlib
import json

import numpy as np
import pytest
from google.protobuf import json_format
from hypothesis import given
from hypothesis import strategies as st

from schemas import grid, tables, wire
from schemas.errors import WireError
from schemas.proto import gripmap_pb2 as pb
from schemas.signals import FLAGS
from schemas.wire import Batch, Kind, decode
from tests.schemas.examples import (
    DATA,
    LATER,
    MESSAGES,
    batch,
    batch_of_version_1,
    make_acknowledgement,
    make_alert,
)

NUMPY_OF = {"double": "float64", "float": "float32", "sfixed64": "int64"}
HEADER = {"vehicle", "boot", "region", "seq", "first_held", "estimator"}


def assert_same(a: Batch, b: Batch) -> None:
    assert (a.kind, a.vehicle, a.boot, a.region, a.seq, a.first_held, a.estimator) == (
        b.kind,
        b.vehicle,
        b.boot,
        b.region,
        b.seq,
        b.first_held,
        b.estimator,
    )
    assert a.columns.keys() == b.columns.keys()
    for name, column in a.columns.items():
        assert column.dtype == b.columns[name].dtype, name
        np.testing.assert_array_equal(column, b.columns[name], err_msg=name)


@pytest.mark.parametrize("kind", Kind)
def test_batch_round_trips_unchanged(kind: Kind) -> None:
    sent = batch(kind, 50)
    assert_same(decode(wire.encode(sent), wire.ENCODING[kind], kind), sent)


@pytest.mark.parametrize("kind", Kind)
def test_json_mapping_equals_the_binary_message(kind: Kind) -> None:
    sent = batch(kind)
    message = (pb.ObservationBatch if kind is Kind.OBSERVATION else pb.StateBatch).FromString(
        wire.encode(sent)
    )
    text = json_format.MessageToJson(message, preserving_proto_field_name=True)
    assert_same(decode(text.encode(), wire.JSON, kind), sent)


@pytest.mark.parametrize(
    ("message", "fields"),
    [(pb.ObservationBatch, tables.OBSERVATION), (pb.StateBatch, tables.STATE)],
)
def test_protobuf_and_arrow_agree_field_by_field(
    message: type, fields: tuple[tables.Field, ...]
) -> None:
    descriptor = message.DESCRIPTOR  # type: ignore[attr-defined]
    on_wire = [f for f in descriptor.fields if f.name not in HEADER]
    assert [f.name for f in on_wire] == [f.name for f in fields]
    kind = Kind.OBSERVATION if fields is tables.OBSERVATION else Kind.STATE
    names = {
        v: k.removeprefix("TYPE_").lower()
        for k, v in on_wire[0].__class__.__dict__.items()
        if k.startswith("TYPE_")
    }
    for field in on_wire:
        dtype = wire.column_types(kind)[field.name]
        sent = names[field.type]
        if sent == "bytes":
            assert dtype == np.uint8
        elif sent == "int32":
            assert dtype.kind == "i"
            assert dtype.itemsize <= 4
        else:
            assert dtype == NUMPY_OF[sent], field.name


def test_the_batch_header_is_the_identity_of_the_archive() -> None:
    assert {f.name for f in tables.IDENTITY} - {"row"} == HEADER


@pytest.mark.parametrize("name", MESSAGES)
def test_bytes_of_version_1_are_still_written_and_read(name: str) -> None:
    kept = (DATA / f"{name}.v1.bin").read_bytes()
    if name.endswith("_batch"):
        kind = Kind.OBSERVATION if name.startswith("obs") else Kind.STATE
        found = decode(kept, wire.ENCODING[kind], kind)
        sent = batch_of_version_1(kind)
        absent = {name: found.columns.pop(name) for name in LATER if name in found.columns}
        assert all(
            (column == -1 if name in FLAGS else np.isnan(column)).all()
            for name, column in absent.items()
        )
        assert_same(found, sent)
    elif name == "ack":
        assert wire.decode_ack(kept) == make_acknowledgement()
    else:
        assert wire.decode_alert(kept) == make_alert()
    assert MESSAGES[name]() == kept


def test_a_person_can_publish_with_one_line() -> None:
    line = (
        '{"vehicle":"anna","boot":1,"seq":1,"enter_time":[1790000000000000000],"latitude":[57.7],'
    )
    line += '"longitude":[11.97],'
    line += '"yaw":[1.6],"mu":[0.3],"mu_lower":[0.2],"mu_upper":[0.4],"mu_utilised":[0.28]}'
    got = decode(line.encode(), wire.JSON, Kind.OBSERVATION)
    assert got.columns["cell"][0] == grid.cell_of(57.7, 11.97)
    assert got.columns["sector"][0] == 1
    assert got.columns["leave_time"][0] == 1790000000000000000
    assert got.region == grid.region_of(got.columns["cell"][0])
    assert np.isnan(got.columns["air_temperature"][0])
    assert [got.columns[name].tolist() for name in FLAGS] == [[-1]] * 3
    assert np.isnan(got.columns["wiper"][0])
    assert got.columns["log_likelihood"].shape == (1, 0)


def test_heading_in_degrees_is_refused_unless_the_sector_is_given() -> None:
    report = {"enter_time": [1], "latitude": [57.7], "longitude": [11.97], "yaw": [90.0]}
    with pytest.raises(WireError, match="^yaw: is more than a turn; send radians"):
        decode(json.dumps(report).encode(), wire.JSON, Kind.OBSERVATION)
    with_sector = json.dumps(report | {"sector": [1]}).encode()
    assert decode(with_sector, wire.JSON, Kind.OBSERVATION).columns["yaw"][0] == 90.0


def test_report_without_heading_is_refused_unless_the_sector_is_given() -> None:
    report = {"enter_time": [1, 2], "latitude": [57.7] * 2, "longitude": [11.97] * 2}
    for yaw in ({}, {"yaw": [1.6, "NaN"]}):
        with pytest.raises(WireError, match="^yaw: is missing; send radians"):
            decode(json.dumps(report | yaw).encode(), wire.JSON, Kind.OBSERVATION)
    with_sector = json.dumps(report | {"sector": [1, 3]}).encode()
    assert decode(with_sector, wire.JSON, Kind.OBSERVATION).columns["sector"].tolist() == [1, 3]


def test_columns_of_unequal_length_are_refused_by_name() -> None:
    message = pb.ObservationBatch.FromString(wire.encode(batch(Kind.OBSERVATION)))
    del message.speed[-1]
    with pytest.raises(WireError, match="^speed: has 2 records"):
        decode(message.SerializeToString(), "", Kind.OBSERVATION)


def test_too_many_records_are_refused_on_both_sides() -> None:
    with pytest.raises(WireError, match="^rows"):
        wire.encode(batch(Kind.STATE, 51))
    message = pb.StateBatch(time=[1] * 51, latitude=[1.0] * 51, longitude=[1.0] * 51)
    with pytest.raises(WireError, match="^time: 51 records"):
        decode(message.SerializeToString(), "", Kind.STATE)


@pytest.mark.parametrize(
    ("payload", "encoding"),
    [
        (b"\xff" * 40, ""),
        (b"", ""),
        (b"{", wire.JSON),
        (b"[" * 5000, wire.JSON),
        (b'{"nobody":1}', wire.JSON),
        (b"\xff\xfe", wire.JSON),
        (
            json.dumps({"enter_time": [1], "latitude": ["NaN"], "longitude": [0]}).encode(),
            wire.JSON,
        ),
        (
            json.dumps(
                {"enter_time": [1], "latitude": [1], "longitude": [0], "sector": [999]}
            ).encode(),
            wire.JSON,
        ),
        (bytes(wire.MAX_BYTES + 1), ""),
        (b"", "image/png"),
    ],
)
def test_garbage_is_refused_with_a_reason(payload: bytes, encoding: str) -> None:
    with pytest.raises(WireError, match=r".+: .+; .+"):
        decode(payload, encoding, Kind.OBSERVATION)


@given(st.binary(max_size=300), st.sampled_from(["", wire.JSON]), st.sampled_from(list(Kind)))
def test_no_bytes_raise_anything_but_a_wire_error(
    payload: bytes, encoding: str, kind: Kind
) -> None:
    with contextlib.suppress(WireError):
        assert 1 <= decode(payload, encoding, kind).rows <= wire.MAX_ROWS


@given(st.data())
def test_damaged_batches_raise_nothing_but_a_wire_error(data: st.DataObject) -> None:
    kind = data.draw(st.sampled_from(list(Kind)))
    payload = bytearray(wire.encode(batch(kind)))
    for _ in range(data.draw(st.integers(1, 4))):
        payload[data.draw(st.integers(0, len(payload) - 1))] = data.draw(st.integers(0, 255))
    with contextlib.suppress(WireError):
        assert 1 <= decode(bytes(payload), "", kind).rows <= wire.MAX_ROWS
