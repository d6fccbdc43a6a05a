"""Benchmark of a service with a million cells: writing of a checkpoint (saved state) during ingest,
and restart from this checkpoint and the rows ingested after it.

The checkpoint is requested by a background thread, as in the service, while another thread
processes messages. The restart runs in a separate process, and its time is counted until the
service is ready. This includes imports, reading the checkpoint and the later rows, loading compiled
code, and opening the Zenoh session.
"""

from __future__ import annotations

import json
import sys
import tempfile
import threading
import time
from contextlib import closing
from pathlib import Path
from typing import Final

from deploy.router import open_router
from fleet_service.app.engine import Engine
from fleet_service.archive.format.layout import Cut
from fleet_service.ingest.dedup import SequenceTrackers
from fleet_service.ingest.inbox import Message
from fleet_service.replay import checkpoints
from fleet_service.replay.checkpoints import Taken
from fleet_service.replay.restart import image_of
from schemas.config import ServiceConfig
from schemas.runtime.figures import Figure
from tests.benchmarks.full_map import CELLS, START, fill_fusion
from tests.benchmarks.ingest import make_messages
from tests.faults.processes import Part

SPAN_S: Final = 86_400.0  # time span in which every cell is visited three times
TURN: Final = 100  # messages per pass; each has ten observations
SINCE: Final = 10_000  # messages after the last checkpoint; they contain 100 000 observations
RESTARTS: Final = 3
SECOND: Final = 10**9


def state() -> list[Figure]:
    """Measure, for a service with 10⁶ cells, the time to write a checkpoint (saved state) while
    messages are ingested, and the time of a restart from it.
    """
    now = START + int(SPAN_S) * SECOND
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        root = folder / "archive"
        fusion, _ = fill_fusion(CELLS, 3, SPAN_S)
        checkpoints.save_checkpoint(
            root, Taken(image_of(fusion, [], SequenceTrackers()), Cut(0, 0))
        )
        del fusion
        with closing(Engine(ServiceConfig(), root)) as engine:
            took, held = checkpoint_s(engine, make_messages(SINCE, 10, now), now)
            cells = engine.state.fusion.size
        restart = sorted(restart_s(folder, root) for _ in range(RESTARTS))[RESTARTS // 2]
    return [
        Figure("bench.state.snapshot_s", took, f"s, checkpoint of {cells / 1e6:.2f} 10^6 cells", 1),
        Figure("bench.state.snapshot_pause_ms", 1e3 * held, "ms, longest wait of ingest", 50),
        Figure(
            "bench.state.restart_s",
            restart,
            f"s, process to ready, {10 * SINCE} observations since",
            2,
        ),
    ]


def checkpoint_s(engine: Engine, sent: list[Message], now: int) -> tuple[float, float]:
    """Ingest all messages of `sent`, and request a checkpoint (saved state) meanwhile. Return two
    times [s]: from the request until the checkpoint is on disk, and the longest pass of the
    service's main loop (worker).

    Half of the messages are ingested only after the checkpoint is written.
    """
    parts = [sent[at : at + TURN] for at in range(0, len(sent), TURN)]
    turns: list[float] = []
    saved = threading.Event()

    def ingest_parts() -> None:
        for number, part in enumerate(parts):
            began = time.perf_counter()
            engine.intake.ingest(part, now)
            engine.settlement.flush()
            turns.append(time.perf_counter() - began)
            if number == len(parts) // 2:
                saved.wait()

    worker = threading.Thread(target=ingest_parts)
    for part in parts[:2]:  # warm up
        engine.intake.ingest(part, now)
    worker.start()
    began = time.perf_counter()
    assert engine.save_checkpoint(threading.Event())
    elapsed_s = time.perf_counter() - began
    busy = len(turns)
    saved.set()
    worker.join()
    return elapsed_s, max(turns[: busy + 1])


def restart_s(folder: Path, root: Path) -> float:
    """Return the time [s] from the start of the service's process until it reports that it is
    ready.
    """
    router, (endpoint, *_) = open_router(listen="tcp/127.0.0.1:0")
    with router:
        config = folder / "service.json"
        config.write_text(json.dumps({"zenoh": {"connect": [endpoint]}}))
        words = ("-m", "fleet_service.cli", "run", "--archive", str(root), "--config", str(config))
        service = Part("service", [sys.executable, *words], folder)
        began = time.perf_counter()
        service.start()
        service.line_with("ready: ")
        elapsed_s = time.perf_counter() - began
        service.kill()
    return elapsed_s
