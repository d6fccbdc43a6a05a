"""Campaign on one vehicle that sends as fast as it can: its effect on the map and on the
acknowledgement times of other vehicles.

Its reports are true, so they should change the map only as much as one report per second. The map
is therefore compared with a reference map. An engine (service without network) makes the reference
from the same batches of the honest vehicles and one report per second of the flooding vehicle.
"""

from __future__ import annotations

import json
import subprocess
import sys
import threading
import time
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Final

import numpy as np
import pyarrow as pa
import zenoh

from fleet_service.app.engine import Engine
from fleet_service.ingest.inbox import Message
from schemas import grid, keys, query, wire
from schemas.config import ServiceConfig
from schemas.runtime.figures import Figure
from schemas.wire import Batch, Kind
from schemas.wire.tile import decode_tile
from tests.faults.bars import make_figure
from tests.faults.frame import Site
from tests.fleet_service.examples import LATITUDE, LONGITUDE, SECOND, batch, key
from tests.secured import READER, ROUTERS, SERVICE, Network, make_enrolment, open_network, settings
from tests.waiting import until

HONEST: Final = tuple(f"car-{number:03}" for number in range(10))
FLOODER: Final = "flood-001"
CELLS: Final = 20
FLOODED_MU: Final = 0.8
EVERY_S: Final = 0.5  # time between two messages of an honest vehicle
RESEND_S: Final = 2.0  # time after which an unacknowledged message is sent again, as in an outbox
START_S: Final = 300.0  # patience for the first start, which compiles the kernels
_ASKED: Final = "gripmap/v1/map/**"


def list_places() -> list[tuple[int, float, float]]:
    """Return (cell, latitude, longitude) of each place along the road on which all vehicles of this
    campaign drive.
    """
    longitudes = [LONGITUDE + 2e-4 * place for place in range(CELLS)]
    return [(int(grid.cell_of(LATITUDE, one)), LATITUDE, one) for one in longitudes]


def make_visit(name: str, seq: int, now: int) -> Batch:
    """Return a batch of the vehicle `name` with one visit (pass through a cell) that ends at `now`
    [ns]. The sequence number `seq` determines the cell: the next number is the next cell along the
    road.
    """
    cell, latitude, longitude = list_places()[(seq + hash_of(name)) % CELLS]
    mu = FLOODED_MU if name == FLOODER else 0.75 + 0.01 * (hash_of(name) % 10)
    return batch(name, seq, now, [mu], cell=[cell], latitude=[latitude], longitude=[longitude])


def hash_of(name: str) -> int:
    """Return a number that is computed from the vehicle name `name` and is the same in every run of
    the program, unlike Python's `hash`.
    """
    return sum(name.encode())


@dataclass
class Honest:
    """Honest vehicle that sends batches, repeats batches that are not acknowledged, and records the
    time until each acknowledgement.
    """

    session: zenoh.Session
    name: str
    sent: dict[int, tuple[Batch, float]] = field(default_factory=dict)
    delays: dict[int, float] = field(default_factory=dict)
    resent: int = 0

    def __post_init__(self) -> None:
        # [s] time of the last transmission of each unacknowledged batch.
        self._last: dict[int, float] = {}
        self._acks = self.session.declare_subscriber(keys.ack_key(self.name), self._record_ack)

    def _record_ack(self, sample: zenoh.Sample) -> None:
        now = time.monotonic()
        for stream in wire.decode_ack(sample.payload.to_bytes())[1]:
            for first, last in stream.durable:
                for seq in range(first, last + 1):
                    self.delays.setdefault(seq, now - self.sent[seq][1])

    def _put_batch(self, one: Batch) -> None:
        self.session.put(
            key(self.name),
            wire.encode(one),
            encoding=wire.ENCODING[Kind.OBSERVATION],
            congestion_control=zenoh.CongestionControl.BLOCK,
        )

    def drive(self) -> None:
        """Publish the next batch of this honest vehicle, and remember when it was sent."""
        seq = len(self.sent) + 1
        one = make_visit(self.name, seq, time.time_ns())
        self._last[seq] = time.monotonic()
        self.sent[seq] = (one, self._last[seq])
        self._put_batch(one)

    def resend(self) -> None:
        """Send again this vehicle's batches that wait for longer than RESEND_S, as an agent's
        outbox (store of unacknowledged messages) does.
        """
        now = time.monotonic()
        for seq in [seq for seq in self._last if seq in self.delays]:
            del self._last[seq]
        for seq, at in self._last.items():
            if now - at > RESEND_S:
                self._last[seq] = now
                self.resent += 1
                self._put_batch(self.sent[seq][0])


