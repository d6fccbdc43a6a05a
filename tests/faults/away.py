"""Campaign on an outage of an hour: the service is down while routers run and cars drive on; then
the service returns with a limited rate.

The cars' outboxes (stores of unacknowledged messages) and the service's engine (the service without
its network) are real. Network and time are simulated, so that an hour takes a minute. The simulated
service has an input queue, and drops messages that do not fit. Twice a second it writes rows to
disk and acknowledges them. The service processes 20 batches a second for each car, and its queue
has 20 places for each car. A real service with a thousand cars has the same rate and queue per car.
Every second each car enters a cell that no car visited before. At the end all these cells must be
on the map.
"""

from __future__ import annotations

import math
from collections import deque
from contextlib import closing
from dataclasses import dataclass, field, replace
from typing import Final

from edge_agent.publish.batching import Draft
from edge_agent.publish.held_batches import Stream
from edge_agent.publish.outbox import Outbox, StoredBatch
from fleet_service.app.engine import Engine
from fleet_service.ingest.inbox import Message
from schemas import grid, keys, wire
from schemas.config import ServiceConfig
from schemas.runtime.figures import Figure
from schemas.wire import Kind
from tests.faults.bars import make_figure
from tests.faults.frame import Site
from tests.fleet_service.examples import START, batch

STEP_S: Final = 0.5
NS: Final = 10**9
PLACE: Final = (57.0, 12.0)
CELL_DEG: Final = 360.0 / 2**grid.CELL_ZOOM
TAKEN_PER_S: Final = 20.0  # [1/s] batches per car that a service of 1 000 cars processes
QUEUED: Final = 20.0  # places per car in the service's input queue


@dataclass
class Made:
    """Fleet service without a network: the service's real code (`engine`) behind a simulated input
    queue of batches. While `up` is False, the service is down and every batch is lost. The class
    also counts the messages and bytes that the cars sent to the routers.
    """

    cars: int
    engine: Engine
    up: bool = True
    queue: deque[StoredBatch] = field(default_factory=deque)
    sent: int = 0
    messages: int = 0

    def put(self, batch: StoredBatch) -> None:
        """Receive a batch of reports: put it into the service's queue, or drop it if the queue is
        full.
        """
        self.sent += len(batch.payload)
        self.messages += 1
        if self.up and len(self.queue) < QUEUED * self.cars:
            self.queue.append(batch)

    def store_queued(self, now: float) -> list[tuple[str, bytes]]:
        """Ingest queued batches, write them to disk, and return (vehicle, acknowledgement) pairs.
        The simulation calls this method once per time step, STEP_S. Each call takes at most
        TAKEN_PER_S · STEP_S batches per car.
        """
        if not self.up:
            return []
        taken = [
            self.queue.popleft()
            for _ in range(min(len(self.queue), round(TAKEN_PER_S * STEP_S * self.cars)))
        ]
        self.engine.intake.ingest([_make_message(one) for one in taken], START + round(now * NS))
        return self.engine.settlement.flush()


def _make_message(one: StoredBatch) -> Message:
    key = keys.observation_key(one.stream.region, one.stream.vehicle)
    return Message(one.stream.kind, key, one.payload, wire.ENCODING[one.stream.kind])


def _make_draft(car: int, now: float) -> tuple[Draft, int]:
    """Return a batch (not yet stored) with a car's reports of half a second, and the cell of these
    reports. Each car has its own road.
    """
    latitude = PLACE[0] + 2 * CELL_DEG * car
    longitude = PLACE[1] + CELL_DEG * int(now)
    cell = int(grid.cell_of(latitude, longitude))
    region = int(grid.region_of(cell))
    time = START + round(now * NS)
    message = batch(
        f"car-{car:03}",
        1,
        time,
        [0.6],
        latitude=[latitude],
        longitude=[longitude],
        cell=[cell],
        position_std=[0.1],
    )

    def encode_batch(seq: int, first_held: int) -> bytes:
        return wire.encode(
            replace(message, boot=car + 1, region=region, seq=seq, first_held=first_held)
        )

    return Draft(message.vehicle, Kind.OBSERVATION, region, 1, encode_batch), cell


def run(site: Site) -> list[Figure]:
    """Simulate an outage of one hour (in a quick run, ten minutes), and return the figures."""
    with closing(Engine(ServiceConfig(), site.folder / "archive")) as engine:
        return _run_outage(site, engine)


