"""Benchmark of sparse traffic over many map tiles: delay of acknowledgements, and age of a tile for
a client that queries all tiles.

Each of 8 000 vehicles reports a visit (pass through a cell) in a map tile of its own every 5.3 s.
Router, service, vehicles and readers run in separate processes.
"""

from __future__ import annotations

import json
import statistics
import subprocess
import sys
import tempfile
import threading
import time
from collections import Counter
from contextlib import ExitStack
from dataclasses import replace
from pathlib import Path
from typing import NamedTuple

import numpy as np
import zenoh

from deploy.router import open_router
from schemas import grid, keys, wire
from schemas.config import ZenohSettings
from schemas.proto import gripmap_pb2 as pb
from schemas.runtime.figures import Figure
from schemas.runtime.zenoh_session import open_session
from schemas.wire import Batch, Kind
from tests.benchmarks.service import (
    LATITUDE,
    LONGITUDE,
    SECOND,
    fetch_reply,
    poll_until,
    run_process,
)
from tests.fleet_service.examples import batch

RATE = 1500  # visits per second of all vehicles
TILES = 8000  # one vehicle in each
WARM_S = 8.0
MEASURED_S = 20.0
PATIENCE_S = 60.0
READERS = 2
QUESTIONS = 200
_ACROSS = 2 ** (grid.TILE_ZOOM - grid.REGION_ZOOM)  # tiles along a region's side


def make_visit(vehicle: int) -> Batch:
    """Return a batch with one observation of the vehicle number `vehicle`, in the middle of its own
    map tile.
    """
    first = grid.cell_of(LATITUDE, LONGITUDE, grid.REGION_ZOOM)
    x, y = (int(v) for v in grid.deinterleave(first))
    region, place = divmod(vehicle, _ACROSS**2)
    row, column = divmod(place, _ACROSS)
    tile = grid.interleave(
        np.array([(x + region) * _ACROSS + column]), np.array([y * _ACROSS + row])
    )
    latitude, longitude = grid.centre(tile, grid.TILE_ZOOM)
    cell = grid.cell_of(latitude, longitude)
    latitude, longitude = grid.centre(cell)
    one = batch(
        f"thin-{vehicle:04d}",
        1,
        time.time_ns(),
        [0.8],
        cell=cell,
        latitude=latitude,
        longitude=longitude,
    )
    return replace(one, region=int(grid.region_of(cell[0])))


class Acks:
    """Record of the time at which each batch was sent, and of the time from then until its
    acknowledgement.
    """

    def __init__(self, session: zenoh.Session) -> None:
        self.put: dict[tuple[str, int], float] = {}
        self.waits: dict[tuple[str, int], float] = {}
        self._subscriber = session.declare_subscriber(f"{keys.ROOT}/ack/*", self._record_ack)

    def _record_ack(self, sample: zenoh.Sample) -> None:
        now = time.perf_counter()
        (vehicle, streams) = wire.decode_ack(sample.payload.to_bytes())
        for stream in streams:
            for first, last in stream.durable:
                for seq in range(first, last + 1):
                    self.waits[vehicle, seq] = now - self.put[vehicle, seq]

    def waits_since(self, since: float) -> list[float]:
        """Return, for each batch that was sent at or after the time `since`, the time [s] until its
        acknowledgement. It is infinite for a batch without acknowledgement.
        """
        return [
            self.waits.get(name, float("inf")) for name, at in list(self.put.items()) if at >= since
        ]


def drive(endpoint: str) -> None:
    """Send observations of all vehicles for a fixed time, and wait for the remaining
    acknowledgements. Print how long each batch waited.
    """
    session = open_session(ZenohSettings(connect=[endpoint]))
    assert session is not None
    acks = Acks(session)
    encoding = wire.ENCODING[Kind.OBSERVATION]
    cars = []
    for vehicle in range(TILES):
        visit = make_visit(vehicle)
        message = pb.ObservationBatch.FromString(wire.encode(visit))
        cars.append((visit.vehicle, keys.observation_key(visit.region, visit.vehicle), message))
    began = time.perf_counter()
    sent = 0
    while time.perf_counter() - began < WARM_S + MEASURED_S:
        turn, vehicle = divmod(sent, TILES)
        name, place, message = cars[vehicle]
        now = time.time_ns()
        message.seq = turn + 1
        message.leave_time[0] = now
        message.enter_time[0] = now - SECOND
        acks.put[name, turn + 1] = time.perf_counter()
        session.put(
            place,
            message.SerializeToString(),
            encoding=encoding,
            congestion_control=zenoh.CongestionControl.BLOCK,
        )
        sent += 1
        time.sleep(max(began + sent / RATE - time.perf_counter(), 0.0))
    elapsed_s = time.perf_counter() - began
    since = began + WARM_S
    deadline = time.perf_counter() + PATIENCE_S
    while len(acks.waits) < sent and time.perf_counter() < deadline:
        time.sleep(0.05)
    waits = acks.waits_since(since)
    found = {
        "p50": statistics.median(waits),
        "p99": float(np.quantile(waits, 0.99)),
        "rate": sent / elapsed_s,
    }
    print(json.dumps({**found, "acknowledged": len(acks.waits) / sent}), flush=True)
    session.close()


