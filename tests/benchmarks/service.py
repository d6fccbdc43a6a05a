"""Benchmark of a running service under load: queries compared with a bare Zenoh queryable (program
that only answers queries), and the time of alerts from publication to a subscriber.

Router, service, load, bare queryable and client run in separate processes.
"""

from __future__ import annotations

import statistics
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass
from pathlib import Path
from queue import SimpleQueue

import numpy as np
import zenoh

from deploy.router import open_router
from fleet_service.fusion.constants import NEIGHBOURS
from schemas import grid, keys, mugrid, wire
from schemas.config import ZenohSettings
from schemas.runtime.figures import Figure
from schemas.runtime.zenoh_session import open_session
from schemas.wire import Batch, Kind
from schemas.wire.tile import decode_tile

RATE = 20_000  # observations/s of the load
ROWS = 10  # observations in a message
VEHICLES = 500
# Columns and lines of cells that the load visits in the tile. A query's box contains half of them.
COLUMNS = 40
LINES = 50
QUERIES = 200
ALERTS = 60
ACKS = 60
IDLE_ACKS = 25
# Distance of neighbouring icy cells, in cells. A slippery stretch of road reaches NEIGHBOURS cells,
# so vehicles in two of these cells are not witnesses of the same ice.
APART = NEIGHBOURS + 2
IN_A_LINE = 10  # number of icy cells in a line, so that all of them lie in the tile
BARE = "gripmap-bare/tile"
BARE_BOX = "gripmap-bare/box"
LATITUDE = 57.7
LONGITUDE = 11.97
SECOND = 10**9
_TILE = int(grid.tile_of(grid.cell_of(LATITUDE, LONGITUDE)))
_X, _Y = (
    int(v)
    for v in grid.deinterleave(grid.from_quadkey(grid.quadkey(_TILE, grid.TILE_ZOOM) + "0" * 7))
)


def make_batch(vehicle: str, seq: int, column: np.ndarray, row: np.ndarray, ice: bool) -> Batch:
    """Return a batch (message) of visits (passes through map cells) that end now, in cells of the
    test tile at the given columns and rows. They report ice if `ice` is True, otherwise only how
    much friction the tyres used.
    """
    cell = grid.interleave(_X + column.astype(np.int64), _Y + row.astype(np.int64))
    latitude, longitude = grid.centre(cell)
    n = len(cell)
    now = time.time_ns()
    shape = (
        -0.5 * np.square((mugrid.CENTRES - 0.15) / 0.04)
        if ice
        else np.where(mugrid.CENTRES < 0.2, -6.0, 0.0)
    )
    columns = {
        "enter_time": np.full(n, now - SECOND),
        "leave_time": np.full(n, now),
        "cell": cell,
        "sector": np.zeros(n, np.int8),
        "latitude": latitude,
        "longitude": longitude,
        "position_std": np.ones(n, np.float32),
        "yaw": np.zeros(n, np.float32),
        "speed": np.full(n, 12.0, np.float32),
        "mu_utilised": np.full(n, 0.15 if ice else 0.2, np.float32),
        "log_likelihood": np.tile(mugrid.encode_log_likelihood(shape), (n, 1)),
    }
    return Batch(
        Kind.OBSERVATION,
        vehicle,
        1 + sum(vehicle.encode()),
        int(grid.region_of(cell[0])),
        seq,
        seq,
        columns,
    )


def put_batch(session: zenoh.Session, one: Batch) -> None:
    """Publish a batch of observations on the Zenoh key of its vehicle."""
    session.put(
        keys.observation_key(one.region, one.vehicle),
        wire.encode(one),
        encoding=wire.ENCODING[one.kind],
    )


def load(endpoint: str) -> None:
    """Send RATE observations per second to the service until this process is ended. Every
    observation reports a small used friction and no ice.
    """
    rng = np.random.default_rng(0)
    seq = 0
    began = time.monotonic()
    sent = 0
    session = open_session(ZenohSettings(connect=[endpoint]))
    assert session is not None
    while True:
        seq += 1
        for vehicle in range(VEHICLES):
            at = rng.integers(0, COLUMNS, ROWS), rng.integers(0, LINES, ROWS)
            put_batch(session, make_batch(f"load-{vehicle:04d}", seq, *at, False))
            sent += ROWS
            time.sleep(max(began + sent / RATE - time.monotonic(), 0.0))


def bare(endpoint: str, folder: str) -> None:
    """Run a bare Zenoh queryable (program that only answers queries), for comparison: answer every
    query with the bytes of one of two files in `folder`, until this process is ended.
    """
    session = open_session(ZenohSettings(connect=[endpoint]))
    assert session is not None

    def make_replier(key: str) -> Callable[[zenoh.Query], None]:
        data = (Path(folder) / Path(key).name).read_bytes()

        def reply(asked: zenoh.Query) -> None:
            with asked:
                asked.reply(key, data)

        return reply

    for key in (BARE, BARE_BOX):
        session.declare_queryable(key, make_replier(key), complete=True)
    sys.stdin.read()


