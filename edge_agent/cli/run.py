"""`edge-agent run`: run one vehicle live; signals come from its buses, a simulation, or a log
replayed in real time.
"""

from __future__ import annotations

import argparse
import sys
import time
from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING

from edge_agent.cli.options import add_connection, add_estimator, config_of, memberships_of
from schemas.runtime import commandline, progress_messages

if TYPE_CHECKING:
    from edge_agent.ahead.lookout import Lookout
    from edge_agent.app.agent import AgentOptions, AgentPart
    from edge_agent.inputs.block import Block
    from edge_agent.publish.vss import RoadFrictionOutput
    from schemas.config import AgentConfig
    from schemas.vehicle import Vehicle

SIMULATED = "simulated"
# Samples per block of a replayed log: a tenth of a second at 100 Hz.
LIVE_ROWS = 10


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the command-line arguments of `edge-agent run`."""
    _add_source_arguments(parser)
    _add_output_arguments(parser)
    parser.add_argument(
        "--vehicle", type=Path, help="vehicle file (JSON); required except for simulated"
    )
    add_estimator(parser)
    parser.add_argument("--name", help="name to publish under (default: the vehicle's)")
    add_connection(parser)
    parser.add_argument(
        "--scenario", default="demo", help="scenario of the simulated vehicle (default demo)"
    )
    parser.add_argument(
        "--rate",
        type=commandline.parse_positive,
        default=100.0,
        help="samples per second of the simulation (default 100)",
    )
    parser.add_argument("--seed", type=int, default=0, help="seed of the simulation (default 0)")
    parser.add_argument(
        "--duration",
        type=commandline.parse_positive,
        default=float("inf"),
        help="duration [s] (default: until stopped or the end of the log)",
    )


def _add_source_arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument(
        "--source",
        action="append",
        help="'simulated' (default), a signal log (Parquet), or live sources (repeat the option "
        "for each): can:INTERFACE/CHANNEL, ros2:ENDPOINT, vss:HOST:PORT, gpsd:HOST:PORT, or "
        "NAME:ADDRESS of your own plug-in",
    )
    parser.add_argument(
        "--profile", help="profile that maps live signals to channels: a file, or a shipped one"
    )
    parser.add_argument("--dbc", type=Path, help="CAN database (default: the profile's)")
    parser.add_argument(
        "--trust",
        action="store_true",
        help="publish signals that did not pass the signal doctor, which checks a log and live "
        "sources; no effect on a simulated vehicle and on plug-ins, which are not checked",
    )


def _add_output_arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument(
        "--ahead", action="store_true", help="receive the map and warn of slippery road ahead"
    )
    parser.add_argument(
        "--autoware",
        metavar="ENDPOINT",
        help="with --ahead: Zenoh router of an Autoware planner that receives speed limits",
    )
    parser.add_argument(
        "--autoware-hash",
        metavar="RIHS01_…",
        help="type hash of VelocityLimit in that planner's version",
    )
    parser.add_argument("--route", type=Path, help="route for --ahead (GPX or GeoJSON)")
    parser.add_argument(
        "--vss",
        action="store_true",
        help="report the friction as VSS signals, one line of JSON each",
    )
    parser.add_argument(
        "--kuksa",
        metavar="HOST:PORT",
        help="write the friction to a Kuksa databroker; ?ca=FILE&token=FILE as in --source vss:",
    )


def run(args: argparse.Namespace) -> int:
    """Run the agent until the source of samples ends, the duration has passed, or a signal
    (SIGTERM, Ctrl-C) arrives; return the exit code.
    """
    config = config_of(args)
    _check_options(args)
    with progress_messages.show_status("loading"):
        from edge_agent.app.native_library import use_agent_library

        use_agent_library()
        from edge_agent.app.agent import Agent, AgentSource
        from edge_agent.cli.common import checked_name
        from edge_agent.inputs.live.sources import is_live
        from schemas.errors import InputError

    sources = args.source or [SIMULATED]
    if all(is_live(source) for source in sources):
        return _run_live(args, sources, config)
    if len(sources) > 1:
        raise InputError(
            "source",
            f"{', '.join(sources)} cannot be combined",
            "give live sources only, or one log",
        )
    vehicle, name, blocks = _open_source(args, sources[0])
    options = _agent_options(args, vehicle, checked_name(name), config)
    return Agent(options, AgentSource(blocks), _make_parts(args, name, config)).drive()


def _check_options(args: argparse.Namespace) -> None:
    """Raise an InputError if an option is given without the option that it needs, or the name is
    invalid.
    """
    from edge_agent.cli.common import checked_name
    from schemas.errors import InputError

    if args.name is not None:
        checked_name(args.name)
    if args.route is not None and not args.ahead:
        raise InputError("route", "needs --ahead", "give both, or neither")
    if args.autoware is not None and not args.ahead:
        raise InputError("autoware", "needs --ahead", "give both, or neither")
    if args.autoware_hash is not None and args.autoware is None:
        raise InputError("autoware-hash", "needs --autoware", "give both, or neither")


def _open_source(args: argparse.Namespace, source: str) -> tuple[Vehicle, str, Iterator[Block]]:
    """Open a source that is not live: a plug-in, the simulation, or a log. Return the vehicle, the
    name to publish under, and the blocks of samples.
    """
    from edge_agent.inputs.live.sources import KINDS
    from schemas.errors import InputError
    from schemas.runtime import plugins
    from schemas.vehicle import load_vehicle

    kind, _, address = source.partition(":")
    others = plugins.entry_points_of(plugins.SOURCES)
    if kind in others:
        vehicle = load_vehicle(_vehicle_file(args))
        blocks = plugins.load_entry_point(plugins.SOURCES, kind)(address)
        return vehicle, args.name or vehicle.name, blocks
    if kind == SIMULATED:
        return _simulated_source(args)
    if Path(source).exists():
        return _log_source(args, Path(source))
    known = ", ".join(sorted([SIMULATED, *KINDS, *others]))
    raise InputError(
        "source",
        f"{source!r} is not a file, and {kind!r} is not a kind of source",
        f"kinds are {known}",
    )


def _agent_options(
    args: argparse.Namespace, vehicle: Vehicle, name: str, config: AgentConfig
) -> AgentOptions:
    from edge_agent.app.agent import AgentOptions

    return AgentOptions(
        [vehicle], [name], config, args.estimator, memberships_of(args), args.duration
    )


def _make_parts(args: argparse.Namespace, name: str, config: AgentConfig) -> list[AgentPart]:
    from edge_agent.cli.live import LookoutPart, VssPart

    parts: list[AgentPart] = []
    if (lookout := _make_lookout(args, name, config)) is not None:
        parts.append(LookoutPart(lookout))
    if (output := _make_vss_output(args, name, config)) is not None:
        parts.append(VssPart(output))
    return parts


def _make_lookout(args: argparse.Namespace, name: str, config: AgentConfig) -> Lookout | None:
    if not args.ahead:
        return None
    from edge_agent.ahead.lookout import Lookout
    from edge_agent.ahead.route_file import read_route
    from edge_agent.cli.live import make_warning_printer

    route = read_route(args.route) if args.route is not None else None
    if args.autoware is None:
        return Lookout([name], make_warning_printer(config), lambda _: route)
    from edge_agent.ahead.planner import ANY_HASH
    from edge_agent.ahead.planner_link import PlannerLink

    planner = PlannerLink(args.autoware, args.autoware_hash or ANY_HASH)
    return Lookout(
        [name], make_warning_printer(config), lambda _: route, on_horizons=planner.receive_horizons
    )


def _make_vss_output(
    args: argparse.Namespace, name: str, config: AgentConfig
) -> RoadFrictionOutput | None:
    if not args.vss and args.kuksa is None:
        return None
    from edge_agent.publish.vss import RoadFrictionOutput
    from schemas.runtime.logs import print_line

    def print_signal(line: str) -> None:
        if args.vss:
            print_line(line, sys.stdout)

    if args.kuksa is None:
        return RoadFrictionOutput([name], print_signal, config.state_rate_hz)
    from edge_agent.app.kuksa_provider import KuksaProvider

    provider = KuksaProvider(args.kuksa)
    return RoadFrictionOutput([name], print_signal, config.state_rate_hz, provider)


def _run_live(args: argparse.Namespace, sources: list[str], config: AgentConfig) -> int:
    from edge_agent.app.agent import Agent, AgentSource
    from edge_agent.app.publishing import hanging_thread
    from edge_agent.app.trip import Trip, state_path_for
    from edge_agent.cli.common import checked_name
    from edge_agent.inputs.live.rows import LiveRows
    from edge_agent.inputs.live.sources import open_sources
    from schemas.vehicle import load_vehicle

    vehicle = load_vehicle(_vehicle_file(args))
    name = checked_name(args.name or vehicle.name)
    feeds, profile, clock = open_sources(sources, args.profile, args.dbc)
    rows = LiveRows(feeds, profile, vehicle, clock)
    trip = Trip(vehicle, profile, state_path_for(config.spool_of(name), name), trusted=args.trust)
    blocks = trip.corrected_blocks(rows.blocks(), lambda: rows.ground)
    try:
        source = AgentSource(
            blocks,
            trip.is_admitted,
            lambda: [*rows.health_problems(), *trip.health_problems()],
            trip.learn_rest,
            clock.now,
        )
        options = _agent_options(args, trip.vehicle, name, config)
        return Agent(options, source, _make_parts(args, name, config)).drive()
    finally:
        blocks.close()
        trip.close()
        if any(feed.is_listening for feed in feeds):
            hanging_thread.set()


def _vehicle_file(args: argparse.Namespace) -> Path:
    from schemas.errors import InputError

    if args.vehicle is None:
        raise InputError("vehicle", "is not given", "name the vehicle file with --vehicle")
    return Path(args.vehicle)


def _simulated_source(args: argparse.Namespace) -> tuple[Vehicle, str, Iterator[Block]]:
    from edge_agent.cli.live import warm_up_simulation
    from edge_agent.lab.simulation import SimulatedFleet
    from edge_agent.lab.simulation.blocks import blocks

    fleet = SimulatedFleet(args.scenario, 1, args.seed, args.rate)
    warm_up_simulation(args.scenario, args.rate)
    return fleet.vehicles[0], args.name or fleet.names[0], blocks(fleet, args.rate)


def _log_source(args: argparse.Namespace, source: Path) -> tuple[Vehicle, str, Iterator[Block]]:
    from edge_agent.cli.common import require_valid_signals
    from edge_agent.inputs.doctor.adopt import prepare_log
    from edge_agent.inputs.signal_log import read_log
    from schemas.thresholds import NS
    from schemas.vehicle import load_vehicle

    vehicle = load_vehicle(_vehicle_file(args))
    log, vehicle, diagnosis, _ = prepare_log(read_log(source), vehicle)
    if not args.trust:
        require_valid_signals(diagnosis)
    first_ns = time.time_ns() - round(float(log.t[0]) * NS)
    return vehicle, args.name or vehicle.name, log.blocks(first_ns, LIVE_ROWS)
