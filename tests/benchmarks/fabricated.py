"""Synthetic observations for benchmarks of the wire format, of the fusion into a map, and of the
archive.
"""

from __future__ import annotations

import numpy as np

from schemas import grid, wire
from schemas.wire import Columns, Kind
from tests.benchmarks.measure import SEED


def make_visits(rows: int, vehicles: int, cells: int) -> Columns:
    """Return the columns of `rows` observations of `vehicles` vehicles in `cells` cells."""
    rng = np.random.default_rng(SEED)
    latitude = 57.0 + rng.integers(0, cells, rows) * 1e-4 / 100
    longitude = 11.97 + rng.integers(0, 100, rows) * 2e-4
    columns: Columns = {}
    for name, dtype in wire.column_types(Kind.OBSERVATION).items():
        columns[name] = (
            rng.uniform(0.2, 0.9, rows).astype(dtype)
            if dtype.kind == "f"
            else np.zeros(rows, dtype)
        )
    columns["latitude"] = latitude
    columns["longitude"] = longitude
    columns["cell"] = grid.cell_of(latitude, longitude)
    columns["sector"] = grid.sector_of(columns["yaw"])
    columns["enter_time"] = (
        np.sort(rng.integers(0, 60_000_000_000, rows)) + 1_790_000_000_000_000_000
    )
    columns["leave_time"] = columns["enter_time"] + 500_000_000
    shape = np.abs(np.arange(32) - rng.integers(4, 28, (rows, 1)))
    columns["log_likelihood"] = np.minimum(shape * rng.integers(2, 12, (rows, 1)), 255).astype(
        np.uint8
    )
    columns["boot"] = np.ones(rows, np.int64)
    columns["region"] = grid.region_of(columns["cell"])
    columns["seq"] = np.arange(1, rows + 1)
    columns["row"] = np.zeros(rows, np.int32)
    columns["vehicle_number"] = rng.integers(0, vehicles, rows)
    columns["with_likelihood"] = np.ones(rows, bool)
    return columns
