"""`fleet-service watch`: print tiles and alerts as they change."""

from __future__ import annotations

import argparse
import sys

from fleet_service.cli.common import add_connection, stop_on_signals


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the options."""
    parser.add_argument("--bbox", metavar="W,S,E,N", help="only tiles that touch this box")
    parser.add_argument("--alerts", action="store_true", help="only alerts: one per stretch, with length and direction")
    parser.add_argument("--json", action="store_true", help="print one JSON object per line")
    parser.add_argument("--webhook", metavar="URL", help="also send alerts there, in Alertmanager's format")
    add_connection(parser)


def run(arguments: argparse.Namespace) -> int:
    """Watch until a signal."""
    from fleet_service.client import map_client, watching
    from fleet_service.client.webhook import Webhook

    stop = stop_on_signals()
    wishes = watching.WatchOptions(arguments.bbox, only_alerts=arguments.alerts, as_json=arguments.json)
    settings = map_client.settings(arguments.connect, arguments.config)
    if arguments.webhook is None:
        watching.watch(settings, wishes, stop, _say)
        return 0
    hook = Webhook(arguments.webhook, lambda line: print(line, file=sys.stderr, flush=True))
    try:
        watching.watch(settings, wishes, stop, _say, hook.send)
    finally:
        hook.close()
    return 0


def _say(line: str) -> None:
    print(line, flush=True)
