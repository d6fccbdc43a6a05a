"""Fixtures: a small synthetic archive, and its rows in pandas, from which tests compute the
expected answers.
"""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pyarrow as pa
import pyarrow.csv as pacsv
import pyarrow.parquet as pq
import pytest

from fleet_service.analytics import synthetic
from fleet_service.analytics.engines import QueryEngine
from fleet_service.analytics.options import Options
from fleet_service.analytics.questions import QUESTIONS
from fleet_service.analytics.synthetic import DAY_S, START_NS, SyntheticFleet
from fleet_service.archive.export.extract import Extract
from fleet_service.archive.format import reading, snapshots
from fleet_service.archive.maintenance import rollup
from fleet_service.archive.maintenance.compaction import compact
from fleet_service.fusion import Fusion
from fleet_service.replay.rebuild import Since, replay
from fleet_service.serve.encode import cell_table
from schemas.numeric import IntArray
from schemas.wire import Kind
from tests.fleet_service.analytics.agreement import roads_along

WORLD = SyntheticFleet(rows=24_000, days=2, vehicles=40, roads=8, length=60, icy=4)
PART = Extract(START_NS, START_NS + WORLD.days * DAY_S * 10**9)
HOUR_NS = 3600 * 10**9


def find_visited(fusion: Fusion) -> IntArray:
    """Return the numbers (n,) of those rows of a `Fusion` (beliefs about all cells) that have
    visits. A row is a pair of cell and heading sector.
    """
    return np.flatnonzero(fusion.live.vehicles[: fusion.size] > 0)


@pytest.fixture(scope="session")
def archive(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return an archive with compacted (sorted) rows and a stored map (snapshot) every twelve
    hours.
    """
    root = tmp_path_factory.mktemp("analytics") / "archive"
    synthetic.write_archive(root, WORLD, 4000)
    compact(root)
    rollup.complete_parts(root)
    for hour in range(12, 48, 12):
        now = START_NS + hour * HOUR_NS
        fusion = Fusion(120.0)
        for _ in replay(root, fusion, Since(until=now)):
            pass
        snapshots.write_snapshot(root, cell_table(fusion, find_visited(fusion), now), now)
    return root


@pytest.fixture(scope="session")
def rows(archive: Path) -> pd.DataFrame:
    """Return all observations of the archive. Column `time` is in whole seconds. Column `value` is
    True if the vehicle measured the friction mu, that is, used at least 0.6 of it.
    """
    frame = (
        pa.concat_tables(reading.read_tables(archive, Kind.OBSERVATION))
        .drop_columns(["log_likelihood"])
        .to_pandas()
    )
    frame["time"] = frame["leave_time"].astype("datetime64[us, UTC]").astype("int64") // 10**6
    frame["value"] = frame["mu_utilised"].astype(float) >= 0.6 * frame["mu"].astype(float) - 1e-6
    frame["mu"] = frame["mu"].astype(float)
    return frame


@pytest.fixture(scope="session")
def stations(archive: Path) -> Path:
    """Return a file with hourly readings of two weather stations."""
    hours = np.arange(WORLD.days * 24)
    inland = 5.0 - 8.0 * synthetic.night_factor(np.asarray(hours * 3600.0, float))
    columns: dict[str, Any] = {
        "station": np.repeat(["inland", "coast"], len(hours)),
        "time": (np.tile(hours, 2) * 3600 + START_NS // 10**9).astype("datetime64[s]"),
        "latitude": np.repeat([57.70, 57.71], len(hours)),
        "longitude": np.repeat([11.99, 13.9], len(hours)),
        "temperature": np.concatenate([inland, np.full(len(hours), 40.0)]),
    }
    path = archive.parent / "stations.csv"
    pacsv.write_csv(pa.table(columns), path)
    return path


@pytest.fixture(scope="session")
def links(rows: pd.DataFrame, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return a file with the roads of the archive as links of forty cells, and one link that no
    vehicle visited.
    """
    path = tmp_path_factory.mktemp("roads") / "roads.parquet"
    pq.write_table(roads_along(rows["cell"].to_numpy()), path)
    return path


@pytest.fixture(scope="session")
def asked(archive: Path) -> Callable[..., pa.Table]:
    """Return a function that answers a question (predefined query) about the archive:
    `asked("grip", at=...)`.
    """

    def ask(name: str, engine: str = "duckdb", part: Extract = PART, **options: object) -> pa.Table:
        lines: list[str] = []
        found = QUESTIONS[name].ask(
            QueryEngine(engine, archive, part),
            Options(report=lines.append, **options),  # type: ignore[arg-type]
        )
        return found.replace_schema_metadata({"report": "\n".join(lines)})

    return ask