class Cars:
    """Simulated cars with their outboxes, which send reports to a simulated service.

    Attributes:
        now: simulated time since the start [s].
        stored: number of batches that the cars have stored.
        made: bytes of these batches.
        cells: cells that the cars have visited.
    """

    def __init__(self, count: int, site: Site, service: Made) -> None:
        self._outboxes = [Outbox(site.folder / f"{n}.sqlite", boot=n + 1) for n in range(count)]
        self._service = service
        self.now = 0.0
        self.stored = 0
        self.made = 0
        self.cells = set[int]()

    @property
    def held(self) -> int:
        """Return the number of batches that the cars hold, because they are not acknowledged."""
        return sum(len(outbox.held) for outbox in self._outboxes)

    def advance(self, seconds: float, driving: bool = True) -> None:
        """Advance the simulation by `seconds`. Cars that do not drive make no new batches."""
        for _ in range(math.ceil(seconds / STEP_S)):
            self.advance_step(driving)

    def advance_step(self, driving: bool = True) -> int:
        """Advance the simulation by STEP_S. Return the number of observations that the service has
        accepted in this time.
        """
        for car, outbox in enumerate(self._outboxes):
            fresh = self._store_reports(car, outbox) if driving else []
            for one in [one for one in fresh if one.fresh] + outbox.due_batches(self.now, 640):
                self._service.put(one)
        self.now += STEP_S
        counts = self._service.engine.counts
        before = counts.observations
        for vehicle, ack in self._service.store_queued(self.now):
            for stream in wire.decode_ack(ack)[1]:
                found = Stream(vehicle, stream.boot, stream.kind, stream.region)
                outbox = self._outboxes[int(vehicle.removeprefix("car-"))]
                outbox.settle_ranges(found, stream.durable)
        return counts.observations - before

    def _store_reports(self, car: int, outbox: Outbox) -> list[StoredBatch]:
        draft, cell = _make_draft(car, self.now)
        self.cells.add(cell)
        fresh = outbox.store([draft], self.now)
        self.stored += len(fresh)
        self.made += sum(len(batch.payload) for batch in fresh)
        return fresh

    def close(self) -> None:
        """Close the outboxes."""
        for outbox in self._outboxes:
            outbox.close()


def _run_outage(site: Site, engine: Engine) -> list[Figure]:
    count = site.choose_amount(20, 2)
    away_s = site.choose_amount(3600, 600)
    service = Made(count, engine)
    cars = Cars(count, site, service)
    cars.advance(60)
    before = service.messages
    service.up = False
    cars.advance(away_s)
    while_away = service.messages - before
    backlog = cars.held
    service.up = True
    accepted: list[int] = []
    while cars.held > QUEUED * count and cars.now < 4 * away_s:
        accepted.append(cars.advance_step())
    cars.advance(30, driving=False)
    lost = abs(cars.stored - engine.counts.observations)
    left = cars.held
    cars.close()
    # From this step on, vehicles have noticed that the service is back.
    noticed = next((step for step, n in enumerate(accepted) if n > count), 0)
    mean = sum(accepted[noticed:]) / max(len(accepted) - noticed, 1)
    drain = mean / (TAKEN_PER_S * STEP_S * count)
    site.say(
        f"{backlog} batches waited; {while_away} messages while away; drained in "
        f"{len(accepted) * STEP_S:.0f} s"
    )
    return [
        make_figure("faults.away.bytes_ratio", service.sent / cars.made),
        make_figure("faults.away.lost", lost + left),
        make_figure("faults.away.drain_share", drain),
        make_figure("faults.away.backlog", backlog / count),
        make_figure("faults.away.map_missing", len(cars.cells - _list_shown_cells(engine))),
        make_figure("faults.away.late", engine.counts.late),
        Figure("faults.away.messages_while_away", while_away / count, "messages a car"),
        Figure("faults.away.noticed_s", noticed * STEP_S, "s until cars go fast again"),
    ]


def _list_shown_cells(engine: Engine) -> set[int]:
    """Return the numbers of the cells on the service's map in which at least one visit (passage of
    a vehicle) is counted.
    """
    fusion = engine.state.fusion
    return set(fusion.cell[fusion.live.visits[: fusion.size] > 0].tolist())
