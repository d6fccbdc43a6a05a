"""Source of simulated samples: a simulated fleet delivers blocks (samples of a short time) without
end. A recorder can store the true values.
"""

from __future__ import annotations

import time
from collections.abc import Iterator

from edge_agent.inputs.block import Block, to_utc_ns
from edge_agent.lab.simulation import SimulatedFleet
from edge_agent.lab.truth_file import TruthRecorder

BLOCK_S = 0.1  # [s] duration of a block: short compared with the second that a batch waits


def blocks(
    fleet: SimulatedFleet, rate_hz: float, recorder: TruthRecorder | None = None
) -> Iterator[Block]:
    """Yield blocks of simulated samples without end, each BLOCK_S [s] long. The first block begins
    at the current time of the computer's clock. The `recorder`, if given, stores the true friction
    of every block.
    """
    steps = max(1, round(BLOCK_S * rate_hz))
    start_ns = 0
    while True:
        t, signals = fleet.step(steps)
        # Take the time after the first step, which may have to compile its code.
        start_ns = start_ns or time.time_ns()
        block = Block(t, to_utc_ns(t, start_ns), signals)
        if recorder is not None:
            truth = fleet.truth
            position = fleet.scenario.origin.to_latlon(truth.x, truth.y)
            recorder.add(block.time, position, truth.yaw, truth.mu_wheel, truth.utilisation)
        yield block
