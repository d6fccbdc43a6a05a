"""Simulate vehicles with the default estimator, and write their observations for the evaluation.

    python -m edge_agent.lab.end_to_end --out DIR [--vehicles 200] [--duration 60] [--seed 20000]
        [--scenario demo] [--rough 0] [--winter 0]

No network is used. The observations that the vehicles would send are written to
DIR/observations.parquet, and the true friction under them to DIR/truth.parquet.
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Sequence
from pathlib import Path

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq

from edge_agent.app.estimator_factory import bank_of
from edge_agent.inputs.block import Block, to_utc_ns
from edge_agent.lab.options import add_simulated_fleet
from edge_agent.lab.seeds import FIGURES
from edge_agent.lab.simulation import SimulatedFleet
from edge_agent.lab.truth_file import TruthRecorder
from edge_agent.observe.observation_builder import RecordBlock
from edge_agent.observe.pipeline import Pipeline
from schemas.config import AgentConfig
from schemas.thresholds import NS
from schemas.wire import Columns

RATE_HZ = 100.0  # [Hz] samples per second
BLOCK = 50  # [samples] length of a block
START_NS = 1_800_000_000 * NS  # [ns UTC] time of the first sample
REPORT_S = 30.0  # [s] simulated time between two progress lines


def drive_fleet(fleet: SimulatedFleet, duration_s: float, truth: Path) -> Columns:
    """Simulate a drive of the fleet for `duration_s` [s]. Return the columns of all observations
    that the vehicles would send, with the column `vehicle`. Write the true friction of each visit
    (passage of a map cell) to the file `truth`.
    """
    vehicles = len(fleet.vehicles)
    config = AgentConfig()
    pipeline = Pipeline(bank_of(config.estimator, fleet.vehicles), vehicles, config)
    recorder = TruthRecorder(tuple(fleet.names))
    parts: list[RecordBlock] = []
    for block in range(int(duration_s * RATE_HZ / BLOCK)):
        t, signals = fleet.step(BLOCK)
        samples = Block(t, to_utc_ns(t, START_NS), signals)
        true = fleet.truth
        position = fleet.scenario.origin.to_latlon(true.x, true.y)
        recorder.add(samples.time, position, true.yaw, true.mu_wheel, true.utilisation)
        parts.append(pipeline.step(samples)[1])
        if not block % int(REPORT_S * RATE_HZ / BLOCK):
            print(f"  {block * BLOCK / RATE_HZ:.0f} s driven", flush=True)
    last = pipeline.finish()
    parts += [last] if last is not None else []
    recorder.write(truth)
    columns = {
        name: np.concatenate([part.columns[name] for part in parts]) for name in parts[0].columns
    }
    return columns | {"vehicle": np.concatenate([part.vehicle for part in parts])}


def write_drive(fleet: SimulatedFleet, duration_s: float, folder: Path) -> None:
    """Simulate a drive of the fleet, and write the observations and the true friction as two files
    into an existing folder.
    """
    columns = drive_fleet(fleet, duration_s, folder / "truth.parquet")
    arrays = {
        name: pa.array(list(map(bytes, c)) if c.ndim == 2 else c) for name, c in columns.items()
    }
    pq.write_table(pa.table(arrays), folder / "observations.parquet")
    print(f"  {len(columns['cell'])} observations of {len(fleet.names)} vehicles", flush=True)


def main(argv: Sequence[str] | None = None) -> int:
    """Run the command line: simulate a drive of a fleet, and write the observations and the true
    friction.
    """
    parser = argparse.ArgumentParser(
        prog="edge_agent.lab.end_to_end", description=(__doc__ or "").splitlines()[0]
    )
    parser.add_argument(
        "--out", type=Path, required=True, help="folder for the two files; created if missing"
    )
    parser.add_argument(
        "--vehicles", type=int, default=200, help="number of vehicles (default %(default)s)"
    )
    parser.add_argument(
        "--duration",
        type=float,
        default=60.0,
        help="duration of the drive [s] (default %(default)s)",
    )
    parser.add_argument(
        "--seed", type=int, default=FIGURES, help="seed of the simulation (default %(default)s)"
    )
    add_simulated_fleet(parser)
    args = parser.parse_args(argv)
    args.out.mkdir(parents=True, exist_ok=True)
    fleet = SimulatedFleet(
        args.scenario, args.vehicles, args.seed, RATE_HZ, rough=args.rough, winter=args.winter
    )
    write_drive(fleet, args.duration, args.out)
    return 0


if __name__ == "__main__":
    sys.exit(main())
