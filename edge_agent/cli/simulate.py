"""`edge-agent simulate`: write the signal log of a manoeuvre."""

from __future__ import annotations

import argparse
import sys
from pathlib import Path

from edge_agent.cli.options import add_json, print_list
from schemas.runtime import commandline

SENSORS = ("ideal", "mems", "mems-leak", "mems-patchy", "rough", "rough-coarse", "rough-late")
ROADS = ("level", "rolling", "stepped", "banked", "hilly", "cobbled")


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the command-line arguments of `edge-agent simulate`."""
    parser.add_argument("manoeuvre", nargs="?", help="name of the manoeuvre; --list shows them")
    parser.add_argument("--list", action="store_true", help="list the manoeuvres and exit")
    add_json(parser, "the manoeuvres")
    parser.add_argument(
        "--mu", type=float, help="peak friction of the road (default: the manoeuvre's)"
    )
    parser.add_argument(
        "--speed",
        type=commandline.parse_positive,
        help="speed at the start [m/s] (default: the manoeuvre's)",
    )
    parser.add_argument(
        "--duration",
        type=commandline.parse_positive,
        help="duration [s] (default: the manoeuvre's)",
    )
    parser.add_argument(
        "--rate",
        type=commandline.parse_positive,
        default=100.0,
        help="samples per second (default 100)",
    )
    parser.add_argument("--seed", type=int, default=0, help="seed of the sensor errors (default 0)")
    parser.add_argument(
        "--sensors",
        choices=SENSORS,
        default="mems",
        help="sensor quality (default mems); rough: as in real cars",
    )
    parser.add_argument(
        "--no-torque", action="store_true", help="omit wheel torque, as most cars do"
    )
    parser.add_argument(
        "--road",
        choices=ROADS,
        default="level",
        help="road profile, drawn from the seed (default level)",
    )
    parser.add_argument(
        "--slope",
        type=float,
        default=0.0,
        help="additional slope, metres up per metre ahead (default 0)",
    )
    parser.add_argument("--out", type=Path, help="signal log to write (.parquet, .csv)")
    parser.add_argument("--vehicle-out", type=Path, help="vehicle file to write (JSON)")


def run(args: argparse.Namespace) -> int:
    """Simulate a manoeuvre and write its log, or list the manoeuvres; return 0."""
    from edge_agent.app.estimates_file import write_table
    from edge_agent.app.output_path import prepare_path
    from edge_agent.inputs.signal_log import conversion_command
    from edge_agent.lab.simulation import MANOEUVRES, DriveSetup, Fault, simulate_manoeuvre
    from schemas.errors import InputError
    from schemas.runtime.durable import write_durably

    if args.list:
        print_list(
            {name: manoeuvre.about for name, manoeuvre in MANOEUVRES.items()}, as_json=args.json
        )
        return 0
    if args.manoeuvre is None:
        raise InputError("manoeuvre", "is not given", "name one (--list shows them)")
    if args.out is None:
        raise InputError("out", "is not given", "name the log to write with --out")
    log, vehicle = simulate_manoeuvre(
        args.manoeuvre,
        mu=args.mu,
        speed=args.speed,
        seed=args.seed,
        duration_s=args.duration,
        setup=DriveSetup(
            rate_hz=args.rate,
            sensors=args.sensors,
            faults=(Fault("missing", "torque"),) if args.no_torque else (),
            road=args.road,
            slope=args.slope,
        ),
    )
    write_table("out", args.out, log)
    if args.vehicle_out is not None:
        text = vehicle.model_dump_json(indent=1, exclude_none=True) + "\n"
        write_durably(prepare_path("vehicle-out", args.vehicle_out, [args.out]), text)
    print(f"{args.out}: {log.num_rows} samples of {args.manoeuvre}")
    if args.out.suffix == ".csv":
        print(
            f"note: other commands read Parquet; convert it with {conversion_command(args.out)}",
            file=sys.stderr,
        )
    return 0
