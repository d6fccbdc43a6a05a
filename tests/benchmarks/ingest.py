"""Ingest: bytes → decoded, admitted, fused, in a synced Parquet segment, acknowledged; without the network.

Every round sends fresh batches of many vehicles to a new archive. The limit beside it only decodes the same messages.
CPU time beside wall time, because other work on the machine slows the one and not the other.
"""

from __future__ import annotations

import statistics
import tempfile
import time
from contextlib import closing
from pathlib import Path
from typing import Final

import numpy as np

from fleet_service.engine import Engine
from fleet_service.ingest import Message
from schemas import keys, wire
from schemas.config import ServiceConfig
from schemas.decoding import decode_many
from schemas.figures import Figure
from schemas.wire import Batch, Kind
from tests.benchmarks.measure import SEED
from tests.faults.load import visits

VEHICLES: Final = 1000
CELLS_ACROSS: Final = 200
TURN: Final = 4096  # messages that the service takes at once
FLUSH: Final = 20_000  # messages between two segments
MESSAGES: Final = {10: 16_384, 1: 65_536}  # to a round, by records in each
ROUNDS: Final = 3


def ingest() -> list[Figure]:
    """Observations per second, ten and one to a message, and CPU beside decoding alone."""
    ten, decoding = rates(10)
    one, _ = rates(1)
    return [
        Figure("bench.ingest.batch10_per_s", ten[0], "observations/s", 150_000, "more"),
        Figure("bench.ingest.batch10_per_cpu_s", ten[1], "observations per CPU second"),
        Figure("bench.ingest.single_per_s", one[0], "observations/s", 60_000, "more"),
        Figure("bench.ingest.single_per_cpu_s", one[1], "observations per CPU second"),
        Figure("bench.ingest.cpu_vs_bare", decoding / ten[1], "times the CPU of decoding alone", 4),
    ]


def rates(records: int) -> tuple[tuple[float, float], float]:
    """Observations per second and per CPU second, and per CPU second of decoding alone; medians after a warm-up."""
    sent = messages(MESSAGES[records], records)
    taken = [_take(sent, records) for _ in range(ROUNDS + 1)][1:]
    began = time.process_time()
    for at in range(0, len(sent), TURN):
        decode_many(Kind.OBSERVATION, [(m.payload, m.encoding) for m in sent[at : at + TURN]])
    decoding = len(sent) * records / (time.process_time() - began)
    return (statistics.median(t[0] for t in taken), statistics.median(t[1] for t in taken)), decoding


def messages(count: int, records: int) -> list[Message]:
    """So many messages of VEHICLES vehicles in one region."""
    columns = visits(np.random.default_rng(SEED), np.zeros(2 * count * records, np.int64), time.time_ns(), CELLS_ACROSS)
    home = columns.columns["cell"] >> 22
    region = int(np.bincount(home - home.min()).argmax() + home.min())
    mine = np.resize(np.flatnonzero(home == region), count * records)
    out = []
    for number in range(count):
        part = mine[number * records : (number + 1) * records]
        seq, place = divmod(number, VEHICLES)
        taken = {name: column[part] for name, column in columns.columns.items()}
        batch = Batch(Kind.OBSERVATION, f"sim-{place:04}", 1, region, seq + 1, seq + 1, taken, "aco-fckf")
        key = keys.observation_key(region, batch.vehicle)
        out.append(Message(batch.kind, key, wire.encode(batch), wire.ENCODING[batch.kind]))
    return out


def _take(sent: list[Message], records: int) -> tuple[float, float]:
    with tempfile.TemporaryDirectory() as folder, closing(Engine(ServiceConfig(), Path(folder))) as engine:
        wall, cpu = time.perf_counter(), time.process_time()
        for at in range(0, len(sent), TURN):
            engine.take(sent[at : at + TURN], time.time_ns())
            if at % FLUSH < TURN:
                engine.flush()
        engine.flush()
        wall, cpu = time.perf_counter() - wall, time.process_time() - cpu
        assert engine.counts[Kind.OBSERVATION] == len(sent) * records, engine.counts
    return len(sent) * records / wall, len(sent) * records / cpu
