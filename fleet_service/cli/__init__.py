"""`fleet-service`: run, query, watch, compact, retention, forget, export, analyze, certs,
evaluate, completion.

Bad input is one line on stderr, "error: field: problem; fix", and exit code 2. What a command needs is imported when
it is chosen, so that help comes at once.
"""

from __future__ import annotations

import argparse
import importlib
import logging
import sys
from collections.abc import Sequence
from contextlib import nullcontext
from typing import Final, NamedTuple

from schemas.runtime import commandline, talk

BAD_INPUT: Final = commandline.BAD_INPUT
LIVE: Final = ("run", "watch")  # commands that go on until a signal
# 25 MB that a running service's libraries load where they find them: for matrix products in kernels, of which there are
# none, and for file systems that only a compaction writes to, which is a process of its own.
UNUSED = ("scipy", "pyarrow._s3fs", "pyarrow._gcsfs", "pyarrow._azurefs", "pyarrow._hdfs")


class ServiceCommand(NamedTuple):
    """A subcommand: its module has `add_arguments(parser)` and `run(arguments) -> int`."""

    name: str
    help: str
    example: str

    @property
    def module(self) -> str:
        """Where it is written."""
        return f"fleet_service.cli.{self.name}"


COMMANDS: Final = (
    ServiceCommand("run", "take observations in, serve the map, keep the archive",
                   "fleet-service run --archive archive --config service.json"),
    ServiceCommand("query", "ask the map once",
                   "fleet-service query --bbox -0.5,51.2,0.3,51.7 --out map.geojson"),
    ServiceCommand("watch", "print tiles and alerts as they change, until Ctrl-C",
                   "fleet-service watch --bbox 11.9,57.6,12.1,57.8"),
    ServiceCommand("compact", "sort the log into files by date and zone, roll them up",
                   "fleet-service compact --archive archive"),
    ServiceCommand("retention", "remove old raw rows; their roll-ups stay",
                   "fleet-service retention --archive archive --raw-days 92 --dry-run"),
    ServiceCommand("forget", "destroy the key of a month, or remove one vehicle's rows of it",
                   "fleet-service forget --archive archive --period 2026-01 --vehicle car-one --dry-run"),
    ServiceCommand("export", "write a part as GeoParquet, GeoJSON or CSV",
                   "fleet-service export map --archive archive --out map.parquet"),
    ServiceCommand(
        "analyze",
        "ask the archive: grip, worst, spells, before-after, vehicles, calibration, weather, change-rates, replay",
        "fleet-service analyze worst --archive archive --from 2026-01-01 --out worst.html",
    ),
    ServiceCommand("certs", "certificates and router configurations for everyone on a list",
                   "fleet-service certs --fleet fleet.json --out certs"),
    ServiceCommand("evaluate", "simulated fleets, beside truth and simple rules",
                   "fleet-service evaluate --quick --out evaluation"),
    ServiceCommand("completion", "print what completes these commands in a shell",
                   "fleet-service completion bash > ~/.local/share/bash-completion/completions/fleet-service"),
)  # fmt: skip


def main(argv: Sequence[str] | None = None) -> int:
    """Run a command.

    Returns:
        its exit code; 2 after a one-line error that names the field and the fix.
    """
    given = commandline.joined(sys.argv[1:] if argv is None else argv)
    chosen = next((argument for argument in given if not argument.startswith("-")), None)
    if argv is None and chosen == "run":
        from schemas.runtime.process import limit_memory

        limit_memory(*UNUSED)
    arguments = parser_of(chosen).parse_args(given)
    talk.speak(quiet=arguments.quiet)
    if arguments.verbose:
        logging.basicConfig(level=logging.DEBUG, format="%(levelname)s %(name)s: %(message)s", stream=sys.stderr)
    with nullcontext() if chosen in LIVE else talk.busy(str(chosen)):
        return commandline.guarded(lambda: int(arguments.run(arguments)))


def parser_of(*chosen: str | None) -> argparse.ArgumentParser:
    """All commands by name, and the options of those chosen."""
    parser = argparse.ArgumentParser("fleet-service", description="One live map of grip from many vehicles.")
    parser.add_argument("--version", action=commandline.VersionAction)
    commands = parser.add_subparsers(dest="command", required=True, metavar="COMMAND")
    for command in COMMANDS:
        sub = commandline.add_command(commands, command.name, command.help, command.example)
        if command.name in chosen:
            module = importlib.import_module(command.module)
            module.add_arguments(sub)
            sub.set_defaults(run=module.run)
    return parser
