"""Tests of the tile decoder with untrusted input. A written tile must be read back unchanged. Any
other bytes must give a decoding error and nothing else.
"""

from __future__ import annotations

import contextlib
from typing import Literal

import numpy as np
import pyarrow as pa
import pytest
from hypothesis import given
from hypothesis import strategies as st

from schemas import tables
from schemas.errors import WireError
from schemas.wire import tile
from schemas.wire.tile import decode_tile


def make_table(rows: int) -> pa.Table:
    columns = [
        pa.array(["measured"] * rows)
        if f.type == pa.string()
        else pa.array(np.arange(rows) % 100).cast(f.type)
        for f in tables.MAP_SCHEMA
    ]
    return pa.Table.from_arrays(columns, schema=tables.MAP_SCHEMA)


def encode_stream(content: pa.Table, compression: Literal["lz4", "zstd"] | None = None) -> bytes:
    sink = pa.BufferOutputStream()
    with pa.ipc.new_stream(
        sink, content.schema, options=pa.ipc.IpcWriteOptions(compression=compression)
    ) as writer:
        writer.write_table(content)
    return bytes(sink.getvalue())


@pytest.mark.parametrize("rows", [0, 1, 300])
def test_tile_round_trips_unchanged(rows: int) -> None:
    assert decode_tile(encode_stream(make_table(rows))).equals(make_table(rows))


@pytest.mark.parametrize("compression", ["zstd", "lz4"])
def test_compressed_tile_is_refused_before_it_is_decompressed(
    compression: Literal["zstd", "lz4"],
) -> None:
    bomb = encode_stream(make_table(tile.MAX_ROWS), compression)
    assert len(bomb) < 0.2 * make_table(tile.MAX_ROWS).nbytes
    with pytest.raises(WireError, match="^tile: is compressed; "):
        decode_tile(bomb)


def test_too_many_cells_are_refused() -> None:
    with pytest.raises(WireError, match="^tile: has more than 131072 cells"):
        decode_tile(encode_stream(make_table(tile.MAX_ROWS + 1)))


def test_other_columns_are_refused() -> None:
    with pytest.raises(WireError, match="^tile: has columns that differ"):
        decode_tile(encode_stream(pa.table({"nothing": pa.nulls(1 << 30)})))


GOOD = encode_stream(make_table(20))


@given(st.data())
def test_no_bytes_raise_anything_but_a_wire_error(data: st.DataObject) -> None:
    payload = bytearray(GOOD)
    for _ in range(data.draw(st.integers(1, 4))):
        payload[data.draw(st.integers(0, len(payload) - 1))] = data.draw(st.integers(0, 255))
    cut = data.draw(st.integers(0, len(payload)))
    with contextlib.suppress(WireError):
        assert decode_tile(bytes(payload[:cut] if cut % 2 else payload)).num_rows <= tile.MAX_ROWS
