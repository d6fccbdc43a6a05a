"""Campaign on expensive queries: two readers query the whole map as GeoJSON in a loop, and the
waiting time of a third reader that queries one tile is measured.

The service runs in a separate process, and its map is filled before the queries. The readers are
threads of other processes.
"""

from __future__ import annotations

import json
import subprocess
import sys
import threading
import time
from typing import Final

import numpy as np
import zenoh

from fleet_service.ingest.inbox import Message
from schemas import grid, keys, wire
from schemas.config import ZenohSettings
from schemas.runtime.figures import Figure
from schemas.runtime.zenoh_session import open_session
from schemas.wire import Batch, Kind
from tests.faults.bars import make_figure
from tests.faults.frame import Site
from tests.faults.processes import Stage, open_stage
from tests.fleet_service.examples import batch
from tests.waiting import until

PLACE: Final = (57.70, 11.97)
HEAVY: Final = 2


def run(site: Site) -> list[Figure]:
    """Let two readers query a map of twenty thousand cells for half a minute (in a quick run, five
    thousand cells for four seconds). Return as figures how long another reader waits for the answer
    to a small query.
    """
    seconds = site.choose_amount(30, 4)
    with open_stage(site.folder, vehicle_kb_s=1e4, vehicle_burst_kb=1e5) as stage:
        session = open_session(ZenohSettings(connect=[stage.endpoint]))
        assert session is not None
        with session:
            cells = _fill_map(session, stage, site.choose_amount(80, 20))
            _await_tile(session)
            readers = [_start_reader(stage.endpoint) for _ in range(HEAVY)]
            try:
                for reader in readers:
                    assert reader.stdout
                    assert reader.stdout.readline(), "a heavy reader got no answer"
                waits = _time_light_queries(session, seconds)
            finally:
                for reader in readers:
                    reader.terminate()
            heavy = [sum(1 for _ in reader.stdout or ()) for reader in readers]
            for reader in readers:
                reader.wait(30.0)
    site.say(f"{cells} cells; {len(waits)} light questions beside {heavy} heavy answers")
    return [
        make_figure("faults.query.light_p99_ms", float(np.percentile(waits, 99)) * 1e3),
        make_figure("faults.query.heavy_answers", min(heavy)),
        make_figure("faults.query.light_answers", len(waits)),
        Figure("faults.query.light_p50_ms", float(np.median(waits)) * 1e3, "ms"),
    ]


def _fill_map(session: zenoh.Session, stage: Stage, vehicles: int) -> int:
    """Fill the map: each vehicle visits 250 cells, one per second. Return the number of cells when
    all reports are acknowledged.
    """
    acked: set[str] = set()
    acks = session.declare_subscriber(
        f"{keys.ROOT}/ack/*", lambda sample: acked.add(str(sample.key_expr))
    )
    now = time.time_ns()
    names = [f"sim-{number:03}" for number in range(vehicles)]
    while len(acked) < vehicles:
        for number, name in enumerate(names):
            if keys.ack_key(name) in acked:
                continue
            for message in _make_lane(name, number, now):
                session.put(message.key, message.payload, encoding=message.encoding)
        time.sleep(1.0)
    acks.undeclare()
    assert stage.service.is_alive
    return 250 * vehicles


def _make_lane(name: str, number: int, now: int) -> list[Message]:
    out = []
    for seq in range(1, 6):
        at = np.arange(50) + 50 * (seq - 1)
        latitude = np.full(50, PLACE[0] + 2e-4 * number)
        longitude = PLACE[1] + 2e-4 * at
        cell = grid.cell_of(latitude, longitude)
        leave = now - (250 - at) * 10**9
        for region in np.unique(grid.region_of(cell)).tolist():
            mine = grid.region_of(cell) == region
            one = batch(name, seq, now, [0.8] * int(mine.sum()))
            where = {"latitude": latitude[mine], "longitude": longitude[mine], "cell": cell[mine]}
            columns = (
                one.columns | where | {"leave_time": leave[mine], "enter_time": leave[mine] - 10**9}
            )
            sent = Batch(Kind.OBSERVATION, name, one.boot, region, seq, 1, columns, "ckf")
            place = keys.observation_key(region, name)
            out.append(Message(sent.kind, place, wire.encode(sent), wire.ENCODING[sent.kind]))
    return out


def _find_tile() -> int:
    return int(grid.tile_of(grid.cell_of(*PLACE)))


def _await_tile(session: zenoh.Session) -> None:
    until(lambda: any(reply.ok for reply in session.get(keys.map_key(_find_tile()))))


def _time_light_queries(session: zenoh.Session, seconds: float) -> list[float]:
    """Query one map tile repeatedly for `seconds` seconds. Return, for each query, the time [s]
    until its answer.
    """
    waits = []
    end = time.monotonic() + seconds
    pause = threading.Event()
    while time.monotonic() < end:
        began = time.perf_counter()
        assert any(reply.ok for reply in session.get(keys.map_key(_find_tile()), timeout=30.0))
        waits.append(time.perf_counter() - began)
        pause.wait(0.02)
    return waits


def _start_reader(endpoint: str) -> subprocess.Popen[str]:
    command = [sys.executable, "-m", "tests.faults.queries", endpoint]
    return subprocess.Popen(command, stdout=subprocess.PIPE, text=True)


def main() -> None:
    """Query the whole map in a loop, and print a line for each complete answer."""
    session = open_session(ZenohSettings(connect=[sys.argv[1]]))
    assert session is not None
    with session:
        while True:
            replies = [
                reply
                for reply in session.get(f"{keys.ROOT}/map/**?format=geojson", timeout=60.0)
                if reply.ok
            ]
            if replies:
                size = sum(len(reply.ok.payload) for reply in replies if reply.ok)
                print(json.dumps({"tiles": len(replies), "bytes": size}), flush=True)


if __name__ == "__main__":
    main()
