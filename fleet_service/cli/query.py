"""`fleet-service query`: the map asked once."""

from __future__ import annotations

import argparse
from pathlib import Path

from fleet_service.cli.common import add_connection


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the options."""
    parser.add_argument("--bbox", metavar="W,S,E,N", help="degrees; without it, everything")
    parser.add_argument("--route", metavar="LON,LAT|LON,LAT", help="the cells ahead, in their order")
    parser.add_argument("--min-vehicles", metavar="K", help="only cells of K vehicles or more")
    parser.add_argument("--at", metavar="TIME", help="the map as it was, e.g. 2026-01-31T07:00:00Z; UTC without a zone")
    parser.add_argument("--basis", metavar="borrowed", help="also cells that only neighbours speak for")
    parser.add_argument("--format", metavar="arrow|geojson|json", help="arrow (default) prints a table")
    parser.add_argument("--out", metavar="FILE", type=Path, help="write the answer there")
    add_connection(parser)


def run(arguments: argparse.Namespace) -> int:
    """Ask, and print or write the answer."""
    from fleet_service.client import map_client

    asked = {name: getattr(arguments, name) for name in ("bbox", "route", "min_vehicles", "at", "basis", "format")}
    parameters = {name: value for name, value in asked.items() if value is not None}
    answer = map_client.ask(map_client.settings(arguments.connect, arguments.config), parameters)
    if arguments.out is not None:
        map_client.write(answer, arguments.out)
    else:
        print(map_client.text(answer))
    return 0
