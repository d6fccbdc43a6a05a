"""Benchmark of Spark: recorded drives and map zones (squares of zoom 7) are processed by Spark and
in this process, and the results are compared. `make batch-bench` counts the differences.
"""

from __future__ import annotations

import statistics
import time
from collections.abc import Sequence
from functools import partial
from pathlib import Path
from typing import Final

from edge_agent.app.backfill import (
    Task,
    backfill_on_spark,
    estimate_atomically,
    estimate_drives,
    tasks_of,
)
from edge_agent.cli import main as edge_agent
from fleet_service.analytics.rebuilding import Rebuild, rebuild, rebuild_zone, zones_of
from fleet_service.analytics.synthetic import SyntheticFleet
from schemas.runtime import spark
from tests import spark_sessions
from tests.fleet_service.analytics.border import UNTIL, difference, fill, rebuilt_map

SEEDS: Final = (101, 102, 103, 104)
WORLD: Final = SyntheticFleet(rows=40_000, days=1, vehicles=60, roads=8, length=60, icy=4, seed=101)
ESTIMATOR: Final = "aco-fckf"
DRIVE_S: Final = 120.0
# Copies of each drive. They give ten seconds of work on one core, so that Spark's overhead of some
# tenths of a second matters little.
COPIES: Final = 6
ROUNDS: Final = 3


def simulate_drives(folder: Path) -> list[Path]:
    """Simulate one drive per seed, and return the paths of the signal logs; vehicle files lie next
    to them.
    """
    folder.mkdir()
    for seed in SEEDS:
        files = [
            "--out",
            str(folder / f"d{seed}.parquet"),
            "--vehicle-out",
            str(folder / f"d{seed}.json"),
        ]
        if (
            edge_agent(
                ["simulate", "slalom", "--duration", str(DRIVE_S), "--seed", str(seed), *files]
            )
            != 0
        ):
            raise RuntimeError("no drive was simulated")
    return sorted(folder.glob("*.parquet"))


def replay_difference(logs: Sequence[Path], folder: Path) -> float:
    """Estimate the recorded drives `logs` on Spark, where each task is killed once and repeated,
    and in this process. Return the number of estimate files that differ.
    """
    local_folder = folder / "here"
    spark_folder = folder / "there"
    tries = folder / "tries"
    spark_folder.mkdir(parents=True)
    work = partial(estimate_atomically, estimator=ESTIMATOR, memberships=None)
    with spark_sessions.spark_session(2) as session:
        dying = spark_sessions.killed_at_first(work, lambda task: task.log.name, tries)
        outcomes = spark.run_tasks(session, tasks_of(logs, None, spark_folder), dying)
    ours = list(estimate_drives(tasks_of(logs, None, local_folder), ESTIMATOR, 1))
    if len(list(tries.iterdir())) != len(logs) or any(
        outcome.error for outcome in (*outcomes, *ours)
    ):
        raise RuntimeError("a drive was not estimated, or its task was not killed")
    names = {path.name for folder in (local_folder, spark_folder) for path in folder.iterdir()}
    return float(
        sum(
            _read_content(local_folder / name) != _read_content(spark_folder / name)
            for name in names
        )
    )


def rebuild_difference(folder: Path) -> float:
    """Rebuild a map from an archive on Spark, where each task is killed once and repeated, and in
    this process. Return the largest difference between both maps.
    """
    archive, local_folder, spark_folder, tries = (
        folder / name for name in ("archive", "here", "there", "tries")
    )
    fill(archive, WORLD)
    local_folder.mkdir()
    spark_folder.mkdir()
    zones = zones_of(archive)
    with spark_sessions.spark_session(2) as session:
        spark.run_tasks(
            session,
            zones,
            spark_sessions.killed_at_first(
                partial(rebuild_zone, Rebuild(archive, spark_folder, UNTIL)), str, tries
            ),
        )
    if sum(zone.cells for zone in rebuild(Rebuild(archive, local_folder, UNTIL))) == 0 or len(
        list(tries.iterdir())
    ) != len(zones):
        raise RuntimeError("no cell was rebuilt, or a task was not killed")
    return difference(rebuilt_map(local_folder), rebuilt_map(spark_folder))


def replay_scaling(logs: Sequence[Path], folder: Path) -> float:
    """Return the speed-up by a second core: drives per second on Spark with two local cores,
    divided by those with one core. It is the median of alternating rounds with warm workers.
    """
    tasks = [
        Task(log, log.with_suffix(".json"), folder / f"{log.stem}-{copy}.parquet")
        for copy in range(COPIES)
        for log in logs
    ]
    return statistics.median(
        _time_backfill(tasks, 1) / _time_backfill(tasks, 2) for _ in range(ROUNDS)
    )


def _time_backfill(tasks: Sequence[Task], cores: int) -> float:
    with spark_sessions.spark_session(cores):
        # In the first run each worker starts and loads the kernels; only the second counts.
        for _ in range(2):
            began = time.perf_counter()
            outcomes = list(backfill_on_spark(tasks, ESTIMATOR))
            spent = time.perf_counter() - began
    if any(outcome.error for outcome in outcomes):
        raise RuntimeError("a drive was not estimated")
    return spent


def _read_content(path: Path) -> bytes | None:
    return path.read_bytes() if path.exists() else None
