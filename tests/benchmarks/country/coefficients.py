"""Memory cost of a service per vehicle, per cell, and per pair of cell and vehicle, measured with
an engine (service without network) in a separate process.

Each run ingests the same number of observations, in messages that differ only in the varied
quantity. Therefore the memory that the service keeps for late observations has the same size in all
runs.
"""

from __future__ import annotations

import subprocess
import sys
import tempfile
import time
from contextlib import closing
from pathlib import Path
from typing import Final, NamedTuple

import numpy as np

from fleet_service.app.engine import Engine
from fleet_service.fusion import Fusion
from fleet_service.fusion.constants import FORGOTTEN_EVERY_S
from fleet_service.ingest.inbox import Message
from schemas.config import ServiceConfig
from tests.benchmarks.full_map import SECOND, START, make_visits
from tests.benchmarks.ingest import make_messages
from tests.benchmarks.measure import SEED, read_resident_bytes

MANY: Final = 40_000  # messages in each measured part
ROWS: Final = 10
FEW: Final = 400  # vehicles in the parts in which the number of vehicles must not matter
REGIONS: Final = 10  # regions over which many cells are spread
TURN: Final = 512


class Coefficients(NamedTuple):
    """Memory that a service needs per vehicle, per cell, and per pair of cell and vehicle
    [bytes].
    """

    vehicle_bytes: float
    cell_bytes: float
    # Memory of a pair: a vehicle and a cell's sector that it visited in the last three to four
    # hours.
    pair_bytes: float


def measure_coefficients() -> Coefficients:
    """Measure the memory cost of a service per vehicle, per cell, and per combination of both;
    return these coefficients.
    """
    few, vehicles, cells = (_measure_growth(kind) for kind in ("few", "vehicles", "cells"))
    return Coefficients(
        (vehicles[0] - few[0]) / (MANY - FEW), (cells[0] - few[0]) / (cells[1] - few[1]), few[2]
    )


def _measure_growth(kind: str) -> tuple[float, float, float]:
    """Run this module in a new process with the stream of messages called `kind`. Return three
    numbers: by how many bytes the memory of a service grew, the number of map cells at the end, and
    the mean size [bytes] of an entry in the table of (cell, vehicle) pairs.
    """
    command = [sys.executable, "-m", "tests.benchmarks.country.coefficients", kind]
    done = subprocess.run(command, stdout=subprocess.PIPE, text=True, check=True)
    grown, cells, pair = done.stdout.split()[-3:]
    return float(grown), float(cells), float(pair)


def _make_stream(kind: str) -> list[Message]:
    now = time.time_ns()
    if kind == "cells":
        parts = (
            make_messages(MANY // REGIONS, ROWS, now, FEW // REGIONS, 0, east)
            for east in range(REGIONS)
        )
        return [message for part in parts for message in part]
    return make_messages(MANY, ROWS, now, MANY if kind == "vehicles" else FEW)


def main(kind: str) -> None:
    """Let a service ingest simulated messages of the given kind. Print by how many bytes the memory
    of its process has grown, the number of map cells, and the mean size [bytes] of a (cell,
    vehicle) pair.
    """
    sent = _make_stream(kind)
    with (
        tempfile.TemporaryDirectory() as folder,
        closing(Engine(ServiceConfig(), Path(folder))) as engine,
    ):
        warm = make_messages(FEW, ROWS, time.time_ns(), FEW, 0, REGIONS)
        engine.intake.ingest(warm, time.time_ns())
        engine.settlement.flush()
        before = read_resident_bytes()
        for at in range(0, len(sent), TURN):
            engine.intake.ingest(sent[at : at + TURN], time.time_ns())
            if at % (16 * TURN) == 0:
                engine.settlement.flush()
        engine.settlement.flush()
        assert engine.counts.observations == (MANY + FEW) * ROWS, engine.counts
        grown = read_resident_bytes() - before
        fusion = engine.state.fusion
        print(grown, fusion.size, _measure_pair(fusion))


def _measure_pair(fusion: Fusion) -> float:
    """Return the mean size [bytes] of an entry in the sorted table of (cell, vehicle) pairs.

    The map moves a pair into this table only when the map's time has advanced far enough after the
    visit. The function therefore first adds one visit at a later time, so that the map moves all
    earlier visits.
    """
    later_s = (fusion.next_epoch - START) / SECOND + FORGOTTEN_EVERY_S
    fusion.update(make_visits(np.random.default_rng(SEED), 1, 1, later_s, 1.0))
    state = fusion.store.state
    arrays = (state.settled, state.settled_keys, state.settled_std)
    return sum(array.nbytes for array in arrays) / len(state.settled)


if __name__ == "__main__":
    main(sys.argv[1])
