"""`make bench`: what each part costs, each against a limit measured in the same run where there is one.

Writes `.bench/figures.json` and prints the table. One thread per part; medians of several rounds after a warm-up.
"""

from __future__ import annotations

import io
import statistics
import sys
import time
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq

from edge_agent.estimators import create
from edge_agent.simulation import simulate_manoeuvre
from fleet_service.archive.rebuild import observations
from fleet_service.fusion import Fusion
from schemas import figures, grid, tables, wire
from schemas.figures import Figure
from schemas.numeric import FloatArray
from schemas.signals import CHANNELS
from schemas.wire import Batch, Columns, Kind

FOLDER = Path(".bench")
ROUNDS = 5
SEED = 0


def median_s(work: Callable[[], object], rounds: int = ROUNDS) -> float:
    """Median duration [s] after one call that warms up."""
    work()
    spent = []
    for _ in range(rounds):
        began = time.perf_counter()
        work()
        spent.append(time.perf_counter() - began)
    return statistics.median(spent)


def estimators() -> list[Figure]:
    """Microseconds per vehicle and sample of the default estimator, for one vehicle and for a bank."""
    log, vehicle = simulate_manoeuvre("double-lane-change", seed=SEED)
    signals = np.stack([log[name].to_numpy(zero_copy_only=False) for name in CHANNELS], axis=-1)[:, None, :]
    t: FloatArray = log["t"].to_numpy()[:, None]

    def drive(n: int, samples: int) -> float:
        block, times = np.repeat(signals[:samples], n, axis=1), np.repeat(t[:samples], n, axis=1)
        seconds = median_s(lambda: create("aco-fckf", [vehicle] * n).advance(times, block), 3)
        return seconds / (n * samples) * 1e6

    one, many = drive(1, len(t)), drive(200, 100)
    return [
        Figure("bench.aco_fckf.us", one, "us per vehicle-step, N = 1", 40),
        Figure("bench.bank.flatness", many / one, "N = 200 over N = 1", 1.2),
        Figure("bench.replay.real_time", 1e6 / (100 * one), "times real time at 100 Hz"),
    ]


def visits(rows: int, vehicles: int, cells: int) -> Columns:
    """Columns of observations spread over cells."""
    rng = np.random.default_rng(SEED)
    latitude, longitude = 57.0 + rng.integers(0, cells, rows) * 1e-4 / 100, 11.97 + rng.integers(0, 100, rows) * 2e-4
    columns: Columns = {}
    for name, dtype in wire.column_types(Kind.OBSERVATION).items():
        columns[name] = rng.uniform(0.2, 0.9, rows).astype(dtype) if dtype.kind == "f" else np.zeros(rows, dtype)
    columns["latitude"], columns["longitude"] = latitude, longitude
    columns["cell"], columns["sector"] = grid.cell_of(latitude, longitude), grid.sector_of(columns["yaw"])
    columns["enter_time"] = np.sort(rng.integers(0, 60_000_000_000, rows)) + 1_790_000_000_000_000_000
    columns["leave_time"] = columns["enter_time"] + 500_000_000
    shape = np.abs(np.arange(32) - rng.integers(4, 28, (rows, 1)))
    columns["log_likelihood"] = np.minimum(shape * rng.integers(2, 12, (rows, 1)), 255).astype(np.uint8)
    columns["boot"], columns["region"] = np.ones(rows, np.int64), grid.region_of(columns["cell"])
    columns["seq"], columns["row"] = np.arange(1, rows + 1), np.zeros(rows, np.int32)
    columns["vehicle_number"], columns["told"] = rng.integers(0, vehicles, rows), np.ones(rows, bool)
    return columns


def contract() -> list[Figure]:
    """Cost and size of an observation on the wire, ten to a message, and in Parquet."""
    rows, columns = 10, visits(10, 1, 10)
    names = wire.column_types(Kind.OBSERVATION)
    batch = Batch(Kind.OBSERVATION, "bench", 1, 1, 1, 1, {name: columns[name] for name in names}, "aco-fckf")
    payload = wire.encode(batch)
    repeat = 300
    encoding = median_s(lambda: [wire.encode(batch) for _ in range(repeat)])
    decoding = median_s(lambda: [wire.decode(payload, "", Kind.OBSERVATION) for _ in range(repeat)])
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


def fusion() -> list[Figure]:
    """Observations per second of the fusion alone, and what more cells do to it."""
    rows = 100_000

    def rate(cells: int) -> float:
        columns = visits(rows, 5000, cells)
        folded = observations(columns, columns["vehicle_number"])
        return rows / median_s(lambda: Fusion(120.0).fold(folded), 3)

    few, many = rate(100), rate(10_000)
    return [
        Figure("bench.fusion.per_s", many, "observations/s", 1_000_000, "more"),
        Figure("bench.growth.cells_ratio", few / many, "cost with 100 times the cells", 1.3),
    ]


def main() -> int:
    """Run all parts, with progress."""
    found: list[Figure] = []
    for part in (estimators, contract, fusion):
        print(f"{part.__name__}: {(part.__doc__ or '').splitlines()[0]}", flush=True)
        found += part()
    figures.write(FOLDER / "figures.json", "bench", [SEED], found)
    print(f"\n{figures.markdown(found)}\n\n{FOLDER}/figures.json")
    return 0


if __name__ == "__main__":
    sys.exit(main())
