"""`edge-agent`: simulate, import, check, calibrate, replay, run, fleet, tune, evaluate.

Bad input is one line on stderr, "error: field: problem; fix", and exit code 2. What a command needs is imported when
it is chosen, so that help is quick.
"""

from __future__ import annotations

import argparse
import importlib
import logging
import sys
import traceback
from collections.abc import Sequence
from typing import Final, NamedTuple

FAILED: Final = 1
BAD_INPUT: Final = 2
LIVE: Final = ("run", "fleet")  # commands that drive for hours


class Command(NamedTuple):
    """A subcommand: its module has `add_arguments(parser)` and `run(args) -> int`."""

    name: str
    module: str
    help: str


COMMANDS: Final = (
    Command("simulate", "edge_agent.cli.simulate", "write the signal log of a manoeuvre, with truth"),
    Command("import", "edge_agent.cli.import_", "any car's recording to a signal log: CAN, MDF, ROS, CSV, GNSS"),
    Command("check", "edge_agent.cli.check", "the signal doctor: units, signs, clocks, offsets, by physics"),
    Command("calibrate", "edge_agent.cli.calibrate", "a vehicle file learned from a car's own drives"),
    Command("replay", "edge_agent.cli.replay", "estimate a recorded drive, and publish it on request"),
    Command("run", "edge_agent.cli.run", "one vehicle, live, in real time"),
    Command("fleet", "edge_agent.cli.fleet", "many simulated vehicles in real time, each with its own session"),
    Command("tune", "edge_agent.cli.tune", "tune the fuzzy memberships by ant colony"),
    Command("evaluate", "edge_agent.cli.evaluate", "the papers' manoeuvres for every estimator, with figures"),
)


def main(argv: Sequence[str] | None = None) -> int:
    """Run a command line; returns the exit code."""
    arguments = list(sys.argv[1:] if argv is None else argv)
    parser = argparse.ArgumentParser(
        prog="edge-agent", description="Friction and motion of a vehicle from its sensors."
    )
    commands = parser.add_subparsers(dest="command", required=True, metavar="COMMAND")
    chosen = next((argument for argument in arguments if not argument.startswith("-")), None)
    for command in COMMANDS:
        sub = commands.add_parser(command.name, help=command.help, description=command.help)
        if command.name == chosen:
            module = importlib.import_module(command.module)
            module.add_arguments(sub)
            sub.set_defaults(run=module.run)
    args = parser.parse_args(arguments)
    logging.basicConfig(level=logging.INFO, format="%(levelname)s %(name)s: %(message)s", stream=sys.stderr)
    from edge_agent.cli.common import left_behind
    from schemas.runtime.process import end_now, limit_memory

    if argv is None and chosen in LIVE:
        limit_memory()
    code = FAILED
    try:
        code = _code(args)
    except Exception:
        if not left_behind.is_set():
            raise
        traceback.print_exc()
    if left_behind.is_set():
        end_now(code)
    return code


def _code(args: argparse.Namespace) -> int:
    from schemas.errors import InputError

    try:
        return int(args.run(args))
    except InputError as error:
        print(f"error: {error}", file=sys.stderr)
        return BAD_INPUT
