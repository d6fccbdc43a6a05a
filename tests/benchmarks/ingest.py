"""Benchmark of ingest without the network: messages are decoded, admitted, fused, written to a
synced Parquet file (segment), and acknowledged.

Every round sends new batches of many vehicles to a new archive. The limit for comparison is a
subscriber that only decodes the same messages with protobuf's own module into one array per column.
CPU time is given in addition to wall time, because other work on the machine affects only wall
time.
"""

from __future__ import annotations

import gc
import statistics
import tempfile
import time
from collections.abc import Callable
from contextlib import closing
from itertools import chain
from operator import attrgetter
from pathlib import Path
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from fleet_service.app.engine import Engine
from fleet_service.ingest.batch_decoder import decode_many
from fleet_service.ingest.inbox import STEP_BYTES, STEP_MESSAGES, Message
from schemas import grid, keys, mugrid, wire
from schemas.config import ServiceConfig
from schemas.runtime.figures import Figure
from schemas.wire import Batch, Kind
from tests.benchmarks.measure import SEED
from tests.faults.load import make_visits

VEHICLES: Final = 1000
CELLS_ACROSS: Final = 200
STEP_NS: Final = 200_000_000  # time from one cell of 10 m to the next
REGION_BITS: Final = 2 * (grid.CELL_ZOOM - grid.REGION_ZOOM)
FLUSH: Final = 20_000  # messages between two written segments
COUNTS: Final = {10: 16_384, 1: 65_536}  # messages per round, by the number of records in a message
MESSAGE: Final = wire.MESSAGES[Kind.OBSERVATION]
ROUNDS: Final = 3


def ingest() -> list[Figure]:
    """Measure how many observations per second a service ingests, with ten observations and with
    one observation per message, and compare its CPU time with that of decoding alone. Return the
    figures.
    """
    ten, bare, own = measure_rates(10)
    one, *_ = measure_rates(1)
    return [
        Figure("bench.ingest.batch10_per_s", ten[0], "observations/s", 150_000, "more"),
        Figure("bench.ingest.batch10_per_cpu_s", ten[1], "observations per CPU second"),
        Figure("bench.ingest.single_per_s", one[0], "observations/s", 60_000, "more"),
        Figure("bench.ingest.single_per_cpu_s", one[1], "observations per CPU second"),
        Figure(
            "bench.ingest.cpu_vs_bare",
            bare / ten[1],
            "times the CPU of decoding alone, protobuf's module",
            4,
        ),
        Figure(
            "bench.ingest.cpu_vs_own_decoding", own / ten[1], "times the CPU of our decoding alone"
        ),
    ]


def measure_rates(records: int) -> tuple[tuple[float, float], float, float]:
    """Measure the ingest of messages with `records` observations each. Return medians after a
    warm-up: observations per wall second and per CPU second of the whole ingest. The last two
    values are observations per CPU second of decoding alone, with protobuf's generated module and
    with our decoder.
    """
    sent = make_messages(COUNTS[records], records, time.time_ns())
    taken = [_time_ingest(sent, records) for _ in range(ROUNDS + 1)][1:]
    rate = statistics.median(t[0] for t in taken), statistics.median(t[1] for t in taken)
    bare, own = (
        len(sent)
        * records
        / statistics.median([_decoding_s(sent, decode) for _ in range(ROUNDS + 1)][1:])
        for decode in (
            _decode_messages,
            lambda part: decode_many(Kind.OBSERVATION, [(m.payload, m.encoding) for m in part]),
        )
    )
    return rate, bare, own


def _decoding_s(sent: list[Message], decode: Callable[[list[Message]], object]) -> float:
    turn = turn_of(sent)
    began = time.process_time()
    for at in range(0, len(sent), turn):
        decode(sent[at : at + turn])
    return time.process_time() - began


