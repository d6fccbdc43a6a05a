"""Benchmark of the encoding of observations: time and size of one observation in a message and in
Parquet.
"""

from __future__ import annotations

import tempfile
from collections.abc import Iterable
from pathlib import Path
from typing import Final

from fleet_service.analytics import synthetic
from fleet_service.analytics.synthetic import SyntheticFleet
from fleet_service.archive.format import segments
from fleet_service.archive.maintenance.compaction import compact
from fleet_service.ingest.batch_decoder import decode_many
from schemas import wire
from schemas.runtime.figures import Figure
from schemas.wire import Batch, Kind
from tests.benchmarks.fabricated import make_visits
from tests.benchmarks.measure import SEED, median_s

WORLD: Final = SyntheticFleet(500_000, days=1, seed=SEED)


def contract() -> list[Figure]:
    """Measure the time to encode and to decode one observation in a message with ten
    observations, and its size in the message and in Parquet.
    """
    rows = 10
    columns = make_visits(10, 1, 10)
    names = wire.column_types(Kind.OBSERVATION)
    batch = Batch(
        Kind.OBSERVATION, "bench", 1, 1, 1, 1, {name: columns[name] for name in names}, "aco-fckf"
    )
    payload = wire.encode(batch)
    repeat = 300
    encoding = median_s(lambda: [wire.encode(batch) for _ in range(repeat)])
    decoding = median_s(lambda: decode_many(Kind.OBSERVATION, [(payload, "")] * repeat))
    return [
        Figure("bench.wire.encode_us", encoding / (repeat * rows) * 1e6, "us per observation"),
        Figure("bench.wire.decode_us", decoding / (repeat * rows) * 1e6, "us per observation"),
        Figure("bench.bytes.wire", len(payload) / rows, "bytes per observation", 160),
        *parquet_bytes(),
    ]


def parquet_bytes() -> list[Figure]:
    """Measure the size of an observation in an archive's Parquet files [bytes]. Return two figures:
    after compaction, which sorts the rows by cell, and before it.
    """
    with tempfile.TemporaryDirectory() as name:
        root = Path(name)
        synthetic.write_archive(root, WORLD)
        inbox = size_of(segments.list_segments(root, Kind.OBSERVATION))
        rows = compact(root).rows
        compacted = size_of((root / "observations").rglob("*.parquet"))
    return [
        Figure(
            "bench.bytes.parquet", compacted / rows, f"bytes per observation, {rows} compacted", 60
        ),
        Figure("bench.bytes.parquet_inbox", inbox / rows, "bytes per observation, before"),
    ]


def size_of(paths: Iterable[Path]) -> int:
    """Return the total size of files in bytes."""
    return sum(path.stat().st_size for path in paths)
