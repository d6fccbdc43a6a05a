"""`fleet-service`: the command line program. Its commands are run, query, watch, page, router,
size, hand-over, compact, retention, forget, export, roads, analyze, rebuild, certs, evaluate,
completion.

Bad input is reported as one line on stderr, "error: field: problem; fix", with exit code 2. Modules
are imported only when a command needs them, so that help is fast.
"""

from __future__ import annotations

import logging
import sys
from collections.abc import Sequence
from contextlib import nullcontext
from typing import Final

from fleet_service.app import UNUSED
from schemas.runtime import commandline, progress_messages
from schemas.runtime.commandline import Command

LIVE: Final = ("run", "watch", "page", "cits", "router")  # commands that run until a signal arrives

COMMANDS: Final = (
    Command(
        "run",
        "fleet_service.cli.run",
        "run the service: receive observations, serve the map, keep the archive",
        "fleet-service run --archive archive --config service.json",
    ),
    Command(
        "query",
        "fleet_service.cli.query",
        "query the map of the fleet once",
        "fleet-service query --bbox -0.5,51.2,0.3,51.7 --out map.geojson",
    ),
    Command(
        "watch",
        "fleet_service.cli.watch",
        "print tiles and alerts as they change, until Ctrl-C",
        "fleet-service watch --bbox 11.9,57.6,12.1,57.8",
    ),
    Command(
        "page",
        "fleet_service.cli.page",
        "serve the live map for browsers: now, alerts, the past, routes",
        "fleet-service page --connect tcp/127.0.0.1:7447 --archive archive",
    ),
    Command(
        "cits",
        "fleet_service.cli.cits",
        "send alerts as DENM to an AMQP interchange, and receive foreign DENM",
        "fleet-service cits --amqp amqps://host:5671 --from subscriptions --witness cits-se",
    ),
    Command(
        "router",
        "deploy.router",
        "run a Zenoh router until a signal; the same as `gripmap router`",
        "fleet-service router --listen tcp/127.0.0.1:7447",
    ),
    Command(
        "size",
        "fleet_service.cli.size",
        "estimate cores, memory, disk and network for a fleet",
        "fleet-service size --vehicles 1e6 --road-km 200000",
    ),
    Command(
        "hand-over",
        "fleet_service.cli.hand_over",
        "move a region to a standby while it runs",
        "fleet-service hand-over 1202/310/* --to north-b",
    ),
    Command(
        "compact",
        "fleet_service.cli.compact",
        "sort the log into files by date and zone, and compute roll-ups",
        "fleet-service compact --archive archive",
    ),
    Command(
        "retention",
        "fleet_service.cli.retention",
        "remove old raw rows; their roll-ups stay",
        "fleet-service retention --archive archive --raw-days 92 --dry-run",
    ),
    Command(
        "forget",
        "fleet_service.cli.forget",
        "destroy the key of a month, or remove one vehicle's rows of it",
        "fleet-service forget --archive archive --period 2026-01 --vehicle car-one --dry-run",
    ),
    Command(
        "export",
        "fleet_service.cli.export",
        "write a part of the archive as GeoParquet, GeoJSON or CSV",
        "fleet-service export map --archive archive --out map.parquet",
    ),
    Command(
        "roads",
        "fleet_service.cli.roads",
        "assign cells to links of a road network, for analyze contract",
        "fleet-service roads city.osm.pbf --out roads.parquet",
    ),
    Command(
        "analyze",
        "fleet_service.cli.analyze",
        "analyse the archive: grip, worst, spells, before-after, trend, vehicles, calibration, "
        "weather, change-rates, contract, replay",
        "fleet-service analyze worst --archive archive --from 2026-01-01 --out worst.html",
    ),
    Command(
        "rebuild",
        "fleet_service.cli.rebuild",
        "compute map and roll-ups again from raw observations, here or on Spark",
        "fleet-service rebuild --archive archive --out rebuilt --engine spark",
    ),
    Command(
        "certs",
        "fleet_service.cli.certs",
        "create certificates and router configurations for everyone on a list",
        "fleet-service certs --fleet fleet.json --out certs",
    ),
    Command(
        "evaluate",
        "fleet_service.cli.evaluate",
        "evaluate the fusion on simulated fleets: compare it with the truth and with simple rules",
        "fleet-service evaluate --quick --out evaluation",
    ),
    Command(
        "completion",
        "fleet_service.cli.completion",
        "print the completion script for a shell",
        "fleet-service completion bash > ~/.local/share/bash-completion/completions/fleet-service",
    ),
)
LINE: Final = (
    "fleet-service",
    "Fuse the reports of many vehicles into one live map of grip.",
    COMMANDS,
)


def main(argv: Sequence[str] | None = None) -> int:
    """Run the `fleet-service` command that `argv` names.

    Returns:
        the exit code; 2 after a one-line error that names the field and the fix.
    """
    words = commandline.join_negative_numbers(sys.argv[1:] if argv is None else argv)
    chosen = next((argument for argument in words if not argument.startswith("-")), None)
    if argv is None and chosen == "run":
        from schemas.runtime.process import limit_memory

        limit_memory(*UNUSED)
    progress_messages.enable_messages(quiet=commandline.wants_quiet(words))
    # The import of the commands takes a second, so show a status.
    with (
        nullcontext() if chosen is None or chosen in LIVE else progress_messages.show_status(chosen)
    ):
        arguments = commandline.parser_of(*LINE, chosen).parse_args(words)
        if arguments.verbose:
            logging.basicConfig(
                level=logging.DEBUG, format="%(levelname)s %(name)s: %(message)s", stream=sys.stderr
            )
        return commandline.run_guarded(lambda: int(arguments.run(arguments)))
