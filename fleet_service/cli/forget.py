"""`fleet-service forget`: a vehicle, or a month of all; not while the service runs, which remembers more than files."""

from __future__ import annotations

import argparse

from fleet_service.cli.common import add_archive, on_archive


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the options."""
    add_archive(parser)
    parser.add_argument("--period", metavar="MONTH", required=True, help="e.g. 2026-01")
    parser.add_argument("--vehicle", metavar="NAME", help="only this vehicle; its rows are removed")


def run(arguments: argparse.Namespace) -> int:
    """Run the command on its archive."""
    return on_archive(arguments, _forget)


def _forget(arguments: argparse.Namespace) -> str:
    from fleet_service.archive.retention import forget_period, forget_vehicle

    if arguments.vehicle is None:
        forget_period(arguments.archive, arguments.period)
        return f"the key of {arguments.period} is destroyed"
    return f"{forget_vehicle(arguments.archive, arguments.vehicle, arguments.period)} rows removed"
