"""The service gone for an hour while routers stand and cars drive on; then back, with room for so much a second.

The cars' outboxes are the real ones; network, service and time are made up, so that an hour takes a minute. A service
takes what its queue holds and drops the rest, and acknowledges twice a second. Each car has its share of what a service
of a thousand cars takes: 20 batches of a second, and 20 places of the queue.
"""

from __future__ import annotations

import math
from collections import deque
from dataclasses import dataclass, field
from typing import Final

from edge_agent.publish.batching import Draft
from edge_agent.publish.outbox import Outbox, StoredBatch
from schemas.runtime.figures import Figure
from schemas.wire import Kind
from tests.faults.bars import figure
from tests.faults.frame import Site

STEP_S: Final = 0.5
BATCH_BYTES: Final = 200  # of what a car sends in half a second
TAKEN_PER_S: Final = 20.0  # batches that a service of a thousand cars takes of each
QUEUED: Final = 20.0  # messages of its queue for each
REGION: Final = 77


@dataclass
class Made:
    """The service: batches that wait, those that it holds, and bytes that reached the routers."""

    cars: int
    up: bool = True
    queue: deque[tuple[Outbox, StoredBatch]] = field(default_factory=deque)
    held: set[tuple[str, int, Kind, int, int]] = field(default_factory=set)
    sent: int = 0
    messages: int = 0

    def put(self, outbox: Outbox, batch: StoredBatch) -> None:
        """A batch on its way: into the queue, or lost."""
        self.sent += len(batch.payload)
        self.messages += 1
        if self.up and len(self.queue) < QUEUED * self.cars:
            self.queue.append((outbox, batch))

    def work(self) -> int:
        """Take as much as a step allows, and acknowledge it; returns how many were new."""
        new = 0
        for _ in range(min(len(self.queue), round(TAKEN_PER_S * STEP_S * self.cars)) if self.up else 0):
            outbox, batch = self.queue.popleft()
            new += (*batch.stream, batch.seq) not in self.held
            self.held.add((*batch.stream, batch.seq))
            outbox.settle(batch.stream, [(batch.seq, batch.seq)])
        return new


def run(site: Site) -> list[Figure]:
    """An hour, or ten minutes in a quick run."""
    cars, away_s = site.of(20, 2), site.of(3600, 600)
    outboxes = [Outbox(site.folder / f"{n}.sqlite", boot=n + 1) for n in range(cars)]
    service, made, now = Made(cars), 0, 0.0
    stored: set[tuple[str, int, Kind, int, int]] = set()

    def step(driving: bool) -> int:
        nonlocal made, now
        for n, outbox in enumerate(outboxes):
            drafts = [Draft(f"car-{n:03}", Kind.OBSERVATION, REGION, 4, lambda seq, first: bytes(BATCH_BYTES))]
            fresh = outbox.store(drafts, now) if driving else []
            made += BATCH_BYTES * len(fresh)
            stored.update((*batch.stream, batch.seq) for batch in fresh)
            for batch in [one for one in fresh if one.fresh] + outbox.due(now, 640):
                service.put(outbox, batch)
        now += STEP_S
        return service.work()

    def steps(seconds: float, driving: bool = True) -> list[int]:
        return [step(driving) for _ in range(math.ceil(seconds / STEP_S))]

    steps(60)
    before = service.messages
    service.up = False
    steps(away_s)
    while_away = service.messages - before
    backlog = sum(outbox.batches for outbox in outboxes)
    service.up = True
    taken: list[int] = []
    while sum(outbox.batches for outbox in outboxes) > QUEUED * cars and now < 4 * away_s:
        taken.append(step(driving=True))
    steps(30, driving=False)
    lost = len(stored - service.held)
    left = sum(outbox.batches for outbox in outboxes)
    for outbox in outboxes:
        outbox.close()
    begun = next((at for at, n in enumerate(taken) if n > cars), 0)  # the first cars have noticed
    drain = sum(taken[begun:]) / max(len(taken) - begun, 1) / (TAKEN_PER_S * STEP_S * cars)
    site.say(f"{backlog} batches waited; {while_away} messages while away; drained in {len(taken) * STEP_S:.0f} s")
    return [
        figure("faults.away.bytes_ratio", service.sent / made),
        figure("faults.away.lost", lost + left),
        figure("faults.away.drain_share", drain),
        figure("faults.away.backlog", backlog / cars),
        Figure("faults.away.messages_while_away", while_away / cars, "messages a car"),
        Figure("faults.away.noticed_s", begun * STEP_S, "s until cars go fast again"),
    ]
