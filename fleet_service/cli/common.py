"""Shared parts of the commands: signals, connection to the router, selected part of an archive."""

from __future__ import annotations

import argparse
import json
import re
import signal
import sys
import threading
import time
from collections.abc import Callable, Sequence
from pathlib import Path
from types import FrameType
from typing import TYPE_CHECKING, Final, NamedTuple

from schemas.config import parse_moment
from schemas.errors import InputError
from schemas.runtime import progress_messages
from schemas.thresholds import NS

if TYPE_CHECKING:
    from fleet_service.client.datex import Supplier

STATUSES: Final = ("real", "test", "technicalExercise", "securityExercise")

UNITS: Final = {"s": 1.0, "min": 60.0, "h": 3600.0, "d": 86400.0}


def stop_on_signals() -> threading.Event:
    """Return an event that is set by SIGTERM and Ctrl-C. The same signal again ends the process at
    once.
    """
    stop = threading.Event()

    # `signal.signal` requires a function with these two arguments.
    def on_signal(number: int, frame: FrameType | None) -> None:  # noqa: ARG001
        stop.set()
        signal.signal(number, signal.SIG_DFL)

    for number in (signal.SIGTERM, signal.SIGINT):
        signal.signal(number, on_signal)
    return stop


def add_connection(parser: argparse.ArgumentParser) -> None:
    """Declare the options for the connection to the map's router."""
    parser.add_argument("--connect", metavar="ENDPOINT", help="router, e.g. tcp/127.0.0.1:7447")
    parser.add_argument(
        "--config", metavar="FILE", help="JSON file with a `zenoh` section, as for run"
    )


def add_supplier(parser: argparse.ArgumentParser) -> None:
    """Declare the options for the supplier of a DATEX II publication."""
    parser.add_argument("--country", metavar="CC", help="datex: country of the supplier, e.g. se")
    parser.add_argument(
        "--supplier",
        metavar="NAME",
        help="datex: name of the supplier at its National Access Point",
    )
    parser.add_argument(
        "--status",
        choices=STATUSES,
        default="test",
        help="datex: status of the information (default test)",
    )


def supplier_of(arguments: argparse.Namespace) -> Supplier:
    """Return the supplier of a DATEX II publication from the options.

    Raises:
        InputError: an option is missing, or the country is not valid.
    """
    from fleet_service.client.datex import Supplier

    for name in ("country", "supplier"):
        if getattr(arguments, name) is None:
            raise InputError(name, "is missing for a DATEX II publication", f"give --{name}")
    return Supplier(arguments.country, arguments.supplier, arguments.status)


def add_part(parser: argparse.ArgumentParser) -> None:
    """Declare the command-line options that select a part of the archive (times and box)."""
    parser.add_argument(
        "--from",
        dest="since",
        metavar="TIME",
        help="start, e.g. 2026-01-31 or 2026-01-31T07:00:00Z, UTC",
    )
    parser.add_argument(
        "--last",
        metavar="TIME",
        help="instead of --from: length of the period until now, e.g. 12h, 90min or 7d",
    )
    parser.add_argument(
        "--to", dest="until", metavar="TIME", help="end, excluded, in the same form (default: now)"
    )
    parser.add_argument("--bbox", metavar="W,S,E,N", help="box in degrees (default: everything)")


def add_archive(parser: argparse.ArgumentParser, *, required: bool = True) -> None:
    """Declare two options of a command: one names the archive's folder, the other selects the form
    of the command's report (text or JSON).
    """
    parser.add_argument(
        "--archive",
        metavar="DIR",
        type=Path,
        required=required,
        help="archive of a service, running or not",
    )
    parser.add_argument("--json", action="store_true", help="print the result as one line of JSON")


def add_dry_run(parser: argparse.ArgumentParser) -> None:
    """Declare the options of a command that deletes data: one to show the planned changes only, and
    one to skip the confirmation.
    """
    parser.add_argument("--dry-run", action="store_true", help="only print the planned changes")
    parser.add_argument("--yes", action="store_true", help="do not ask for confirmation")