def run(site: Site) -> list[Figure]:
    """Flood the service for half a minute (in a quick run, three seconds). Return figures: delays
    [s] until honest vehicles' batches are acknowledged, before the flood and during it; the
    difference between the map and the reference map; the rate of the flood; and the number of
    batches that honest vehicles sent again.
    """
    seconds = site.choose_amount(30, 3)
    fleet = make_enrolment(vehicles=[*HONEST, FLOODER])
    with open_network(site.folder / "certificates", fleet=fleet) as running:
        service = _start_service(site.folder, running)
        try:
            honest = [
                Honest(running.open_session(name, ROUTERS[k % 2]), name)
                for k, name in enumerate(HONEST)
            ]
            _drive(honest, 4 * EVERY_S)
            _settle(honest)
            before = max(delay for one in honest for delay in one.delays.values())
            site.say(f"without a flood the longest delay is {before:.2f} s")
            first = {one.name: len(one.sent) for one in honest}
            put = _run_flood(running, honest, seconds)
            _settle(honest)
            delays = np.array(
                [d for one in honest for seq, d in one.delays.items() if seq > first[one.name]]
            )
            table = _read_map(running)
            with_flood = time.time_ns()
            for one in honest:
                one.session.close()
        finally:
            service.terminate()
            service.wait(20.0)
    expected = _simulate_unflooded(site.folder / "calm", honest, seconds, with_flood)
    site.say(
        f"{put / seconds:.0f} messages/s of flood; honest delays p50 {np.median(delays):.2f} s"
    )
    return [
        make_figure("faults.flood.honest_delay_s", float(delays.max())),
        make_figure("faults.flood.map_difference", _find_difference(table, expected, honest)),
        make_figure("faults.flood.rate", put / seconds),
        Figure("faults.flood.honest_delay_p50_s", float(np.median(delays)), "s"),
        Figure("faults.flood.calm_delay_s", before, "s"),
        Figure("faults.flood.honest_resent", sum(one.resent for one in honest), "batches"),
    ]


def _start_service(folder: Path, running: Network) -> subprocess.Popen[bytes]:
    """Start the service as a separate process, and return it when it accepts messages."""
    config = ServiceConfig(
        zenoh=settings(running.endpoints[ROUTERS[0]], running.folder), name=SERVICE
    )
    file = folder / "service.json"
    log = folder / "service.log"
    file.write_text(config.model_dump_json())
    command = [
        str(Path(sys.executable).with_name("fleet-service")),
        "run",
        "--config",
        str(file),
        "--archive",
        str(folder / "archive"),
    ]
    with log.open("wb") as out:
        process = subprocess.Popen(command, stdout=out, stderr=out)
    until(lambda: "ready" in log.read_text() or process.poll() is not None, START_S)
    return process


def _drive(honest: Sequence[Honest], seconds: float) -> None:
    end = time.monotonic() + seconds
    pause = threading.Event()
    while time.monotonic() < end:
        for one in honest:
            one.drive()
            one.resend()
            pause.wait(EVERY_S / len(honest))


def _settle(honest: Sequence[Honest]) -> None:
    def is_settled() -> bool:
        for one in honest:
            one.resend()
        return all(len(one.delays) == len(one.sent) for one in honest)

    until(is_settled, 60.0)


def _run_flood(running: Network, honest: Sequence[Honest], seconds: float) -> int:
    """Let the honest vehicles drive during the flood. Return the number of messages that the
    flooding vehicle sent.
    """
    task = {
        "settings": settings(running.endpoints[ROUTERS[0]], running.folder).model_dump(),
        "name": FLOODER,
        "cells": list_places(),
        "mu": FLOODED_MU,
        "seconds": seconds,
    }
    command = [sys.executable, "-m", "tests.faults.flooder"]
    with subprocess.Popen(
        command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True
    ) as process:
        assert process.stdin
        assert process.stdout
        print(json.dumps(task), file=process.stdin, flush=True)
        assert process.stdout.readline(), "the flooder does not open a session"
        _drive(honest, seconds)
        return int(process.stdout.readline())


def _read_map(running: Network) -> pa.Table:
    with running.open_session(READER) as session:
        replies = [reply.ok.payload.to_bytes() for reply in session.get(_ASKED) if reply.ok]
    return pa.concat_tables([decode_tile(payload) for payload in replies])


def _simulate_unflooded(
    folder: Path, honest: Sequence[Honest], seconds: float, now: int
) -> pa.Table:
    """Return the reference map. It contains the same visits of the honest vehicles as the tested
    map. The flooding vehicle sends only one visit (pass through a cell) a second, and at least one
    for every cell of the road.
    """
    sent = [one for vehicle in honest for one, _ in vehicle.sent.values()]
    began = min(int(one.columns["leave_time"][0]) for one in sent)
    rounds = max(int(seconds), CELLS)
    sent += [
        make_visit(FLOODER, 1 + k, began + k * int(seconds) * SECOND // rounds)
        for k in range(rounds)
    ]
    engine = Engine(ServiceConfig(), folder)
    for one in sorted(sent, key=lambda one: int(one.columns["leave_time"][0])):
        engine.intake.ingest(
            [Message(one.kind, key(one.vehicle), wire.encode(one), wire.ENCODING[one.kind])], now
        )
    tiles = list(engine.queries.answer(query.parse({}), lambda _: True, now))
    engine.close()
    return pa.concat_tables([decode_tile(payload) for _, payload in tiles])


def _find_difference(found: pa.Table, expected: pa.Table, honest: Sequence[Honest]) -> float:
    """Return the largest difference of the friction bounds `mu_lower` and `mu_upper` between two
    maps, over the cells that honest vehicles visited. The result is NaN if such a cell is missing.
    """
    driven = {int(sent.columns["cell"][0]) for one in honest for sent, _ in one.sent.values()}
    ends = [
        {row["cell"]: (row["mu_lower"], row["mu_upper"]) for row in table.to_pylist()}
        for table in (found, expected)
    ]
    if not driven <= ends[0].keys() & ends[1].keys():
        return float("nan")
    return float(max(np.abs(np.subtract(ends[0][cell], ends[1][cell])).max() for cell in driven))