def read(endpoint: str) -> None:
    """Query the whole map repeatedly until the process is ended, and print a line for each complete
    answer.
    """
    session = open_session(ZenohSettings(connect=[endpoint]))
    assert session is not None
    while True:
        replies = [reply for reply in session.get(f"{keys.ROOT}/map/**", timeout=60.0) if reply.ok]
        if replies:  # a new session may not know yet which services answer
            print(len(replies), flush=True)


def _time_answers(endpoint: str, client: zenoh.Session, tile: str) -> tuple[list[float], int]:
    """Query one map tile repeatedly while READERS readers query the whole map, until each reader
    has an answer. Return the time [ms] of each query of the tile. Return also the smallest number
    of tiles that a reader received.
    """
    words = [sys.executable, "-c", f"from tests.benchmarks.tiles import read; read({endpoint!r})"]
    readers = [subprocess.Popen(words, stdout=subprocess.PIPE, text=True) for _ in range(READERS)]
    got: list[list[int]] = [[] for _ in readers]
    threads = [
        threading.Thread(target=_collect_counts, args=pair)
        for pair in zip(readers, got, strict=True)
    ]
    for thread in threads:
        thread.start()
    waits: list[float] = []
    pause = threading.Event()
    deadline = time.monotonic() + 2 * PATIENCE_S
    try:
        while (len(waits) < QUESTIONS or not all(got)) and time.monotonic() < deadline:
            began = time.perf_counter()
            known = fetch_reply(client, tile)
            waits.append(1e3 * (time.perf_counter() - began) if known else float("inf"))
            pause.wait(0.02)
    finally:
        for reader in readers:
            reader.terminate()
            reader.wait()
        for thread in threads:
            thread.join()
    return waits, min(map(sum, got))


def _collect_counts(reader: subprocess.Popen[str], got: list[int]) -> None:
    got.extend(int(line) for line in reader.stdout or ())


class _Measured(NamedTuple):
    """Measurements of a service that updates 8 000 tiles.

    Attributes:
        sender: values by name that the sending process measured.
        puts: number of publications of each tile, by Zenoh key.
        small_s: times of a small query while other clients query the whole map [s].
        received: number of tiles that the slower of these clients received.
    """

    sender: dict[str, float]
    puts: Counter[str]
    small_s: list[float]
    received: int


def _drive_service() -> _Measured:
    """Run a service, send observations in 8 000 tiles to it, and query its map."""
    puts = Counter[str]()

    def count_put(sample: zenoh.Sample) -> None:
        puts[str(sample.key_expr)] += 1

    with ExitStack() as stack:
        folder = Path(stack.enter_context(tempfile.TemporaryDirectory()))
        router, (endpoint, *_) = open_router(listen="tcp/127.0.0.1:0")
        stack.enter_context(router)
        config = folder / "service.json"
        config.write_text(json.dumps({"zenoh": {"connect": [endpoint]}}))
        words = (
            "-m",
            "fleet_service.cli",
            "run",
            "--archive",
            str(folder / "archive"),
            "--config",
            str(config),
        )
        stack.enter_context(run_process(*words))
        client = open_session(ZenohSettings(connect=[endpoint]))
        assert client is not None
        stack.enter_context(client)
        poll_until(lambda: list(client.liveliness().get(f"{keys.ROOT}/shard/*")))
        client.declare_subscriber(f"{keys.ROOT}/map/**", count_put)
        command = [
            sys.executable,
            "-c",
            f"from tests.benchmarks.tiles import drive; drive({endpoint!r})",
        ]
        done = subprocess.run(command, stdout=subprocess.PIPE, check=True, text=True)
        sender = json.loads(done.stdout.splitlines()[-1])
        small, got = _time_answers(
            endpoint, client, keys.map_key(int(grid.tile_of(make_visit(0).columns["cell"][0])))
        )
    return _Measured(sender, puts, small, got)


def tiles() -> list[Figure]:
    """Send 1 500 observations/s in 8 000 tiles to a service, and measure three delays: that of the
    acknowledgements, the age of published tiles, and the time of a small query while other clients
    send large queries.
    """
    found, puts, small, got = _drive_service()
    return [
        Figure(
            "bench.tiles.ack_p99_s", found["p99"], "s, publish to acknowledgement, 8 000 tiles", 1
        ),
        Figure("bench.tiles.ack_p50_s", found["p50"], "s"),
        Figure(
            "bench.tiles.acknowledged", found["acknowledged"], "share of the batches", 1, "more"
        ),
        Figure("bench.tiles.rate", found["rate"], "visits/s offered", 0.95 * RATE, "more"),
        Figure(
            "bench.tiles.shown", float(len(puts)), "tiles that were published", 0.95 * TILES, "more"
        ),
        Figure(
            "bench.tiles.put_per_s",
            sum(puts.values()) / (WARM_S + MEASURED_S),
            "tiles/s that were put",
        ),
        Figure(
            "bench.query.small_behind_all_p99_ms",
            float(np.quantile(small, 0.99)),
            "ms, while two clients query the whole map",
            100,
        ),
        Figure(
            "bench.query.all_tiles",
            float(got),
            "tiles that the slower client received",
            0.9 * TILES,
            "more",
        ),
    ]
