"""Benchmark of two services with one region each, compared with one service with both regions: time
from a burst of messages to its last acknowledgement.

The time is measured in two ways. In the first, engines (services without network) run in separate
processes on messages in memory. In the second, whole services run over Zenoh; router and sender
then use the same cores, unlike in a real fleet.
"""

from __future__ import annotations

import gc
import pickle
import statistics
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Sequence
from contextlib import ExitStack, closing
from pathlib import Path
from typing import Final

import zenoh

from deploy.router import open_router
from fleet_service.app.engine import Engine
from fleet_service.ingest.inbox import Message
from schemas import keys, wire
from schemas.config import ServiceConfig, ZenohSettings
from schemas.runtime.figures import Figure
from schemas.runtime.zenoh_session import open_session
from tests.benchmarks.ingest import make_messages
from tests.faults.processes import Part
from tests.waiting import matched

ROWS: Final = 10
BURST: Final = 4_000  # messages sent to each region
TURN: Final = 512  # messages that an engine processes per pass
VEHICLES: Final = 100  # vehicles in each region
ROUNDS: Final = 3
PATIENCE_S: Final = 120.0


def shards() -> list[Figure]:
    """Measure how long one service takes to ingest a burst of messages from two regions, and how
    long two services take if each serves one of the regions. Both are measured with engines
    (services without network) and over Zenoh. Return the two ratios as figures (named numbers).
    """
    sent = [_make_burst(k) for k in range(ROUNDS + 1)]
    alone = [statistics.median(engines_s(sent, split)) for split in (1, 2)]
    whole = [statistics.median(services_s(sent, split)) for split in (1, 2)]
    rates = [2 * BURST * ROWS / seconds for seconds in (alone[0], whole[0])]
    unit = (
        f"times one, which took {rates[1]:.0f} observations/s; router and sender on the same cores"
    )
    return [
        Figure(
            "bench.shards.speedup",
            alone[0] / alone[1],
            f"times one engine, {rates[0]:.0f}/s",
            1.6,
            "more",
        ),
        Figure("bench.shards.over_zenoh", whole[0] / whole[1], unit),
    ]


def engines_s(bursts: Sequence[Sequence[Message]], processes: int) -> list[float]:
    """Let engines (services without network) in `processes` processes ingest bursts of messages.
    Return, for every burst except the first, the time [s] from the start signal to its last
    acknowledgement.
    """
    with ExitStack() as stack:
        folder = Path(stack.enter_context(tempfile.TemporaryDirectory()))
        running = []
        for number in range(processes):
            root = folder / str(number)
            root.mkdir()
            shares = [[tuple(message) for message in burst[number::processes]] for burst in bursts]
            (root / "sent").write_bytes(pickle.dumps(shares))
            command = [
                sys.executable,
                "-c",
                f"from tests.benchmarks.shards import engine; engine({str(root)!r})",
            ]
            running.append(
                stack.enter_context(
                    subprocess.Popen(
                        command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True
                    )
                )
            )
        return [_time_round(running) for _ in range(len(bursts) + 1)][2:]


def _time_round(running: Sequence[subprocess.Popen[str]]) -> float:
    """Let all processes in `running` ingest one burst of messages at the same time, and return the
    time [s] until all have finished. The caller ignores the time of the first burst, which is a
    warm-up.
    """
    began = time.perf_counter()
    for process in running:
        assert process.stdin is not None
        print("go", file=process.stdin, flush=True)
    for process in running:
        assert process.stdout is not None
        assert process.stdout.readline() == "done\n"
    return time.perf_counter() - began


def engine(root: str) -> None:
    """Run an engine (service without network) that ingests one burst of stored messages for each
    line of standard input, and prints "done" after it.
    """
    bursts = [
        [Message(*fields) for fields in burst]
        for burst in pickle.loads((Path(root) / "sent").read_bytes())
    ]
    with closing(Engine(ServiceConfig(), Path(root) / "archive")) as opened:
        gc.freeze()
        for burst in ([], *bursts):
            sys.stdin.readline()
            for at in range(0, len(burst), TURN):
                opened.intake.ingest(burst[at : at + TURN], time.time_ns())
            opened.settlement.flush()
            print("done", flush=True)
        assert opened.counts.observations == sum(map(len, bursts)) * ROWS, opened.counts


def _make_burst(number: int) -> list[Message]:
    """Return 2 * BURST messages that are sent without pauses. Messages from the western and from
    the eastern region alternate; the first message is from the west.
    """
    now = time.time_ns()
    west, east = (
        make_messages(BURST, ROWS, now, VEHICLES, number * BURST, side) for side in (0, 1)
    )
    return [message for pair in zip(west, east, strict=True) for message in pair]


def list_regions(burst: Sequence[Message]) -> list[str]:
    """Return the western and the eastern region of a burst, as they appear in Zenoh keys. A burst
    alternates between messages from both regions, so the first two messages are enough.
    """
    return ["/".join(message.key.split("/")[3:6]) for message in burst[:2]]


def services_s(bursts: Sequence[Sequence[Message]], services: int) -> list[float]:
    """Send bursts of messages to `services` services over Zenoh. Return, for every burst except the
    first, the time [s] from its first message to its last acknowledgement.
    """
    with ExitStack() as stack:
        folder = Path(stack.enter_context(tempfile.TemporaryDirectory()))
        router, (endpoint, *_) = open_router(listen="tcp/127.0.0.1:0")
        stack.enter_context(router)
        parts = [
            _start_part(folder, endpoint, number, list_regions(bursts[0])[number::services])
            for number in range(services)
        ]
        for part in parts:
            stack.callback(part.kill)
            part.start()
        for part in parts:
            part.line_with("ready: ")
        session = open_session(ZenohSettings(connect=[endpoint]))
        assert session is not None
        stack.enter_context(session)
        return [_send_burst(session, burst) for burst in bursts][1:]


def _start_part(folder: Path, endpoint: str, number: int, share: list[str]) -> Part:
    name = f"shard-{number}"
    config = ServiceConfig(
        name=name, regions=share, queue_batches=4 * BURST, zenoh=ZenohSettings(connect=[endpoint])
    )
    path = folder / f"{name}.json"
    path.write_text(config.model_dump_json(include={"name", "regions", "queue_batches", "zenoh"}))
    words = (
        "-m",
        "fleet_service.cli",
        "run",
        "--archive",
        str(folder / name),
        "--config",
        str(path),
    )
    return Part(name, [sys.executable, *words], folder)


def _send_burst(session: zenoh.Session, burst: Sequence[Message]) -> float:
    settled = 0
    done = threading.Event()

    def count_settled(sample: zenoh.Sample) -> None:
        nonlocal settled
        _, streams = wire.decode_ack(sample.payload.to_bytes())
        settled += sum(last - first + 1 for stream in streams for first, last in stream.durable)
        if settled >= len(burst):
            done.set()

    subscriber = session.declare_subscriber(f"{keys.ROOT}/ack/*", count_settled)
    for key in {message.key for message in burst}:
        publisher = session.declare_publisher(key)
        matched(publisher)
        publisher.undeclare()
    began = time.perf_counter()
    for message in burst:
        session.put(
            message.key, message.payload, encoding=message.encoding, congestion_control=_BLOCK
        )
    if not done.wait(PATIENCE_S):
        raise TimeoutError(f"{len(burst) - settled} batches were not acknowledged")
    elapsed_s = time.perf_counter() - began
    subscriber.undeclare()
    return elapsed_s


_BLOCK: Final = zenoh.CongestionControl.BLOCK
