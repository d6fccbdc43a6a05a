"""`make analytics-bench`: benchmark of the archive and of analytic queries on ten million synthetic
observations; `--rows` sets a smaller number.

Writes `.analytics/figures.json` and prints the table. Durations are wall times on two threads,
medians of ROUNDS. The figure of the compaction (sorting of rows into files by cell) counts rows per
CPU second.
"""

from __future__ import annotations

import argparse
import shutil
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from functools import partial
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import geoparquet_validator
import numpy as np
import pyarrow as pa
import pyarrow.csv as pacsv
import pyarrow.parquet as pq

from fleet_service.analytics import output, synthetic
from fleet_service.analytics.engines import QueryEngine
from fleet_service.analytics.options import Options
from fleet_service.analytics.questions import QUESTIONS
from fleet_service.analytics.synthetic import DAY_S, START_NS, SyntheticFleet
from fleet_service.archive.export.extract import Extract
from fleet_service.archive.format import reading, segments, snapshots
from fleet_service.archive.maintenance import rollup
from fleet_service.archive.maintenance.compaction import compact
from fleet_service.fusion import Fusion
from fleet_service.replay.rebuild import Since, replay
from fleet_service.serve.encode import cell_table
from schemas.runtime import figures
from schemas.runtime.figures import Figure
from schemas.wire import Kind
from tests.benchmarks.contract import size_of
from tests.benchmarks.past import measure_past
from tests.fleet_service.analytics.agreement import differs, roads_along
from tests.fleet_service.archive.readers import READERS, by_spark

FOLDER = Path(".analytics")
ROWS = 10_000_000
DAYS = 7
ROUNDS = 3
SEED = 0
TIMED = ("grip", "worst", "vehicles", "weather")
CELLS_ASKED = 30
SMALL = SyntheticFleet(rows=24_000, days=2, vehicles=40, roads=8, length=60, icy=4)
PART = Extract(START_NS, START_NS + DAYS * DAY_S * 10**9)
HALF = START_NS + DAY_S * 10**9


def print_progress(line: str) -> None:
    """Print a line about the progress of the benchmark."""
    print(f"  {line}", flush=True)


def median_s(work: Callable[[], object], rounds: int = ROUNDS) -> float:
    """Return the median duration [s] of `rounds` calls of the function `work`."""
    spent = []
    for _ in range(rounds):
        began = time.perf_counter()
        work()
        spent.append(time.perf_counter() - began)
    return float(np.median(spent))


