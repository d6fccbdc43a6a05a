"""Benchmark of growth: processor time of the engine (service without network) at rates from 10³ to
10⁵ observations per second.

A message has ten observations, and each vehicle sends one message per second, so a higher rate
means more vehicles. The engine ingests the messages of one second in portions. It then does the
other work of a second: it writes a segment (file of new rows), acknowledgements and map tiles. The
clock is simulated, so that rates above the machine's capacity can be measured. There is no network.
"""

from __future__ import annotations

import gc
import tempfile
import time
from contextlib import closing
from pathlib import Path
from typing import Final

import numpy as np

from fleet_service.app.engine import Engine
from fleet_service.fusion.constants import EPOCH_NS
from schemas.config import ServiceConfig
from schemas.runtime.figures import Figure
from tests.benchmarks.ingest import make_messages
from tests.changed_tiles import changed_tiles

# Observations per second, and the measured time [s] for each rate.
RATES: Final = {
    1_000: 24,
    10_000: 12,
    100_000: 6,
}
ROWS: Final = 10
TURN: Final = 512  # messages per pass; the service's worker takes the same number
# Short, so that the window is full and settling has its full cost from the beginning.
LATENESS_S: Final = 4.0
WARM_S: Final = 4
SECOND: Final = 10**9


def growth() -> list[Figure]:
    """Measure how much processor time an engine (service without network) needs for the messages of
    one second, at rates from 10³ to 10⁵ observations per second. Return the figures.
    """
    cost = {rate: second_s(rate, seconds) for rate, seconds in RATES.items()}
    slope = float(np.polyfit(np.log(list(cost)), np.log(list(cost.values())), 1)[0])
    costs = ", ".join(f"{1e6 * spent / rate:.1f} us at {rate}/s" for rate, spent in cost.items())
    return [
        Figure(
            "bench.growth.rate_exponent", slope, f"of the rate; an observation costs {costs}", 1.05
        )
    ]


def second_s(rate: int, seconds: int) -> float:
    """Return the mean processor time [s] that an engine (service without network) needs for one
    second of messages, at `rate` observations per second. It is measured over `seconds` seconds
    after a warm-up. In the middle of the measurement an epoch (minute of the fusion) ends, so the
    work at its end is included.
    """
    vehicles = rate // ROWS
    spent = 0.0
    begin = time.time_ns() // EPOCH_NS * EPOCH_NS - (WARM_S + seconds // 2) * SECOND
    config = ServiceConfig(lateness_s=LATENESS_S)
    with tempfile.TemporaryDirectory() as folder, closing(Engine(config, Path(folder))) as engine:
        gc.collect()
        gc.freeze()  # the service does this when it starts
        for second in range(WARM_S + seconds):
            now = begin + second * SECOND
            sent = make_messages(vehicles, ROWS, now, vehicles, second * vehicles)
            began = time.process_time()
            for at in range(0, len(sent), TURN):
                engine.intake.ingest(sent[at : at + TURN], now)
            engine.settlement.flush()
            changed_tiles(engine.queries, now)
            spent += time.process_time() - began if second >= WARM_S else 0.0
        assert engine.counts.observations == rate * (WARM_S + seconds), engine.counts
    return spent / seconds
