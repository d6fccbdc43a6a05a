"""Tests that roll-ups (hourly statistics per cell) equal sums over all rows, however the rows are
divided into files.
"""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq

from fleet_service.archive.format import reading
from fleet_service.archive.format.segments import to_nanoseconds
from fleet_service.archive.maintenance import rollup
from fleet_service.archive.maintenance.compaction import compact
from schemas import mugrid, tables
from schemas.wire import Kind
from tests.fleet_service.archive.rows import fill

# How to merge these columns; all other columns are summed.
JOIN: dict[str, Callable[..., Any]] = {
    "mu_min": min,
    "mu_max": max,
    "utilised_max": max,
    "vehicle_bits": np.bitwise_or,
}


def merge_parts(root: Path) -> dict[tuple[int, int, int], dict[str, Any]]:
    """Return the hourly statistics (roll-up) by (cell, heading sector, hour). The statistics are
    merged from all files that contain a part of them.
    """
    out: dict[tuple[int, int, int], dict[str, Any]] = {}
    for path in (root / rollup.TABLE).rglob("*.parquet"):
        table = pq.read_table(path, partitioning=None)
        assert table.schema.equals(tables.CELL_HOUR_SCHEMA)
        hours = to_nanoseconds(table["hour"]).tolist()
        for row, hour in zip(table.drop_columns(["hour"]).to_pylist(), hours, strict=True):
            key = (row.pop("cell"), row.pop("sector"), hour)
            row |= {name: np.array(row[name]) for name in ("mu_histogram", "log_likelihood_sum")}
            known = out.setdefault(key, row)
            if known is not row:
                for name, value in row.items():
                    known[name] = JOIN.get(name, np.add)(known[name], value)
    return out


def test_merged_parts_are_the_sums_over_all_rows(tmp_path: Path) -> None:
    fill(tmp_path, 3, 120)
    compact(tmp_path, round_rows=120)  # three rounds, so each hour has three parts
    assert rollup.complete_parts(tmp_path) == 12
    assert rollup.complete_parts(tmp_path) == 0
    rows = pa.concat_tables(reading.read_tables(tmp_path, Kind.OBSERVATION))
    direct: defaultdict[tuple[int, int, int], list[dict[str, Any]]] = defaultdict(list)
    for row, time in zip(
        rows.drop_columns(["leave_time", "enter_time", "received_at"]).to_pylist(),
        to_nanoseconds(rows["leave_time"]).tolist(),
        strict=True,
    ):
        direct[row["cell"], row["sector"], time // rollup.HOUR_NS * rollup.HOUR_NS].append(row)
    found = merge_parts(tmp_path)
    assert found.keys() == direct.keys()
    assert max(map(len, direct.values())) > 3
    for key, group in direct.items():
        mu = np.array([row["mu"] for row in group])
        sums = np.sum(
            [np.frombuffer(row["log_likelihood"] or bytes(mugrid.BINS), np.uint8) for row in group],
            axis=0,
        )
        assert found[key]["observations"] == found[key]["mu_count"] == len(group)
        assert found[key]["mu_min"] == mu.min()
        assert found[key]["utilised_max"] == max(row["mu_utilised"] for row in group)
        np.testing.assert_allclose(
            [found[key]["mu_sum"], found[key]["mu_sum_squares"]],
            [mu.sum(), (mu**2).sum()],
            rtol=1e-12,
        )
        np.testing.assert_array_equal(found[key]["mu_histogram"], np.histogram(mu, mugrid.EDGES)[0])
        np.testing.assert_array_equal(found[key]["log_likelihood_sum"], sums)


def test_bits_count_distinct_vehicles_also_across_parts(tmp_path: Path) -> None:
    fill(tmp_path, 6, 60)  # five vehicles in each of six segments: thirty in all
    compact(tmp_path, round_rows=60)
    rollup.complete_parts(tmp_path)
    bits = np.bitwise_or.reduce([row["vehicle_bits"] for row in merge_parts(tmp_path).values()])
    set_bits = bin(int(bits) & (2**64 - 1)).count("1")
    assert 0.7 * 30 < -64 * np.log(1 - set_bits / 64) < 1.3 * 30