@contextmanager
def run_process(*words: str) -> Iterator[None]:
    """Run a command in a process for the duration of the `with` block."""
    running = subprocess.Popen(
        [sys.executable, *words], stdin=subprocess.PIPE, stdout=subprocess.DEVNULL
    )
    try:
        yield
    finally:
        running.terminate()
        running.wait()


def fetch_reply(session: zenoh.Session, selector: str) -> bytes:
    """Send a map query, and return the bytes of its only reply, or empty bytes if no reply
    arrives.
    """
    return b"".join(reply.ok.payload.to_bytes() for reply in session.get(selector) if reply.ok)


def poll_until(something: Callable[[], object]) -> None:
    """Call the function `something` repeatedly until its result is not empty. Raise TimeoutError
    after two minutes.
    """
    deadline = time.monotonic() + 120.0
    while not something():
        if time.monotonic() > deadline:
            raise TimeoutError("the service does not answer")
        time.sleep(0.05)


def durations_ms(*works: Callable[[], object]) -> list[list[float]]:
    """Call the given functions one after the other in each of QUERIES rounds; return, for each
    function, its durations [ms].
    """
    out: list[list[float]] = [[] for _ in works]
    for _ in range(QUERIES):
        for work, times in zip(works, out, strict=True):
            began = time.perf_counter()
            work()
            times.append(1e3 * (time.perf_counter() - began))
    return out


def alert_delays_ms(session: zenoh.Session) -> list[float]:
    """Let two vehicles report ice in each of ALERTS cells, which are far from each other. Return,
    for each cell, the time [ms] from the second vehicle's publication until a subscriber receives
    the alert.

    Alerts of neighbouring cells, and alerts that are published again, do not count.
    """
    received: SimpleQueue[tuple[int, float]] = SimpleQueue()

    def record_alert(sample: zenoh.Sample) -> None:
        now = time.perf_counter()
        received.put((wire.decode_alert(sample.payload.to_bytes()).cell, now))

    session.declare_subscriber(f"{keys.ROOT}/alert/**", record_alert)
    out = []
    for k in range(ALERTS):
        line, place = divmod(k, IN_A_LINE)
        at = np.array([60 + APART * place]), np.array([1 + APART * line])
        put_batch(session, make_batch(f"ice-{k}-first", 1, *at, True))
        time.sleep(0.05)
        second = make_batch(f"ice-{k}-second", 1, *at, True)
        cell = int(second.columns["cell"][0])
        began = time.perf_counter()
        put_batch(session, second)
        when = next(
            when for found, when in iter(lambda: received.get(timeout=30.0), None) if found == cell
        )
        assert when > began, "an alert before there was a second vehicle"
        out.append(1e3 * (when - began))
    return out


def ack_delays_s(
    session: zenoh.Session, vehicle: str, apart_s: tuple[float, float], count: int
) -> list[float]:
    """Return the times [s] from a vehicle's publication to its acknowledgement, for `count` batches
    sent at random times; the time between two batches lies between the two limits `apart_s` [s].

    Raises:
        TimeoutError: a batch was not acknowledged.
    """
    received: SimpleQueue[tuple[int, float]] = SimpleQueue()

    def record_ack(sample: zenoh.Sample) -> None:
        now = time.perf_counter()
        for stream in wire.decode_ack(sample.payload.to_bytes())[1]:
            for first, last in stream.durable:
                for seq in range(first, last + 1):
                    received.put((seq, now))

    session.declare_subscriber(keys.ack_key(vehicle), record_ack)
    rng = np.random.default_rng(0)
    sent = {}
    for seq in range(1, count + 1):
        sent[seq] = time.perf_counter()
        put_batch(
            session,
            make_batch(vehicle, seq, rng.integers(0, COLUMNS, 1), rng.integers(0, LINES, 1), False),
        )
        time.sleep(rng.uniform(*apart_s))
    out = []
    for _ in sent:
        seq, when = received.get(timeout=30.0)
        out.append(when - sent[seq])
    return out


@dataclass
class ServiceTimes:
    """Measured times of a service: queries of a tile and of a box, and the same bytes from a bare
    queryable [ms]; alerts [ms]; acknowledgements under load and without other load [s]. `cells` are
    the numbers of cells in the tile and in the box.
    """

    tile_ms: list[float]
    box_ms: list[float]
    bare_tile_ms: list[float]
    bare_box_ms: list[float]
    cells: list[int]
    alerts_ms: list[float]
    acks_s: list[float]
    idle_acks_s: list[float]


