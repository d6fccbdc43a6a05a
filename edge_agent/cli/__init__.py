"""`edge-agent` command line: simulate, import, check, calibrate, replay, run, fleet, tune,
evaluate, completion.

Invalid input gives one line on stderr, "error: field: problem; fix", and exit code 2. Modules are
imported only when a command needs them, so that help is fast.
"""

from __future__ import annotations

import logging
import sys
import traceback
from collections.abc import Sequence
from contextlib import nullcontext
from typing import Final

from schemas.runtime import commandline, progress_messages
from schemas.runtime.commandline import Command

FAILED: Final = commandline.FAILED
LIVE: Final = ("run", "fleet")  # commands that run for hours

COMMANDS: Final = (
    Command(
        "simulate",
        "edge_agent.cli.simulate",
        "simulate a manoeuvre and write its signal log with the true states",
        "edge-agent simulate double-lane-change --mu 0.5 --seed 1 --out drive.parquet "
        "--vehicle-out drive.json",
    ),
    Command(
        "import",
        "edge_agent.cli.import_",
        "convert a car's recording to a signal log: CAN, MDF, ROS, CSV, GNSS",
        "edge-agent import drive.blf drive.nmea --profile toyota --vehicle car.json --out "
        "drive.parquet",
    ),
    Command(
        "check",
        "edge_agent.cli.check",
        "check a log's units, signs, clocks and offsets by physics (signal doctor)",
        "edge-agent check drive.parquet --vehicle car.json --out check.html",
    ),
    Command(
        "calibrate",
        "edge_agent.cli.calibrate",
        "learn a vehicle file from a car's own drives",
        "edge-agent calibrate monday.parquet tuesday.parquet --vehicle car.json --out better.json",
    ),
    Command(
        "replay",
        "edge_agent.cli.replay",
        "estimate a recorded drive; publish it with --publish",
        "edge-agent replay drive.parquet --vehicle car.json --out estimates.parquet",
    ),
    Command(
        "run",
        "edge_agent.cli.run",
        "run one vehicle live, in real time",
        "edge-agent run --source simulated --name car-one --config agent.json",
    ),
    Command(
        "fleet",
        "edge_agent.cli.fleet",
        "run many simulated vehicles in real time, each with its own session",
        "edge-agent fleet --vehicles 36 --duration 150 --config agent.json",
    ),
    Command(
        "tune",
        "edge_agent.cli.tune",
        "search the fuzzy memberships by ant colony and by random search",
        "edge-agent tune --seed 1 --out memberships.json",
    ),
    Command(
        "evaluate",
        "edge_agent.cli.evaluate",
        "compare all estimators on the papers' manoeuvres",
        "edge-agent evaluate --quick --out evaluation",
    ),
    Command(
        "completion",
        "edge_agent.cli.completion",
        "print the completion script for a shell",
        "edge-agent completion bash > ~/.local/share/bash-completion/completions/edge-agent",
    ),
)
LINE: Final = (
    "edge-agent",
    "Estimate friction and motion of a vehicle from its sensors.",
    COMMANDS,
)


def main(argv: Sequence[str] | None = None) -> int:
    """Run a command line of `edge-agent`; return the exit code."""
    arguments = commandline.join_negative_numbers(sys.argv[1:] if argv is None else argv)
    chosen = next((argument for argument in arguments if not argument.startswith("-")), None)
    progress_messages.enable_messages(quiet=commandline.wants_quiet(arguments))
    # Show a status line, because loading the modules of a command takes a second.
    with (
        nullcontext() if chosen is None or chosen in LIVE else progress_messages.show_status(chosen)
    ):
        code, left = _run_command(arguments, limited=argv is None and chosen in LIVE, chosen=chosen)
    if left:
        from schemas.runtime.process import force_exit

        force_exit(code)
    return code


def _run_command(
    arguments: Sequence[str], *, limited: bool, chosen: str | None
) -> tuple[int, bool]:
    """Run a command. Return its exit code, and a flag: True if a thread of the command is still
    running and would keep the process from ending.
    """
    args = commandline.parser_of(*LINE, chosen).parse_args(arguments)
    level = logging.WARNING
    if args.verbose:
        level = logging.DEBUG
    elif args.quiet:
        level = logging.ERROR
    logging.basicConfig(
        level=level, format="%(levelname)s %(name)s: %(message)s", stream=sys.stderr
    )
    if level == logging.WARNING:  # libraries report threads and caches at the level INFO
        for package in ("edge_agent", "schemas"):
            logging.getLogger(package).setLevel(logging.INFO)
    from edge_agent.app.publishing import hanging_thread
    from schemas.runtime.process import limit_memory

    if limited:
        limit_memory()
    code = FAILED
    try:
        code = commandline.run_guarded(lambda: int(args.run(args)))
    except Exception:
        if not hanging_thread.is_set():
            raise
        traceback.print_exc()
    return code, hanging_thread.is_set()
