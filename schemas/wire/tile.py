"""Reader for the messages with map tiles, which are Arrow streams from an untrusted sender.

The Arrow library trusts its input: it decompresses data to any size, and uses lengths and offsets
without checks. Therefore this module checks the header of each message before Arrow reads the body,
and validates the result in full.
"""

from __future__ import annotations

import struct
from typing import Final

import pyarrow as pa

from schemas.errors import WireError
from schemas.tables import MAP_SCHEMA

MAX_BYTES: Final = 64 * 1024 * 1024  # largest message that a router forwards
MAX_ROWS: Final = 1 << 17  # twice the rows of a full tile: 2^14 cells of four sectors
_BATCH: Final = 3  # MessageHeader type of a record batch in Arrow's IPC format
# Field numbers in the flatbuffers tables Message and RecordBatch of Arrow.
_TYPE = 1
_HEAD = 2
_COMPRESSION = 3


def decode_tile(payload: bytes) -> pa.Table:
    """Return the cells of a tile as a table.

    Raises:
        WireError: the tile is too large, compressed or damaged, or has other columns than the map.
    """
    if len(payload) > MAX_BYTES:
        raise WireError("tile", f"{len(payload)} bytes", f"send at most {MAX_BYTES}")
    try:
        _refuse_compressed(payload)
        with pa.ipc.open_stream(payload) as stream:
            if not stream.schema.equals(MAP_SCHEMA):
                raise WireError(
                    "tile",
                    "has columns that differ from the map's",
                    "use the schema of `tables.MAP_SCHEMA`",
                )
            table = _read_rows(stream)
        table.validate(full=True)
    except (pa.ArrowException, OSError, struct.error, IndexError, UnicodeDecodeError) as error:
        raise WireError(
            "tile", f"is not an Arrow stream ({type(error).__name__})", "write it with Arrow"
        ) from error
    return table


def _read_rows(stream: pa.RecordBatchStreamReader) -> pa.Table:
    batches: list[pa.RecordBatch] = []
    for batch in stream:
        batches.append(batch)
        if batch.num_rows < 0 or sum(one.num_rows for one in batches) > MAX_ROWS:
            raise WireError("tile", f"has more than {MAX_ROWS} cells", "send one tile at a time")
    return pa.Table.from_batches(batches, schema=stream.schema)


def _refuse_compressed(payload: bytes) -> None:
    for message in pa.ipc.MessageReader.open_stream(payload):
        head = message.metadata.to_pybytes()
        root = struct.unpack_from("<I", head, 0)[0]
        kind = _field_offset(head, root, _TYPE)
        body = _field_offset(head, root, _HEAD)
        if kind and body and head[kind] == _BATCH:
            batch = body + struct.unpack_from("<I", head, body)[0]
            if _field_offset(head, batch, _COMPRESSION):
                raise WireError(
                    "tile",
                    "is compressed",
                    "send it uncompressed; compressed tiles are refused because they can expand "
                    "without limit",
                )


def _field_offset(data: bytes, table: int, index: int) -> int:
    """Return the byte offset of field number `index` in the FlatBuffers table at the offset
    `table`; 0 if the field is absent.
    """
    layout = table - int(struct.unpack_from("<i", data, table)[0])
    if 4 + 2 * index >= int(struct.unpack_from("<H", data, layout)[0]):
        return 0
    offset = int(struct.unpack_from("<H", data, layout + 4 + 2 * index)[0])
    return table + offset if offset else 0
