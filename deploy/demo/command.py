"""`gripmap demo`: runs the whole system on this machine, from the wheel speeds of simulated cars to
the map, in about three minutes.

All files are written to `.demo/` in the current folder.
"""

from __future__ import annotations

import argparse
import math
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
        InputError: an option is out of range, an optional package is missing, or a process of the
            demo did not start.
    """
    try:
        from deploy.demo import processes, story
        from fleet_service.page import server  # noqa: F401 the page's process needs this package
    except ImportError as error:
        raise InputError(
            "demo", f"the package {error.name} is missing", install_command("demo,page")
        ) from error
    _check_options(args)
    try:
        return story.run(args)
    except processes.DemoError as error:
        raise InputError("demo", str(error), "correct the reason, or read the whole log") from error


def _check_options(args: argparse.Namespace) -> None:
    """Check the options, so that a wrong one is reported before a process starts.

    Raises:
        InputError: an option is out of range, the page's port is in use, or the screenshot cannot
            be taken.
    """
    from deploy.demo.screenshot import check_screenshot
    from edge_agent.lab.simulation.counter_rng import checked_seed
    from edge_agent.lab.simulation.fleet import check_live_fleet
    from edge_agent.lab.simulation.listeners import choose_warned
    from fleet_service.page.server import LOOPBACK, open_socket

    check_live_fleet(args.vehicles)
    checked_seed(args.seed)
    choose_warned(args.vehicles, args.warned)
    if math.isinf(args.duration):
        raise InputError("duration", "a drive of inf s never ends", "give seconds, e.g. 150")
    try:
        open_socket(LOOPBACK[0], args.page_port).close()
    except InputError as error:
        raise InputError("page-port", error.problem, "give another, or 0 for a free one") from error
    if args.screenshot is not None:
        check_screenshot(args.screenshot)
