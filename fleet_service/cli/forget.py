"""`fleet-service forget`: a vehicle, or a month of all; where a service runs, it does it itself."""

from __future__ import annotations

import argparse
import time
from pathlib import Path
from typing import TYPE_CHECKING, Final

from fleet_service.cli.common import ArchiveReport, add_archive, add_dry_run, confirmed, on_archive

if TYPE_CHECKING:
    from fleet_service.archive.requests import Erasure
    from fleet_service.archive.retention import Forgotten

ASK_S: Final = 0.5  # between two looks whether the service has answered
LOOK_S: Final = 5.0  # ... and whether it is still there


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the options."""
    add_archive(parser)
    parser.add_argument("--period", metavar="MONTH", required=True, help="e.g. 2026-01")
    parser.add_argument("--vehicle", metavar="NAME", help="only this vehicle; its rows are removed")
    parser.add_argument("--put-to", metavar="URI", help="the mirror, where what was rewritten is put again")
    add_dry_run(parser)


def run(arguments: argparse.Namespace) -> int:
    """Run the command on its archive."""
    return on_archive(arguments, _forget)


def _forget(arguments: argparse.Namespace) -> ArchiveReport:
    from fleet_service.archive import mirror
    from fleet_service.archive.requests import Erasure
    from fleet_service.archive.retention import key_of, rows_of_vehicle

    root, month, vehicle = arguments.archive, arguments.period, arguments.vehicle
    key_of(root, month)
    rows = 0 if vehicle is None else rows_of_vehicle(root, vehicle, month)
    what = f"the key of {month} is destroyed" if vehicle is None else f"{rows} rows of {vehicle} are removed"
    if arguments.dry_run:
        return ArchiveReport(f"would be done: {what}", {"rows": 0, "key": False})
    if not confirmed(arguments, what):
        return ArchiveReport("nothing forgotten", {"rows": 0, "key": False})
    done = _erased(root, Erasure(month, vehicle))
    if vehicle is None:
        return ArchiveReport(what, {"rows": 0, "key": True})
    line = f"{done.rows} rows removed" if done.rows else f"no rows of {vehicle} in {month}: nothing removed"
    report: dict[str, object] = {"rows": done.rows, "key": False, "files": len(done.files)}
    if arguments.put_to is not None:
        report["put"] = mirror.put(root, arguments.put_to, done.files)
        line += f", {report['put']} files put to {arguments.put_to}"
    return ArchiveReport(line, report)


def _erased(root: Path, wanted: Erasure) -> Forgotten:
    """Erase, or let the service that holds the archive do it.

    Raises:
        InputError: there is no such month, or a file is damaged.
        OSError: a file cannot be read or written.
    """
    from fleet_service.archive import requests
    from fleet_service.archive.files import held
    from fleet_service.archive.retention import Forgotten, forget_period, forget_vehicle

    question = requests.ask(root, wanted) if held(root) else None
    looked = time.monotonic()
    while question is not None:  # a service that ends meanwhile leaves it to us
        if (told := requests.answer_to(question)) is not None:
            return Forgotten(told["rows"], tuple(root / path for path in told["files"]))
        time.sleep(ASK_S)
        if time.monotonic() - looked > LOOK_S:
            looked = time.monotonic()
            if not held(root):
                question.unlink(missing_ok=True)
                question = None
    if wanted.vehicle is None:
        forget_period(root, wanted.month)
        return Forgotten(0, ())
    return forget_vehicle(root, wanted.vehicle, wanted.month)
