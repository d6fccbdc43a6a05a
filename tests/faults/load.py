"""Load generator. It sends observations of synthetic visits (passes through map cells) through the
agent's real publisher and outbox, and writes a journal of stored and settled (acknowledged or
refused by the service) batches.

`python -m tests.faults.load FILE` reads the fields of `Plan` from a JSON file. The journal is the
standard output: one line per batch that was committed to the outbox, and one per batch that an
acknowledgement settled. The output is unbuffered, so that the journal survives kill -9. On SIGUSR1
the generator offers no new observations, and ends when every batch is settled. On SIGTERM it ends
as an agent does. At the end it prints one line of JSON.
"""

from __future__ import annotations

import json
import os
import signal
import sys
import threading
import time
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from edge_agent.app.live_loop import STOPPED_DRAIN_S
from edge_agent.observe.observation_builder import RecordBlock
from edge_agent.publish.batching import Draft
from edge_agent.publish.held_batches import Stream
from edge_agent.publish.outbox import Outbox, StoredBatch
from edge_agent.publish.publisher import Publisher
from schemas import grid, mugrid
from schemas.config import AgentConfig, ZenohSettings
from schemas.numeric import IntArray
from schemas.runtime.process import exit_fast
from schemas.wire import Columns, Kind, column_types

BLOCK_S = 0.1
PLACE = (57.70, 11.97)


@dataclass(frozen=True)
class Plan:
    """Settings of one load generator; `rate` is observations per second and vehicle."""

    endpoint: str
    names: list[str]
    rate: float
    outbox: str
    seed: int = 0
    flush_s: float = 0.5
    capacity_mb: float = 256.0
    cells_across: int = 64  # side of the square that the vehicles drive in, in cells


def print_events(sign: str, events: Iterable[tuple[Stream, int, int]]) -> None:
    """Write one line to the journal (standard output) for each batch in `events`: `sign vehicle
    boot kind region seq records time`. The sign is `+` if the batch was stored on disk, and `-` if
    it was settled (acknowledged or refused by the service).
    """
    at = f"{time.time():.3f}"
    for stream, seq, records in events:
        os.write(
            sys.stdout.fileno(),
            f"{sign} {' '.join(map(str, stream))} {seq} {records} {at}\n".encode(),
        )


class WatchedOutbox(Outbox):
    """Outbox of an agent that also prints a line when a batch is stored or settled (acknowledged or
    refused by a service).
    """

    def store(self, drafts: Sequence[Draft], now: float) -> list[StoredBatch]:
        held = super().store(drafts, now)
        print_events("+", ((batch.stream, batch.seq, batch.records) for batch in held))
        return held

    def settle_ranges(self, stream: Stream, ranges: Iterable[tuple[int, int]]) -> int:
        settled = list(ranges)
        print_events(
            "-", ((stream, seq, 0) for first, last in settled for seq in range(first, last + 1))
        )
        return super().settle_ranges(stream, settled)


def make_visits(
    rng: np.random.Generator, vehicle: IntArray, now: int, cells_across: int
) -> RecordBlock:
    """Return one synthetic visit (pass through a map cell) for each vehicle number in `vehicle`
    (n,). All visits end at the time `now` [ns].
    """
    n = len(vehicle)
    columns: Columns = {}
    for name, dtype in column_types(Kind.OBSERVATION).items():
        columns[name] = (
            np.zeros(n, dtype) if dtype.kind != "f" else rng.uniform(0.3, 0.9, n).astype(dtype)
        )
    span = cells_across * 360.0 / 2**grid.CELL_ZOOM
    columns["latitude"], columns["longitude"] = (centre + span * rng.random(n) for centre in PLACE)
    columns["cell"] = grid.cell_of(columns["latitude"], columns["longitude"])
    columns["sector"] = grid.sector_of(columns["yaw"]).astype(np.int8)
    columns["mu_lower"] = columns["mu"] - np.float32(0.1)
    columns["mu_upper"] = columns["mu"] + np.float32(0.1)
    columns["leave_time"] = np.full(n, now, np.int64)
    columns["enter_time"] = columns["leave_time"] - rng.integers(300_000_000, 900_000_000, n)
    seen = -0.5 * np.square((mugrid.CENTRES - columns["mu"][:, None]) / 0.1)
    columns["log_likelihood"] = mugrid.encode_log_likelihood(seen)
    return RecordBlock(Kind.OBSERVATION, columns, vehicle, np.zeros(n, bool))


def offer_blocks(plan: Plan, publisher: Publisher, quiet: threading.Event) -> tuple[int, float]:
    """Offer a block of observations to the agent's publisher every BLOCK_S seconds, until the event
    `quiet` is set. Return the number of blocks that were late by more than BLOCK_S, and the longest
    delay [s].
    """
    rng = np.random.default_rng(plan.seed)
    per_block = plan.rate * BLOCK_S * len(plan.names)
    owed = 0.0
    late = 0
    longest = 0.0
    due = time.monotonic()
    while not quiet.is_set():
        owed += per_block
        n = int(owed)
        owed -= n
        first = rng.integers(0, len(plan.names))
        vehicles = np.sort((first + np.arange(n)) % len(plan.names)).astype(np.int64)
        publisher.offer(make_visits(rng, vehicles, time.time_ns(), plan.cells_across))
        due += BLOCK_S
        lag = time.monotonic() - due
        late += lag > 0.0
        longest = max(longest, lag)
        quiet.wait(max(0.0, -lag))
    return late, longest


def _set_events(*events: threading.Event) -> None:
    for event in events:
        event.set()


def main(path: str) -> int:
    """Run one load generator until a signal ends it."""
    plan = Plan(**json.loads(Path(path).read_text()))
    quiet = threading.Event()
    leave = threading.Event()
    signal.signal(signal.SIGUSR1, lambda *_: quiet.set())
    for number in (signal.SIGTERM, signal.SIGINT):
        signal.signal(number, lambda *_: _set_events(leave, quiet))
    outbox = WatchedOutbox(Path(plan.outbox), capacity_bytes=round(plan.capacity_mb * 1e6))
    config = AgentConfig(zenoh=ZenohSettings(connect=[plan.endpoint]), flush_s=plan.flush_s)
    publisher = Publisher(plan.names, outbox, config, "load")
    publisher.start()
    print("ready: load", flush=True)
    late, longest = offer_blocks(plan, publisher, quiet)
    while publisher.count_unsettled() and not leave.wait(BLOCK_S):
        pass
    clean = publisher.close(STOPPED_DRAIN_S)
    found = {
        "late_blocks": late,
        "longest_lag_s": round(longest, 3),
        "unsettled": publisher.count_unsettled(),
    }
    print(
        json.dumps(
            {
                **found,
                "dropped": publisher.status.dropped_records,
                "resent": publisher.counts.resent_batches,
            }
        ),
        flush=True,
    )
    if not clean:
        os._exit(0)
    return 0


if __name__ == "__main__":
    exit_fast(main(sys.argv[1]))
