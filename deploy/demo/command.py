"""`gripmap demo`: runs the whole system on this machine, from the wheel speeds of simulated cars to
the map, in about three minutes.

All files are written to `.demo/` in the current folder.
"""

from __future__ import annotations

import argparse
from pathlib import Path

from schemas.errors import InputError
from schemas.runtime import commandline
from schemas.runtime.installing import install_command


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the options of `gripmap demo`."""
    parser.add_argument("--vehicles", type=int, default=36, help="simulated vehicles (default 36)")
    parser.add_argument(
        "--duration",
        type=commandline.parse_positive,
        default=150.0,
        help="duration of the drive in seconds (default 150)",
    )
    parser.add_argument(
        "--seed", type=int, default=1, help="seed of vehicles, sensors and routes (default 1)"
    )
    parser.add_argument(
        "--warned",
        type=float,
        default=0.5,
        help="share of the vehicles that receive the map (default 0.5)",
    )
    parser.add_argument(
        "--stay",
        action="store_true",
        help="keep the map and the page running after the drive, until Ctrl-C",
    )
    parser.add_argument(
        "--open", action="store_true", help="open the page in this machine's browser"
    )
    parser.add_argument(
        "--page-port",
        type=commandline.parse_port,
        default=8080,
        help="port of the live page; 0 selects a free one (default 8080)",
    )
    parser.add_argument(
        "--screenshot",
        type=Path,
        metavar="FILE",
        help="save a screenshot of the page (needs Chromium)",
    )


def run(args: argparse.Namespace) -> int:
    """Run the demo with the parsed options; return the exit code.

    Raises:
        InputError: an optional package is missing, or a process of the demo did not start.
    """
    try:
        from deploy.demo import processes, story
        from fleet_service.page import server  # noqa: F401 the page's process needs this package
    except ImportError as error:
        raise InputError(
            "demo", f"the package {error.name} is missing", install_command("demo,page")
        ) from error
    try:
        return story.run(args)
    except processes.DemoError as error:
        raise InputError("demo", str(error), "correct the reason, or read the whole log") from error
