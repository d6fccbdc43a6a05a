"""Check of `fleet-service size`: memory of an engine (service without network) with 10⁴ and 10⁵
vehicles, compared with the calculator's estimate. Each engine runs in a separate process.
"""

from __future__ import annotations

import json
import subprocess
import sys
import tempfile
import time
from contextlib import closing
from pathlib import Path
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from fleet_service.app.engine import Engine
from fleet_service.app.sizing import MemoryContent, split_memory
from fleet_service.fusion.store.records import PAIRS
from fleet_service.ingest.inbox import Message
from schemas import grid, keys, mugrid, wire
from schemas.config import ServiceConfig
from schemas.runtime.figures import Figure
from schemas.thresholds import NS as SECOND
from schemas.wire import Batch, Kind
from tests.benchmarks.ingest import corner_of_region
from tests.benchmarks.measure import read_resident_bytes

VEHICLES: Final = {10_000: 8, 100_000: 3}  # messages per vehicle, by the number of vehicles
ROWS: Final = 10  # observations in a message
AREAS: Final = 10  # regions in which the vehicles drive
LANES: Final = 1500  # roads in a region
TURN: Final = 512
BAR: Final = 0.2


def sizing() -> list[Figure]:
    """Measure the memory of an engine (service without network) with 10⁴ and with 10⁵ vehicles.
    Return as figures the relative errors of the memory that `fleet-service size` calculates.
    """
    out = []
    for vehicles, messages in VEHICLES.items():
        command = [sys.executable, "-m", "tests.benchmarks.sizing", str(vehicles), str(messages)]
        done = subprocess.run(command, stdout=subprocess.PIPE, text=True, check=True)
        found = json.loads(done.stdout.splitlines()[-1])
        measured = found.pop("bytes")
        estimated = sum(split_memory(MemoryContent(**found)).values())
        content = ", ".join(f"{number} {name}" for name, number in found.items())
        unit = (
            f"of the measured memory; {measured / 1e6:.0f} MB measured, {estimated / 1e6:.0f} MB "
            f"estimated for {content}"
        )
        error = abs(estimated / measured - 1.0)
        out.append(Figure(f"scale.calculator_error.v{vehicles}", error, unit, BAR))
    return out


def main(vehicles: int, messages: int) -> None:
    """Let an engine (service without network) ingest `messages` messages from each of `vehicles`
    vehicles. Print one line of JSON with the numbers of vehicles, cells and other entries that its
    memory contains, and with the size of this memory [bytes].
    """
    with (
        tempfile.TemporaryDirectory() as folder,
        closing(Engine(ServiceConfig(), Path(folder))) as engine,
    ):
        begin = time.time_ns() - messages * ROWS * SECOND
        engine.intake.ingest([make_message(0, 0, AREAS, begin)], begin + ROWS * SECOND)
        engine.settlement.flush()
        before = read_resident_bytes()
        for number in range(messages):
            end = begin + (number + 1) * ROWS * SECOND
            for first in range(0, vehicles, TURN):
                some = range(first, min(first + TURN, vehicles))
                sent = [make_message(vehicle, number, vehicle % AREAS, end) for vehicle in some]
                engine.intake.ingest(sent, end)
            engine.settlement.flush()
        assert engine.counts.implausible_moves == 0, engine.counts
        store = engine.state.fusion.store
        content = MemoryContent(
            vehicles=store.vehicles,
            cells=store.size,
            pairs=int(store.state.used[PAIRS]) + len(store.state.settled),
            waiting=store.waiting,
        )
        print(json.dumps(content._asdict() | {"bytes": read_resident_bytes() - before}))


def make_message(vehicle: int, number: int, area: int, end: int) -> Message:
    """Return the message number `number` of a vehicle that drives straight east through the region
    number `area`, one cell per second.

    A message reports ROWS visits (passes through map cells), and the last visit ends at `end` [ns].
    The next message begins ROWS cells further east. One visit in seven measures the friction.
    """
    group, lane = divmod(vehicle // AREAS, LANES)
    x, y = corner_of_region(area)
    cell = grid.interleave(
        x + ROWS * (number + group) + np.arange(ROWS),
        np.full(ROWS, y + lane),
    )
    latitude, longitude = grid.centre(cell)
    leave = end - SECOND * np.arange(ROWS)[::-1]
    is_value = (vehicle + number + np.arange(ROWS)) % 7 == 0
    value = -0.5 * np.square((mugrid.CENTRES - 0.7) / 0.08)
    bound = np.where(mugrid.CENTRES < 0.2, -6.0, 0.0)
    columns: dict[str, NDArray[Any]] = {
        "enter_time": leave - SECOND,
        "leave_time": leave,
        "cell": cell,
        "sector": np.zeros(ROWS, np.int8),
        "latitude": latitude,
        "longitude": longitude,
        "position_std": np.ones(ROWS, np.float32),
        "yaw": np.zeros(ROWS, np.float32),
        "speed": np.full(ROWS, 10.0, np.float32),
        "mu_utilised": np.where(is_value, 0.6, 0.2).astype(np.float32),
        "log_likelihood": mugrid.encode_log_likelihood(np.where(is_value[:, None], value, bound)),
    }
    region = int(grid.region_of(cell[0]))
    name = f"sim-{area}-{vehicle}"
    batch = Batch(Kind.OBSERVATION, name, 1, region, number + 1, number + 1, columns)
    key = keys.observation_key(region, name)
    return Message(batch.kind, key, wire.encode(batch), wire.ENCODING[batch.kind])


if __name__ == "__main__":
    main(int(sys.argv[1]), int(sys.argv[2]))
