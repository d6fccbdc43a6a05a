"""Cost and size of an observation, on the wire and in Parquet."""

from __future__ import annotations

import io

import pyarrow as pa
import pyarrow.parquet as pq

from schemas import tables, wire
from schemas.decoding import decode_many
from schemas.figures import Figure
from schemas.wire import Batch, Columns, Kind
from tests.benchmarks.fabricated import visits
from tests.benchmarks.measure import median_s


def contract() -> list[Figure]:
    """Cost and size of an observation on the wire, ten to a message, and in Parquet."""
    rows, columns = 10, visits(10, 1, 10)
    names = wire.column_types(Kind.OBSERVATION)
    batch = Batch(Kind.OBSERVATION, "bench", 1, 1, 1, 1, {name: columns[name] for name in names}, "aco-fckf")
    payload = wire.encode(batch)
    repeat = 300
    encoding = median_s(lambda: [wire.encode(batch) for _ in range(repeat)])
    decoding = median_s(lambda: decode_many(Kind.OBSERVATION, [(payload, "")] * repeat))
    return [
        Figure("bench.wire.encode_us", encoding / (repeat * rows) * 1e6, "us per observation"),
        Figure("bench.wire.decode_us", decoding / (repeat * rows) * 1e6, "us per observation"),
        Figure("bench.bytes.wire", len(payload) / rows, "bytes per observation", 160),
        Figure("bench.bytes.parquet_inbox", parquet_bytes(visits(50_000, 1000, 10_000)), "bytes per observation"),
    ]


def parquet_bytes(columns: Columns) -> float:
    """Bytes per observation of a segment, zstd, in the order of arrival."""
    arrays, fields = [], []
    for field in tables.OBSERVATION:
        values = columns[field.name]
        array = (
            pa.array(list(map(bytes, values)), field.type) if values.ndim == 2 else pa.array(values).cast(field.type)
        )
        arrays.append(array)
        fields.append(pa.field(field.name, field.type))
    buffer = io.BytesIO()
    pq.write_table(pa.table(arrays, schema=pa.schema(fields)), buffer, compression="zstd")
    return len(buffer.getvalue()) / len(columns["cell"])
