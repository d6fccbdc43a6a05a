"""`edge-agent completion`: print a script for a shell, by which the shell completes commands and
options.
"""

from __future__ import annotations

import argparse

from schemas.runtime import commandline


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the command-line arguments of `edge-agent completion`."""
    parser.add_argument("shell", metavar="|".join(commandline.SHELLS), help="shell to complete for")


def run(args: argparse.Namespace) -> int:
    """Print the completion script for the given shell; return 0."""
    from edge_agent.cli import COMMANDS, LINE

    parser = commandline.parser_of(*LINE, *(command.name for command in COMMANDS))
    print(commandline.completion(parser, args.shell))
    return 0
