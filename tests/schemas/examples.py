"""Example batches for the tests of the contract (messages and tables in `schemas`). Run as a
program, this module writes the recorded messages of version 1 (see `__main__`).
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from schemas import grid, weather, wire
from schemas.proto import gripmap_pb2 as pb
from schemas.wire import Alert, Batch, Kind, StreamAck

DATA = Path(__file__).parent / "data"
# Columns that are newer than the stored bytes.
LATER = (
    "used_longitudinal",
    "used_lateral",
    "esc_active",
    "tcs_active",
    "wiper",
    "p_slippery",
)


def encode_weather(report: weather.Report) -> bytes:
    """Return the protobuf bytes of a weather report."""
    values = {name: getattr(report, name) for name in weather.RANGES}
    known = {name: value for name, value in values.items() if not np.isnan(value)}
    prior = [] if report.prior is None else np.asarray(report.prior).tolist()
    return pb.Weather(time=report.time, prior=prior, **known).SerializeToString()


def batch(kind: Kind, rows: int = 3) -> Batch:
    """Return an example batch in which every column has distinct values."""
    rng = np.random.default_rng(7)
    columns: dict[str, NDArray[Any]] = {}
    for name, dtype in wire.column_types(kind).items():
        if name == "log_likelihood":
            columns[name] = rng.integers(0, 256, (rows, 32)).astype(np.uint8)
        elif dtype.kind == "f":
            columns[name] = rng.uniform(0.1, 1.0, rows).astype(dtype)
        elif dtype == np.int64:
            columns[name] = rng.integers(1, 1 << 42, rows)
        else:
            columns[name] = rng.integers(0, 4, rows).astype(dtype)
    columns["latitude"] = 57.70 + 1e-4 * np.arange(rows)
    columns["longitude"] = 11.97 + 1e-4 * np.arange(rows)
    if kind is Kind.OBSERVATION:
        columns["cell"] = grid.cell_of(columns["latitude"], columns["longitude"])
    region = int(grid.region_of(grid.cell_of(57.70, 11.97)))
    return Batch(kind, "volvo-240", 2**62 + 5, region, 17, 12, columns, "aco-fckf")


def batch_of_version_1(kind: Kind) -> Batch:
    """Return the same batch as `batch`, but without the columns that versions after 1 added."""
    whole = batch(kind)
    return replace(
        whole, columns={name: c for name, c in whole.columns.items() if name not in LATER}
    )


def make_acknowledgement() -> tuple[str, list[StreamAck]]:
    """Return an acknowledgement of two streams. A stream is all batches of one vehicle, kind and
    region.
    """
    return "volvo-240", [
        StreamAck(2**62 + 5, Kind.OBSERVATION, 396_303, durable=((1, 12), (14, 14))),
        StreamAck(
            2**62 + 5, Kind.STATE, 396_303, durable=((1, 3),), rejected=((4, 2, "latitude"),)
        ),
    ]


def make_alert() -> Alert:
    """Return an alert whose floating-point numbers are exact in 32 bits."""
    return Alert(
        1_664_484_383_910,
        2,
        True,
        1_790_000_000_000_000_000,
        0.25,
        0.125,
        0.375,
        0.9375,
        3,
        57.7,
        11.97,
        "seen by 3",
    )


MESSAGES: dict[str, Callable[[], bytes]] = {
    "observation_batch": lambda: wire.encode(batch_of_version_1(Kind.OBSERVATION)),
    "state_batch": lambda: wire.encode(batch_of_version_1(Kind.STATE)),
    "ack": lambda: wire.encode_ack(*make_acknowledgement()),
    "alert": lambda: wire.encode_alert(make_alert()),
}

# Run this only to add a message. The stored bytes of a version never change.
if __name__ == "__main__":
    for name, make in MESSAGES.items():
        path = DATA / f"{name}.v1.bin"
        if not path.exists():
            path.write_bytes(make())
