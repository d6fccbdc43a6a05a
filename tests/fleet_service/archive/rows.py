"""Synthetic rows of observations and states, as the service would write them."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from fleet_service.archive.format import reading
from fleet_service.archive.format.segments import SCHEMAS, Rows, Writer, round_to_steps
from fleet_service.fusion.vote_weights import UNCORRECTED
from schemas import grid, mugrid, tables
from schemas.wire import Kind

DAY_NS = 86_400 * 10**9
START = 20_000 * DAY_NS + DAY_NS - 600 * 10**9  # [ns] ten minutes before midnight
PLACES = ((57.7, 11.97), (48.1, 11.6))  # places in two zones


def rows_of(kind: Kind, count: int, seed: int = 0, vehicles: int = 5) -> Rows:
    """Return `count` rows of observations or states within twenty minutes around midnight, in cells
    of two zones (map squares of zoom 7). No two rows of a call have the same vehicle, seq (number
    of the batch) and row.
    """
    rng = np.random.default_rng(seed)
    place = np.array(PLACES)[rng.integers(0, 2, count)] + rng.normal(0.0, 1e-4, (count, 2))
    rows: Rows = {}
    for field in SCHEMAS[kind]:
        if field.type == tables.LIKELIHOOD:
            rows["with_likelihood"] = rng.random(count) < 0.8
            rows[field.name] = (
                rng.integers(0, 256, (count, mugrid.BINS)).astype(np.uint8)
                * rows["with_likelihood"][:, None]
            )
        elif field.type == tables.US:
            rows[field.name] = START + rng.integers(0, 1200 * 10**9, count)
        else:
            rows[field.name] = np.zeros(count, field.type.to_pandas_dtype())
    rows["latitude"], rows["longitude"] = place.T
    rows["cell"] = grid.cell_of(*place.T)
    rows["region"] = grid.region_of(rows["cell"])
    rows["vehicle"] = np.array([f"{name:016x}" for name in rng.integers(0, 2**63, vehicles)])[
        rng.integers(0, vehicles, count)
    ]
    rows["estimator"] = np.full(count, "ckf")
    rows["seq"] = np.arange(1, count + 1)
    rows["first_held"] = np.ones(count, np.int64)
    rows["boot"] = np.full(count, seed, np.int64)
    if kind is Kind.OBSERVATION:
        rows["enter_time"] = rows["leave_time"] - 10**9
        rows["mu"], rows["mu_utilised"] = rng.uniform(0.1, 1.0, (2, count)).astype(np.float32)
        rows["weight"] = np.full(count, 0.75, np.float32)
        rows["late_by"] = np.zeros(count, np.int64)
        rows |= {name: np.full(count, value, np.float32) for name, value in UNCORRECTED.items()}
    return round_to_steps(rows)


def fill(root: Path, segments: int, count: int, seed: int = 0) -> Writer:
    """Write segments (files of new rows) of both kinds, observations and states, with `count` rows
    each. Return the writer of the segments.
    """
    writer = Writer(root, "shard-0")
    for k in range(segments):
        for kind in Kind:
            writer.write(kind, rows_of(kind, count, seed + k))
    return writer


def identities(root: Path, kind: Kind) -> list[tuple[int, int]]:
    """Return one pair (boot, seq) for every row of an archive, sorted. `boot` is the start of the
    agent, and `seq` is the number of the batch.
    """
    return sorted(
        (row["boot"], row["seq"])
        for table in reading.read_tables(root, kind, ["boot", "seq"])
        for row in table.to_pylist()
    )
