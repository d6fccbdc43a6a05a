"""`fleet-service watch`: print changed tiles and alerts as they arrive."""

from __future__ import annotations

import argparse
import sys
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING

from fleet_service.cli.common import add_connection, stop_on_signals
from schemas.errors import InputError
from schemas.runtime import commandline

if TYPE_CHECKING:
    from fleet_service.client.stretches import StretchAlert


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the options of `fleet-service watch`."""
    parser.add_argument("--bbox", metavar="W,S,E,N", help="only tiles that touch this box")
    parser.add_argument(
        "--alerts",
        action="store_true",
        help="print only alerts: one per stretch, with length and direction",
    )
    parser.add_argument("--json", action="store_true", help="print one JSON object per line")
    parser.add_argument(
        "--webhook",
        metavar="URL",
        help="URL to which alerts are also sent, in Alertmanager's format",
    )
    parser.add_argument(
        "--webhook-queue",
        metavar="FILE",
        type=Path,
        help="file for alerts that wait for the receiver (default: in the user's state folder)",
    )
    parser.add_argument(
        "--health-port",
        metavar="PORT",
        type=commandline.parse_port,
        help="serve /healthz and /metrics of the webhook on loopback",
    )
    add_connection(parser)


def run(arguments: argparse.Namespace) -> int:
    """Watch the map and print its changes until a signal arrives."""
    from fleet_service.client import map_client, watching

    stop = stop_on_signals()
    options = watching.WatchOptions(
        arguments.bbox, only_alerts=arguments.alerts, as_json=arguments.json
    )
    settings = map_client.connection_settings(arguments.connect, arguments.config)
    if arguments.webhook is None:
        for name in ("webhook_queue", "health_port"):
            if getattr(arguments, name) is not None:
                raise InputError(name, "needs a webhook", "add --webhook URL")
        watching.watch_map(settings, options, stop, _print_line)
        return 0
    return _watch_with_webhook(
        arguments,
        lambda on_alert: watching.watch_map(settings, options, stop, _print_line, on_alert),
    )


def _watch_with_webhook(
    arguments: argparse.Namespace, watch: Callable[[Callable[[StretchAlert], None]], None]
) -> int:
    """Watch the map and send alerts to a webhook. Return 1 if an alert was lost or could not be
    delivered, else 0.
    """
    from fleet_service.client.alert_queue import AlertQueue
    from fleet_service.client.webhook import Webhook, check_url, queue_path
    from schemas.runtime.metrics import serve_metrics

    check_url(arguments.webhook)
    queue = AlertQueue(arguments.webhook_queue or queue_path(arguments.webhook))
    hook = Webhook(arguments.webhook, lambda line: print(line, file=sys.stderr, flush=True), queue)
    try:
        with serve_metrics(
            "127.0.0.1", arguments.health_port, hook.metrics, hook.health_problems, "health_port"
        ):
            watch(hook.send)
    finally:
        hook.close()
    return 1 if hook.lost_count or hook.waiting_count else 0


def _print_line(line: str) -> None:
    print(line, flush=True)
