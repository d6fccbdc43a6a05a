"""What the commands share: signals, the router, which part of which archive."""

from __future__ import annotations

import argparse
import signal
import threading
import time
from collections.abc import Callable
from pathlib import Path

from schemas.config import moment
from schemas.errors import InputError


def stop_on_signals() -> threading.Event:
    """An event that SIGTERM and Ctrl-C set."""
    stop = threading.Event()
    for number in (signal.SIGTERM, signal.SIGINT):
        signal.signal(number, lambda *_: stop.set())
    return stop


def add_connection(parser: argparse.ArgumentParser) -> None:
    """Declare how to reach the map."""
    parser.add_argument("--connect", metavar="ENDPOINT", help="router, e.g. tcp/127.0.0.1:7447")
    parser.add_argument("--config", metavar="FILE", help="JSON with a `zenoh` section, as for run")


def add_part(parser: argparse.ArgumentParser) -> None:
    """Declare which part of an archive is wanted."""
    parser.add_argument("--from", dest="since", metavar="TIME", help="e.g. 2026-01-31 or 2026-01-31T07:00:00Z, UTC")
    parser.add_argument("--to", dest="until", metavar="TIME", help="likewise, excluded; default now")
    parser.add_argument("--bbox", metavar="W,S,E,N", help="degrees; without it, everything")


def add_archive(parser: argparse.ArgumentParser) -> None:
    """Declare the archive of a command that works on one."""
    parser.add_argument("--archive", metavar="DIR", type=Path, required=True, help="of a service, running or not")


def span(arguments: argparse.Namespace) -> tuple[int, int]:
    """From when until when [ns], of the options of `add_part`.

    Raises:
        InputError: one of them is no time.
    """
    since = 0 if arguments.since is None else moment(arguments.since, "from")
    return since, time.time_ns() if arguments.until is None else moment(arguments.until, "to")


def on_archive(arguments: argparse.Namespace, command: Callable[[argparse.Namespace], str]) -> int:
    """Run a command on its archive and print the line that it returns.

    Raises:
        InputError: there is no such archive, or it cannot be read or written.
    """
    if not arguments.archive.is_dir():
        raise InputError("archive", f"{arguments.archive} is no folder", "give the archive of a service")
    try:
        print(command(arguments))
    except OSError as error:
        raise InputError("archive", f"cannot use {error.filename} ({error.strerror})", "nothing is lost") from error
    return 0