def confirm_deletion(arguments: argparse.Namespace, what: str) -> bool:
    """Ask the user to confirm the deletion that `what` describes; return True if the user agrees,
    or if there is no terminal to ask on.
    """
    if arguments.yes or not sys.stdin.isatty():
        return True
    progress_messages.stop_status()
    print(f"{what}. This cannot be undone. Continue? [y/N] ", end="", file=sys.stderr, flush=True)
    return sys.stdin.readline().strip().lower() in ("y", "yes")


def duration_s(field: str, text: str) -> float:
    """Return a duration in seconds from text such as 90min or 12h.

    Raises:
        InputError: the text is not a duration.
    """
    found = re.fullmatch(r"(\d+(?:\.\d*)?|\.\d+)(s|min|h|d)", text)
    if found is None:
        raise InputError(field, f"{text[:20]!r} is not a duration", "write it like 4h, 90min or 1d")
    return float(found[1]) * UNITS[found[2]]


def time_span(arguments: argparse.Namespace) -> tuple[int, int]:
    """Return begin and end [ns] of the time range that the options of `add_part` select.

    Raises:
        InputError: an option is not a time, or the end is not after the begin.
    """
    since = 0 if arguments.since is None else parse_moment(arguments.since, "from")
    if arguments.last is not None:
        if arguments.since is not None or arguments.until is not None:
            raise InputError(
                "last",
                "cannot be combined with --from or --to",
                "give either --last or --from and --to",
            )
        since = time.time_ns() - round(duration_s("last", arguments.last) * NS)
    until = time.time_ns() if arguments.until is None else parse_moment(arguments.until, "to")
    if since >= until:
        raise InputError(
            "to",
            f"{arguments.until or 'now'} is not after --from {arguments.since}",
            "give a later time",
        )
    return since, until


class ArchiveReport(NamedTuple):
    """Report of a command: one line of text for people, and the same values for programs."""

    line: str
    values: dict[str, object]


def on_archive(
    arguments: argparse.Namespace, command: Callable[[argparse.Namespace], ArchiveReport]
) -> int:
    """Run the function `command` on the archive that the arguments name, and print its report;
    return the exit code.

    Raises:
        InputError: there is no such archive, or it cannot be read or written.
    """
    from fleet_service.archive.format.layout import require_archive

    require_archive(arguments.archive)
    try:
        done = command(arguments)
        print(
            json.dumps({"command": arguments.command, **done.values})
            if arguments.json
            else done.line
        )
    except OSError as error:
        place = error.filename or arguments.archive  # a full disk gives no file name
        problem = f"cannot use {place} ({error.strerror or error})"
        raise InputError("archive", problem, "nothing is lost") from error
    return 0


def compact_first(root: Path) -> None:
    """Move the new rows of an archive into its compacted (sorted) files, so that these rows are
    included in the answer. If that is impossible, print how many segments (files of new rows) are
    left out.

    Raises:
        InputError: the folder is not an archive.
    """
    from fleet_service.archive.format import layout, segments
    from fleet_service.archive.maintenance.compaction import compact
    from schemas.wire import Kind

    layout.require_archive(root)
    waiting = len(segments.list_segments(root, Kind.OBSERVATION))
    if not waiting:
        return
    progress_messages.set_status(f"compacting {waiting} segments of the log")
    try:
        done = compact(root)
        progress_messages.report(f"compacted first: {done.rows:,} rows of {done.segments} segments")
    except (OSError, InputError) as error:
        print(f"warning: {waiting} segments of the log are not included: {error}", file=sys.stderr)


def describe_covered_box(what: str, box: Sequence[float], queried_box: Sequence[float]) -> str:
    """Return a message for a queried box that contains no data. It states the box that the data
    cover, and mentions if latitude and longitude seem to be swapped. Boxes are west, south, east,
    north [deg].
    """
    sides = ",".join(f"{side:.3f}" for side in box)
    words = f"no cell lies in this box; the {what} covers --bbox {sides}"
    west, south, east, north = queried_box
    if box[0] < north and box[2] > south and box[1] < east and box[3] > west:
        words += ": longitude comes before latitude"
    return words
