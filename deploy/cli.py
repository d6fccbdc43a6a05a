"""`gripmap`: command that runs the demo or a router, without a checkout of the repository."""

from __future__ import annotations

import sys
from collections.abc import Sequence
from typing import Final

from schemas.runtime import commandline, progress_messages
from schemas.runtime.commandline import Command

COMMANDS: Final = (
    Command(
        "demo",
        "deploy.demo.command",
        "run router, service, page and a simulated fleet on this machine",
        "gripmap demo --stay",
    ),
    Command(
        "router",
        "deploy.router",
        "run a Zenoh router until a signal",
        "gripmap router --listen tcp/0.0.0.0:7447",
    ),
)
LINE: Final = (
    "gripmap",
    "GripMap on one machine; see also edge-agent and fleet-service.",
    COMMANDS,
)


def main(argv: Sequence[str] | None = None) -> int:
    """Run the command that `argv` names; return the exit code."""
    words = commandline.join_negative_numbers(sys.argv[1:] if argv is None else argv)
    chosen = next((word for word in words if not word.startswith("-")), None)
    progress_messages.enable_messages(quiet=commandline.wants_quiet(words))
    arguments = commandline.parser_of(*LINE, chosen).parse_args(words)
    return commandline.run_guarded(lambda: int(arguments.run(arguments)))
