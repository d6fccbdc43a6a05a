"""Benchmarks of two properties of a service: the time of queries about past maps over Zenoh, and
the difference between the map before and after a restart.
"""

from __future__ import annotations

import threading
import time
from collections.abc import Callable, Iterator
from contextlib import closing, contextmanager
from datetime import UTC, datetime
from pathlib import Path

import numpy as np
import pyarrow as pa
import zenoh

from deploy.router import open_router
from fleet_service.analytics import synthetic
from fleet_service.analytics.synthetic import DAY_S, START_NS, SyntheticFleet
from fleet_service.app.engine import Engine
from fleet_service.app.service import Service
from fleet_service.archive.maintenance.compaction import compact
from schemas import grid, keys
from schemas.config import ServiceConfig, ZenohSettings
from schemas.numeric import FloatArray, IntArray
from schemas.runtime.figures import Figure
from schemas.runtime.zenoh_session import open_session
from tests.event_lines import logger_into
from tests.waiting import until

WORLD = SyntheticFleet(1_000_000, days=3)
# [cells] side of the queried box. Vehicles visited about a thousand of its cells.
SIDE = 320
QUERIES = 15


def measure_past(root: Path, log_line: Callable[[str], None]) -> list[Figure]:
    """Measure the time [ms] of a query for a thousand cells of a past map (parameter `at`), and the
    largest difference between the probabilities of a cell before and after a restart. Return the
    figures.
    """
    synthetic.write_archive(root, WORLD)
    compact(root)
    # These rows are not compacted yet.
    synthetic.write_archive(root, SyntheticFleet(20_000, 1, seed=1))
    with closing(Engine(ServiceConfig(), root)) as engine:
        before = _read_beliefs(engine)
    with closing(Engine(ServiceConfig(), root)) as engine:
        after = _read_beliefs(engine)
    difference = _find_largest_change(before, after)
    log_line(f"restart: {len(before[0])} cells, {difference:.1e}")
    spent, cells = _time_queries(root)
    log_line(f"at=: {np.round(np.array(spent) * 1e3)} ms, {cells} cells")
    return [
        Figure("archive.at_query_p50_ms", float(np.median(spent)) * 1e3, f"ms, {cells} cells", 500),
        Figure("archive.restart_difference", difference, "probability", 1e-6),
    ]


def _read_beliefs(engine: Engine) -> tuple[IntArray, FloatArray]:
    fusion = engine.state.fusion
    slots = np.arange(fusion.size)
    order = np.lexsort((fusion.sector[slots], fusion.cell[slots]))
    return (fusion.cell[slots] * grid.SECTORS + fusion.sector[slots])[order], fusion.beliefs(
        slots, END
    )[order]


END = START_NS + WORLD.days * DAY_S * 10**9


def _find_largest_change(
    before: tuple[IntArray, FloatArray], after: tuple[IntArray, FloatArray]
) -> float:
    if len(before[0]) != len(after[0]) or (before[0] != after[0]).any():
        return 1.0
    return float(np.abs(before[1] - after[1]).max())


@contextmanager
def _open_service(root: Path) -> Iterator[zenoh.Session]:
    """Start a service on the archive `root`, and yield the Zenoh session of a client of this
    service.
    """
    router, endpoints = open_router(listen="tcp/127.0.0.1:0")
    settings = ZenohSettings(connect=endpoints)
    lines: list[str] = []
    stop = threading.Event()
    with router:
        service = Service(
            ServiceConfig(zenoh=settings, compact_s=0.0, snapshot_s=0.0), root, logger_into(lines)
        )
        thread = threading.Thread(target=service.run, args=(stop,))
        thread.start()
        try:
            until(lambda: any(line.startswith("ready") for line in lines), 300.0)
            session = open_session(settings)
            assert session is not None
            with session:
                yield session
        finally:
            stop.set()
            thread.join()


def _time_answer(session: zenoh.Session, selector: str) -> tuple[float, list[pa.Table]]:
    """Send the map query `selector`. Return the time [s] until its answer, and the tiles in the
    answer. If the service refuses the query because it computes other past maps, send the query
    again.
    """
    while True:
        began = time.perf_counter()
        replies = list(session.get(selector, timeout=120.0))
        seconds = time.perf_counter() - began
        refused = [reply.err.payload.to_string() for reply in replies if reply.err]
        if not refused:
            payloads = [reply.ok.payload.to_bytes() for reply in replies if reply.ok]
            return seconds, [pa.ipc.open_stream(payload).read_all() for payload in payloads]
        if "too many past maps" not in refused[0]:
            raise RuntimeError(refused[0])


def _time_queries(root: Path) -> tuple[list[float], int]:
    """Send QUERIES queries for a past map. Return the time [s] until the answer to each one, and
    the number of cells in all answers.
    """
    rng = np.random.default_rng(0)
    step = 360.0 / (1 << grid.CELL_ZOOM)
    spent = []
    cells = 0
    with _open_service(root) as session:
        for _ in range(QUERIES):
            row = int(rng.integers(0, 8)) * 2
            column = int(rng.integers(0, 8))
            west = synthetic.LONGITUDE + column * 260 * step
            south = synthetic.LATITUDE + row * 260 * step * np.cos(np.radians(synthetic.LATITUDE))
            box = (
                west,
                south,
                west + SIDE * step,
                south + SIDE * step * np.cos(np.radians(synthetic.LATITUDE)),
            )
            at = datetime.fromtimestamp(
                START_NS // 10**9 + int(rng.integers(DAY_S, WORLD.days * DAY_S)), UTC
            )
            bbox = ",".join(f"{v:.6f}" for v in box)
            selector = f"{keys.ROOT}/map/**?bbox={bbox};at={at:%Y-%m-%dT%H:%M:%SZ}"
            seconds, tables = _time_answer(session, selector)
            spent.append(seconds)
            cells += sum(table.num_rows for table in tables)
    return spent, cells // QUERIES