def write_stations(folder: Path) -> Path:
    """Write a file with made-up hourly readings of five weather stations, and return its path."""
    hours = np.arange(DAYS * 24)
    names = np.repeat([f"station-{k}" for k in range(5)], len(hours))
    place = np.repeat(np.arange(5), len(hours))
    columns: dict[str, Any] = {
        "station": names,
        "time": (np.tile(hours, 5) * 3600 + START_NS // 10**9).astype("datetime64[s]"),
        "latitude": 57.6 + 0.1 * place,
        "longitude": 11.9 + 0.1 * place,
        "temperature": np.tile(
            5.0 - 8.0 * synthetic.night_factor(np.asarray(hours * 3600.0, float)), 5
        )
        + 0.1 * place,
    }
    path = folder / "stations.csv"
    pacsv.write_csv(pa.table(columns), path)
    return path


def measure_archive(root: Path, rows: int) -> list[Figure]:
    """Measure rows per second of compaction (sorting of new rows into files by cell), and bytes per
    observation in the resulting archive.
    """
    print_progress(f"writing {rows:,} observations")
    synthetic.write_archive(root, SyntheticFleet(rows, DAYS))
    inbox = size_of(segments.list_segments(root, Kind.OBSERVATION))
    began = time.process_time()
    done = compact(root)
    spent = time.process_time() - began
    print_progress(f"compacted into {done.files} files")
    size = size_of((root / "observations").rglob("*.parquet"))
    return [
        Figure(
            "archive.compaction_rows_per_s",
            done.rows / spent,
            "rows per CPU second",
            400_000,
            "more",
        ),
        Figure("archive.bytes_per_observation", size / done.rows, "bytes", 60),
        Figure("archive.bytes_per_observation.inbox", inbox / done.rows, "bytes"),
    ]


def _ask_question(name: str, root: Path, options: Options) -> pa.Table:
    """Answer the query called `name` about the archive `root`, with a new instance of the query
    engine.
    """
    return QUESTIONS[name].ask(QueryEngine("duckdb", root, PART), options)


def measure_questions(root: Path, readings: Path) -> list[Figure]:
    """Measure the time of four analytic queries on all rows [s], and of a query about the past of
    one cell [ms].
    """
    found = []
    for name in TIMED:
        options = Options(stations=readings, report=lambda _: None)
        began = time.process_time()
        spent = median_s(partial(_ask_question, name, root, options))
        busy = (time.process_time() - began) / ROUNDS
        print_progress(f"{name}: {spent:.2f} s, {busy:.2f} s of CPU")
        found += [
            Figure(f"analytics.{name}_s", spent, "s", 5),
            Figure(f"analytics.{name}_cpu_s", busy, "s of CPU"),
        ]
    t = QueryEngine("duckdb", root, PART).observations()
    cells = np.unique(
        next(reading.read_tables(root, Kind.OBSERVATION, ["cell"]))["cell"].to_numpy()
    )
    chosen = np.random.default_rng(SEED).choice(cells, CELLS_ASKED)
    columns = ("time", "vehicle", "mu", "mu_lower", "mu_upper", "mu_utilised")

    def query_history(cell: int) -> None:
        t.filter(t.cell == cell).select(*columns).order_by("time").to_pyarrow()

    spent = np.median([median_s(partial(query_history, int(cell)), 1) for cell in chosen])
    return [*found, Figure("analytics.one_cell_ms", float(spent) * 1e3, "ms", 50)]


def write_small_archive(root: Path) -> dict[int, pa.Table]:
    """Write a small archive that contains three stored maps (snapshots). Return these maps by their
    time [ns].
    """
    synthetic.write_archive(root, SMALL, 4000)
    compact(root)
    rollup.complete_parts(root)
    maps = {}
    for hour in (12, 24, 36):
        now = START_NS + hour * 3600 * 10**9
        fusion = Fusion(120.0)
        for _ in replay(root, fusion, Since(until=now)):
            pass
        slots = np.flatnonzero(fusion.live.vehicles[: fusion.size] > 0)
        maps[now] = cell_table(fusion, slots, now)
        snapshots.write_snapshot(root, maps[now], now)
    return maps


def measure_agreement(root: Path, readings: Path) -> list[Figure]:
    """Test that other programs can read the archive. Return three counts as figures: files that a
    validator refuses, programs that cannot read the archive, and queries to which the query engines
    DuckDB and Spark give different answers.
    """
    invalid = sum(bool(_find_refusals(path)) for path in _geo_files(root))
    expected = sum(table.num_rows for table in reading.read_tables(root, Kind.OBSERVATION, ["seq"]))
    readers = READERS | ({"spark": by_spark} if find_spec("pyspark") else {})
    failed = sum(not _can_read(reader, root, expected) for reader in readers.values())
    print_progress(f"readers: {', '.join(readers)}")
    different = _count_differences(root, readings) if find_spec("pyspark") else float("nan")
    return [
        Figure("archive.geoparquet_invalid", invalid, "files", 0),
        Figure("archive.readers_failed", failed, f"of {len(readers)} tools", 0),
        Figure("analytics.engines_differ", different, f"of {len(QUESTIONS) - 1} questions", 0),
    ]


def _geo_files(root: Path) -> Iterator[Path]:
    yield from (root / "map").rglob("*.parquet")
    for name in ("worst", "spells", "grip"):
        path = root.parent / f"{name}.geo.parquet"
        answer = QUESTIONS[name].ask(
            QueryEngine("duckdb", root, PART), Options(report=lambda _: None)
        )
        output.write_file(answer, QUESTIONS[name], path)
        yield path


def _find_refusals(path: Path) -> list[str]:
    report = geoparquet_validator.check(str(path))
    return [
        *geoparquet_validator.failed(report, "core"),
        *geoparquet_validator.failed(report, "covering"),
    ]


def _can_read(reader: Callable[[Path], tuple[float, ...]], root: Path, expected: int) -> bool:
    try:
        return reader(root)[0] == expected
    except Exception as error:  # noqa: BLE001 a foreign tool may raise anything
        print_progress(f"{reader.__name__}: {error}")
        return False


def _count_differences(root: Path, readings: Path) -> int:
    count = 0
    roads = root.parent / "roads.parquet"
    pq.write_table(
        roads_along(next(reading.read_tables(root, Kind.OBSERVATION, ["cell"]))["cell"].to_numpy()),
        roads,
    )
    for question in QUESTIONS.values():
        if question.name == "replay":  # this question uses no query engine
            continue
        options = Options(
            at=HALF,
            stations=readings,
            report=lambda _: None,
            roads=roads,
            level=0.35,
            within_s=3600.0,
        )
        one, other = (
            question.ask(QueryEngine(name, root, PART), options) for name in ("duckdb", "spark")
        )
        difference = differs(one, other, question)
        print_progress(f"{question.name}: {difference or 'the engines agree'}")
        count += difference is not None
    return count


@contextmanager
def open_folder() -> Iterator[Path]:
    """Yield an empty folder for the archives of the benchmark, which is removed afterwards."""
    FOLDER.mkdir(exist_ok=True)
    work = FOLDER / "work"
    shutil.rmtree(work, ignore_errors=True)
    work.mkdir()
    try:
        yield work
    finally:
        shutil.rmtree(work, ignore_errors=True)


def main() -> int:
    """Measure the time and the size of archive operations, and the time and the agreement of
    analytic queries; write and print the figures. Return 1 if a figure misses its target, otherwise
    0.
    """
    parser = argparse.ArgumentParser(
        prog="make analytics-bench", description=(__doc__ or "").splitlines()[0]
    )
    parser.add_argument("--rows", type=int, default=ROWS, help="observations (default ten million)")
    rows = parser.parse_args().rows
    with open_folder() as work:
        readings = write_stations(work)
        found = measure_archive(work / "large", rows)
        found += measure_questions(work / "large", readings)
        write_small_archive(work / "small")
        found += measure_agreement(work / "small", readings)
        found += measure_past(work / "past", print_progress)
    figures.write_figures(FOLDER / "figures.json", "analytics", [SEED], found)
    print(f"\n{figures.format_table(found)}\n\n{FOLDER}/figures.json")
    return 0 if all(figure.holds for figure in found if figure.bar is not None) else 1


if __name__ == "__main__":
    sys.exit(main())
