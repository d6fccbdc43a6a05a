"""`edge-agent run`: one vehicle, live; its signals are simulated or a log paced in real time."""

from __future__ import annotations

import argparse
import time
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from edge_agent.inputs.block import Block
    from schemas.vehicle import Vehicle

SIMULATED = "simulated"
LIVE_ROWS = 10  # of a replayed log per block: a tenth of a second at 100 Hz


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the options."""
    parser.add_argument("--source", default=SIMULATED, help="'simulated' (default) or a signal log (Parquet)")
    parser.add_argument("--trust", action="store_true", help="publish a log that the signal doctor did not pass")
    parser.add_argument("--vehicle", type=Path, help="vehicle file (JSON); needed with a log")
    parser.add_argument("--estimator", help="estimator by name (default: the configuration's)")
    parser.add_argument("--name", help="name to publish under (default: the vehicle's)")
    parser.add_argument("--config", type=Path, help="agent configuration (JSON)")
    parser.add_argument("--scenario", default="demo", help="where the simulated vehicle drives (default demo)")
    parser.add_argument("--rate", type=float, default=100.0, help="samples per second of the simulation")
    parser.add_argument("--seed", type=int, default=0, help="of the simulation")
    parser.add_argument("--duration", type=float, default=float("inf"), help="[s]; else until stopped or the log ends")


def run(args: argparse.Namespace) -> int:
    """Drive until the source ends, the duration has passed, or a signal comes."""
    from edge_agent.cli.common import checked_name
    from edge_agent.cli.live import drive_live
    from schemas.config import AgentConfig, load

    config = load(args.config, AgentConfig)
    vehicle, name, blocks = _simulated(args) if args.source == SIMULATED else _logged(args)
    return drive_live([vehicle], [checked_name(name)], blocks, config, args.estimator, args.duration)


def _simulated(args: argparse.Namespace) -> tuple[Vehicle, str, Iterator[Block]]:
    from edge_agent.lab.simulation import SimulatedFleet
    from edge_agent.lab.simulation.blocks import blocks

    fleet = SimulatedFleet(args.scenario, 1, args.seed, args.rate)
    return fleet.vehicles[0], args.name or fleet.names[0], blocks(fleet, args.rate)


def _logged(args: argparse.Namespace) -> tuple[Vehicle, str, Iterator[Block]]:
    from edge_agent.cli.common import insist_on_sound
    from edge_agent.inputs.correct import corrected
    from edge_agent.inputs.signal_log import read_log
    from schemas.errors import InputError
    from schemas.thresholds import NS
    from schemas.vehicle import load_vehicle

    if args.vehicle is None:
        raise InputError("vehicle", "is not given", "name the vehicle file of the log with --vehicle")
    vehicle = load_vehicle(args.vehicle)
    log = read_log(Path(args.source))
    log = replace(log, signals=corrected(log.signals, vehicle))
    if not args.trust:
        insist_on_sound(log, vehicle)
    first_ns = time.time_ns() - round(float(log.t[0]) * NS)
    return vehicle, args.name or vehicle.name, log.blocks(first_ns, LIVE_ROWS)
