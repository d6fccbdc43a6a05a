"""`fleet-service completion`: print the completion script for a shell."""

from __future__ import annotations

import argparse

from schemas.runtime import commandline


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the options of `fleet-service completion`."""
    parser.add_argument("shell", metavar="|".join(commandline.SHELLS), help="shell to complete for")


def run(arguments: argparse.Namespace) -> int:
    """Print the completion script for the given shell."""
    from fleet_service.cli import COMMANDS, LINE

    parser = commandline.parser_of(*LINE, *(command.name for command in COMMANDS))
    print(commandline.completion(parser, arguments.shell))
    return 0
