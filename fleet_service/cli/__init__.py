"""`fleet-service`: run, query, watch, compact, retention, forget, export, analyze, certs, evaluate.

Bad input is one line on stderr, "error: field: problem; fix", and exit code 2. What a command needs is imported when
it is chosen, so that help comes at once.
"""

from __future__ import annotations

import argparse
import importlib
import sys
from collections.abc import Sequence
from typing import Final, NamedTuple

BAD_INPUT: Final = 2
# 25 MB that a running service's libraries load where they find them: for matrix products in kernels, of which there are
# none, and for file systems that only a compaction writes to, which is a process of its own.
UNUSED = ("scipy", "pyarrow._s3fs", "pyarrow._gcsfs", "pyarrow._azurefs", "pyarrow._hdfs")


class ServiceCommand(NamedTuple):
    """A subcommand: its module has `add_arguments(parser)` and `run(arguments) -> int`."""

    name: str
    help: str

    @property
    def module(self) -> str:
        """Where it is written."""
        return f"fleet_service.cli.{self.name}"


COMMANDS: Final = (
    ServiceCommand("run", "take observations in, serve the map, keep the archive"),
    ServiceCommand("query", "ask the map once"),
    ServiceCommand("watch", "print tiles and alerts as they change, until Ctrl-C"),
    ServiceCommand("compact", "sort the log into files by date and zone, roll them up"),
    ServiceCommand("retention", "remove old raw rows; their roll-ups stay"),
    ServiceCommand("forget", "destroy the key of a month, or remove one vehicle's rows of it"),
    ServiceCommand("export", "write a part as GeoParquet, GeoJSON or CSV"),
    ServiceCommand(
        "analyze",
        "ask the archive: grip, worst, spells, before-after, vehicles, calibration, weather, replay",
    ),
    ServiceCommand("certs", "certificates and router configurations for everyone on a list"),
    ServiceCommand("evaluate", "simulated fleets, beside truth and simple rules"),
)


def main(argv: Sequence[str] | None = None) -> int:
    """Run a command.

    Returns:
        its exit code; 2 after a one-line error that names the field and the fix.
    """
    given = list(sys.argv[1:] if argv is None else argv)
    chosen = next((argument for argument in given if not argument.startswith("-")), None)
    if argv is None and chosen == "run":
        from schemas.runtime.process import limit_memory

        limit_memory(*UNUSED)
    arguments = _parser(chosen).parse_args(given)
    from schemas.errors import InputError

    try:
        return int(arguments.run(arguments))
    except InputError as error:
        print(f"error: {error}", file=sys.stderr)
        return BAD_INPUT
    except BrokenPipeError:  # the reader of our output left: nobody to tell
        sys.stderr.close()
        return 0


def _parser(chosen: str | None) -> argparse.ArgumentParser:
    """All commands by name, and the options of the chosen one."""
    parser = argparse.ArgumentParser("fleet-service", description="One live map of grip from many vehicles.")
    commands = parser.add_subparsers(required=True, metavar="COMMAND")
    for command in COMMANDS:
        sub = commands.add_parser(command.name, help=command.help)
        if command.name == chosen:
            module = importlib.import_module(command.module)
            module.add_arguments(sub)
            sub.set_defaults(run=module.run)
    return parser