def turn_of(sent: list[Message]) -> int:
    """Return how many of the messages `sent` the service would ingest in one pass of its
    main loop.
    """
    return min(STEP_BYTES // len(sent[0].payload), STEP_MESSAGES)


def _decode_messages(sent: list[Message]) -> list[NDArray[Any]]:
    """Return the columns (n,) of the n observations in messages, decoded by protobuf's generated
    module.
    """
    read = [MESSAGE.FromString(message.payload) for message in sent]
    out: list[NDArray[Any]] = []
    for name, dtype in wire.column_types(Kind.OBSERVATION).items():
        fields = list(map(attrgetter(name), read))
        if name == "log_likelihood":
            out.append(np.frombuffer(b"".join(fields), np.uint8).reshape(-1, mugrid.BINS))
        else:
            out.append(np.fromiter(chain.from_iterable(fields), dtype, sum(map(len, fields))))
    return out


def corner_of_region(east: int) -> tuple[int, int]:
    """Return column and row of the north-west cell of a region. The region lies `east` regions east
    of the one that contains Gothenburg.
    """
    x, y = grid.deinterleave(grid.region_of(grid.cell_of(57.7, 11.97)) << REGION_BITS)
    return int(x) + (east << REGION_BITS // 2), int(y)


def make_messages(
    count: int, records: int, now: int, vehicles: int = VEHICLES, begin: int = 0, east: int = 0
) -> list[Message]:
    """Return `count` messages with `records` visits (passes through map cells) each. The last
    visits end at `now` [ns]. All visits lie in one region, `east` regions east of the usual one.

    Vehicles and sequence numbers continue after the first `begin` messages, which an earlier call
    has returned. Each vehicle drives to and fro on a straight road, so that the service accepts its
    path.
    """
    rng = np.random.default_rng([SEED, begin])
    columns = make_visits(rng, np.zeros(count * records, np.int64), now, CELLS_ACROSS).columns
    message, vehicle = (
        np.repeat(part, records) for part in divmod(begin + np.arange(count), vehicles)
    )
    later = (int(message[-1]) - message) * records + np.tile(np.arange(records)[::-1], count)
    leave = now - STEP_NS * later
    along = (leave // STEP_NS + 7 * vehicle) % (2 * CELLS_ACROSS)
    x, y = corner_of_region(east)
    cell = grid.interleave(
        x + np.where(along < CELLS_ACROSS, along, 2 * CELLS_ACROSS - 1 - along),
        y + vehicle % CELLS_ACROSS,
    )
    columns["cell"] = cell
    columns["latitude"], columns["longitude"] = grid.centre(cell)
    columns["leave_time"] = leave
    columns["enter_time"] = leave - STEP_NS
    region = int(grid.region_of(cell[0]))
    out = []
    for number in range(count):
        part = slice(number * records, (number + 1) * records)
        seq, place = divmod(begin + number, vehicles)
        taken = {name: column[part] for name, column in columns.items()}
        batch = Batch(
            Kind.OBSERVATION,
            f"sim-{east}-{place:05}",
            1,
            region,
            seq + 1,
            seq + 1,
            taken,
            "aco-fckf",
        )
        key = keys.observation_key(region, batch.vehicle)
        out.append(Message(batch.kind, key, wire.encode(batch), wire.ENCODING[batch.kind]))
    return out


def _time_ingest(sent: list[Message], records: int) -> tuple[float, float]:
    with (
        tempfile.TemporaryDirectory() as folder,
        closing(Engine(ServiceConfig(), Path(folder))) as engine,
    ):
        turn = turn_of(sent)
        gc.collect()
        # The service also does this at its start. Otherwise the garbage collector would search the
        # benchmark's messages.
        gc.freeze()
        wall = time.perf_counter()
        cpu = time.process_time()
        for at in range(0, len(sent), turn):
            engine.intake.ingest(sent[at : at + turn], time.time_ns())
            engine.settlement.end_flush()
            if at % FLUSH >= FLUSH - turn:
                engine.settlement.begin_flush()
        engine.settlement.flush()
        wall = time.perf_counter() - wall
        cpu = time.process_time() - cpu
        gc.unfreeze()
        assert engine.counts.observations == len(sent) * records, engine.counts
    return len(sent) * records / wall, len(sent) * records / cpu
