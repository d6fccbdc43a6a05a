"""`fleet-service hand-over`: move a region from its service to a standby (a waiting service)."""

from __future__ import annotations

import argparse
import re

from fleet_service.cli.common import add_connection


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the options of `fleet-service hand-over`."""
    parser.add_argument("region", metavar="REGION", help="region key expression, e.g. 1202/310/*")
    parser.add_argument(
        "--to", metavar="NAME", required=True, help="name of the standby that takes over"
    )
    add_connection(parser)


def run(arguments: argparse.Namespace) -> int:
    """Hand the region over to the standby, and print how long no service served it."""
    from fleet_service.client import map_client
    from fleet_service.shards.handover import hand_over
    from schemas.config import REGION_PATTERN
    from schemas.errors import InputError

    if not re.fullmatch(REGION_PATTERN, arguments.region):
        raise InputError(
            "region",
            f"{arguments.region!r} is not a region",
            "give chunks of 4, 3 and 3 digits, or * for all",
        )
    with map_client.open_connected(
        map_client.connection_settings(arguments.connect, arguments.config)
    ) as session:
        moved = hand_over(session, arguments.region, arguments.to, print)
    if moved is None:
        print(f"{arguments.to} already serves {arguments.region}")
    else:
        print(f"{arguments.to} serves {arguments.region}; the handover took {moved.pause_s:.1f} s")
    return 0
