"""`edge-agent fleet`: run simulated vehicles in real time with one estimator bank (filters advanced
together); each vehicle has its own name and Zenoh session.
"""

from __future__ import annotations

import argparse
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING

from edge_agent.cli.options import add_connection, add_estimator, config_of, memberships_of
from edge_agent.lab.options import add_simulated_fleet
from schemas.runtime import commandline

if TYPE_CHECKING:
    from schemas.wire.ahead import GripWarning


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the command-line arguments of `edge-agent fleet`."""
    parser.add_argument("--vehicles", type=int, default=36, help="number of vehicles (default 36)")
    add_simulated_fleet(parser)
    parser.add_argument(
        "--warned",
        type=float,
        default=0.0,
        help="share of vehicles that receive the map and are warned (default 0)",
    )
    add_estimator(parser)
    add_connection(parser)
    parser.add_argument(
        "--truth", type=Path, help="file for the true friction, one row per cell visit (Parquet)"
    )
    parser.add_argument(
        "--rate",
        type=commandline.parse_positive,
        default=100.0,
        help="samples per second (default 100)",
    )
    parser.add_argument("--seed", type=int, default=0, help="seed of the simulation (default 0)")
    parser.add_argument(
        "--duration",
        type=commandline.parse_positive,
        default=float("inf"),
        help="duration [s] (default: until stopped)",
    )


def run(args: argparse.Namespace) -> int:
    """Run the simulated fleet until the duration has passed or a signal (SIGTERM, Ctrl-C) arrives.
    Before the end, write a file with the vehicles' true motion and friction.

    Return the exit code.
    """
    from edge_agent.ahead.lookout import Lookout
    from edge_agent.app.agent import Agent, AgentOptions, AgentSource
    from edge_agent.app.output_path import prepare_path
    from edge_agent.cli.live import LookoutPart, make_warning_printer, warm_up_simulation
    from edge_agent.lab.simulation import SimulatedFleet
    from edge_agent.lab.simulation.blocks import blocks
    from edge_agent.lab.simulation.fleet import check_live_fleet
    from edge_agent.lab.simulation.listeners import WarnedDrivers
    from edge_agent.lab.truth_file import TruthRecorder

    check_live_fleet(args.vehicles)
    config = config_of(args)
    if args.truth:
        prepare_path("truth", args.truth)
    fleet = SimulatedFleet(
        args.scenario, args.vehicles, args.seed, args.rate, rough=args.rough, winter=args.winter
    )
    warm_up_simulation(args.scenario, args.rate, args.rough)
    recorder = TruthRecorder(tuple(fleet.names)) if args.truth else None
    source = blocks(fleet, args.rate, recorder)
    at_end = partial(recorder.write, args.truth) if recorder is not None else lambda: None
    drivers = WarnedDrivers(fleet, args.warned)
    parts = []
    if drivers.warned.any():
        show = make_warning_printer(config)

        def pass_warning(name: str, warning: GripWarning) -> None:
            show(name, warning)
            drivers.store_warning(name, warning)

        lookout = Lookout(fleet.names, pass_warning, drivers.route_of, drivers.is_warned)
        parts.append(LookoutPart(lookout))
        source = drivers.pass_warnings(source)
    options = AgentOptions(
        fleet.vehicles, fleet.names, config, args.estimator, memberships_of(args), args.duration
    )
    return Agent(options, AgentSource(source, end=at_end), parts).drive()