def service() -> list[Figure]:
    """Measure the times of queries, alerts and acknowledgements of a service that receives 20 000
    observations/s. Compare the queries with those of a bare Zenoh queryable (program that only
    answers queries). Return the figures.
    """
    with ExitStack() as stack:
        folder = Path(stack.enter_context(tempfile.TemporaryDirectory()))
        router, (endpoint, *_) = open_router(listen="tcp/127.0.0.1:0")
        stack.enter_context(router)
        client = _start_service(stack, folder, endpoint)
        times = _measure_times(stack, folder, endpoint, client)
    tile, box = (statistics.median(bare) for bare in (times.bare_tile_ms, times.bare_box_ms))
    tile_note, box_note = (
        f"of {limit:.1f} ms, {number} cells"
        for limit, number in zip((tile, box), times.cells, strict=True)
    )
    queries = times.tile_ms + times.box_ms
    return [
        Figure("bench.query.tile_vs_bare", statistics.median(times.tile_ms) / tile, tile_note, 2),
        Figure("bench.query.bbox_vs_bare", statistics.median(times.box_ms) / box, box_note, 1.25),
        Figure(
            "bench.query.p99_ms",
            float(np.quantile(queries, 0.99)),
            "ms, under 20 000 observations/s",
            25,
        ),
        Figure(
            "bench.alert.p50_ms",
            statistics.median(times.alerts_ms),
            "ms, publish to subscriber, under load",
            50,
        ),
        Figure("bench.alert.p99_ms", float(np.quantile(times.alerts_ms, 0.99)), "ms", 15),
        Figure(
            "bench.ack.p50_s",
            statistics.median(times.acks_s),
            "s, publish to acknowledgement, under load",
            0.3,
        ),
        Figure(
            "bench.ack.idle_p50_s",
            statistics.median(times.idle_acks_s),
            "s, publish to acknowledgement, a single vehicle without other load",
            0.05,
        ),
        Figure("bench.ack.p99_s", float(np.quantile(times.acks_s, 0.99)), "s", 2.5),
    ]


def _start_service(stack: ExitStack, folder: Path, endpoint: str) -> zenoh.Session:
    """Start a service in a process, and wait until it answers with a first cell. Return the session
    of a client. `stack` ends both.
    """
    config = folder / "service.json"
    config.write_text(f'{{"zenoh": {{"connect": ["{endpoint}"]}}}}')
    command = ["-m", "fleet_service.cli", "run", "--archive", str(folder / "archive")]
    stack.enter_context(run_process(*command, "--config", str(config)))
    client = open_session(ZenohSettings(connect=[endpoint]))
    assert client is not None
    stack.enter_context(client)
    first = make_batch("first", 1, np.zeros(1, int), np.zeros(1, int), False)

    def serves_a_cell() -> bool:
        put_batch(client, first)
        return len(fetch_reply(client, f"{keys.ROOT}/map/**")) > 0

    poll_until(serves_a_cell)
    return client


def _measure_times(
    stack: ExitStack, folder: Path, endpoint: str, client: zenoh.Session
) -> ServiceTimes:
    idle = ack_delays_s(client, "acked-1", (0.5, 1.5), IDLE_ACKS)
    stack.enter_context(
        run_process("-c", f"from tests.benchmarks.service import load; load({endpoint!r})")
    )
    poll_until(lambda: len(fetch_reply(client, f"{keys.ROOT}/map/**")))
    time.sleep(10.0)  # wait until the window is full
    tile = keys.map_key(_TILE)
    selectors = (tile, f"{tile}?bbox={_queried_box()}")
    cells = []
    for key, selector in zip((BARE, BARE_BOX), selectors, strict=True):
        reply = fetch_reply(client, selector)
        cells.append(decode_tile(reply).num_rows)
        (folder / Path(key).name).write_bytes(reply)
    answer = f"from tests.benchmarks.service import bare; bare({endpoint!r}, {str(folder)!r})"
    stack.enter_context(run_process("-c", answer))
    poll_until(lambda: len(fetch_reply(client, BARE)))
    asked = (*selectors, BARE, BARE_BOX)
    tile_ms, box_ms, bare_tile_ms, bare_box_ms = durations_ms(
        *(lambda selector=selector: fetch_reply(client, selector) for selector in asked)
    )
    return ServiceTimes(
        tile_ms,
        box_ms,
        bare_tile_ms,
        bare_box_ms,
        cells,
        alerts_ms=alert_delays_ms(client),
        acks_s=ack_delays_s(client, "acked-0", (0.0, 0.3), ACKS),
        idle_acks_s=idle,
    )


def _queried_box() -> str:
    """Return west, south, east and north of the queried box [deg]. The box begins at the first cell
    and covers all columns and half of the lines. It is slightly smaller than these cells, because a
    box includes its borders.
    """
    west, south, east, north = (
        float(v[0]) for v in grid.bounds(grid.interleave(np.array([_X]), np.array([_Y])))
    )
    wide = COLUMNS * (east - west)
    high = LINES // 2 * (north - south)
    return f"{west + 1e-6},{north - high + 1e-6},{west + wide - 1e-6},{north - 1e-6}"
