"""`fleet-service cits`: exchange hazard messages with cooperative ITS until a signal arrives.

Alerts are sent as DENM (Decentralized Environmental Notification Messages) to an AMQP 1.0 server
("interchange"). DENM from others count as reports of one vehicle. Messages are not signed here; the
operator's own gateway must sign them.
"""

from __future__ import annotations

import argparse
from pathlib import Path

from fleet_service.cli.common import add_connection, stop_on_signals
from schemas.errors import InputError


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the options of `fleet-service cits`."""
    add_connection(parser)
    parser.add_argument(
        "--amqp", metavar="URL", required=True, help="interchange, e.g. amqps://host:5671"
    )
    parser.add_argument(
        "--to",
        metavar="ADDRESS",
        help="address to which our DENM are sent, e.g. a queue of deliveries",
    )
    parser.add_argument(
        "--from",
        dest="source",
        metavar="ADDRESS",
        help="address from which foreign DENM are received",
    )
    parser.add_argument(
        "--selector",
        default="messageType = 'DENM'",
        help="filter for foreign messages, an AMQP selector",
    )
    parser.add_argument(
        "--witness", metavar="NAME", help="name of foreign DENM in the map; enrolled like a vehicle"
    )
    parser.add_argument(
        "--station", metavar="N", type=int, help="identifier of the originating station"
    )
    parser.add_argument("--country", metavar="CC", help="country of the publisher, e.g. SE")
    parser.add_argument(
        "--publisher",
        metavar="ID",
        help="identifier of the publisher at the interchange, e.g. SE00001",
    )
    parser.add_argument(
        "--state",
        metavar="FILE",
        type=Path,
        help="file for open events and unsent messages; keep it between runs",
    )


def run(arguments: argparse.Namespace) -> int:
    """Send and receive DENM (hazard messages) until a signal arrives."""
    from fleet_service.client.cits import gateway
    from fleet_service.client.cits.properties import Originator
    from fleet_service.client.map_client import connection_settings

    if arguments.to is None and arguments.source is None:
        raise InputError("to", "there is nothing to send or receive", "give --to, --from or both")
    needed = {"to": ("station", "country", "publisher", "state"), "source": ("witness",)}
    for way, names in needed.items():
        missing = [
            name
            for name in names
            if getattr(arguments, way) is not None and getattr(arguments, name) is None
        ]
        if missing:
            raise InputError(missing[0], "is missing", f"give --{missing[0]}")
    sending = None
    if arguments.to is not None:
        originator = Originator(arguments.country, arguments.publisher)
        sending = gateway.Sending(arguments.to, arguments.station, originator, arguments.state)
    receiving = None
    if arguments.source is not None:
        receiving = gateway.Receiving(arguments.source, arguments.selector, arguments.witness)
    connection = connection_settings(arguments.connect, arguments.config)
    gateway.run_gateway(connection, arguments.amqp, sending, receiving, stop_on_signals())
    return 0
