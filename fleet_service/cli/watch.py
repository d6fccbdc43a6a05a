"""`fleet-service watch`: tiles and alerts as they change."""

from __future__ import annotations

import argparse

from fleet_service.cli.common import add_connection, stop_on_signals


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the options."""
    parser.add_argument("--bbox", metavar="W,S,E,N", help="only tiles that touch this box")
    add_connection(parser)


def run(arguments: argparse.Namespace) -> int:
    """Watch until a signal."""
    from fleet_service.client import map_client

    stop = stop_on_signals()
    map_client.watch(
        map_client.settings(arguments.connect, arguments.config), arguments.bbox, stop, lambda s: print(s, flush=True)
    )
    return 0
