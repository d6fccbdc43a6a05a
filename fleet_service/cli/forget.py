"""`fleet-service forget`: a vehicle, or a month of all; not while the service runs, which remembers more than files."""

from __future__ import annotations

import argparse

from fleet_service.cli.common import ArchiveReport, add_archive, add_dry_run, confirmed, on_archive


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
    from fleet_service.archive.retention import forget_period, forget_vehicle, key_of, rows_of_vehicle

    root, month, vehicle = arguments.archive, arguments.period, arguments.vehicle
    key_of(root, month)
    rows = 0 if vehicle is None else rows_of_vehicle(root, vehicle, month)
    what = f"the key of {month} is destroyed" if vehicle is None else f"{rows} rows of {vehicle} are removed"
    if arguments.dry_run:
        return ArchiveReport(f"would be done: {what}", {"rows": 0, "key": False})
    if not confirmed(arguments, what):
        return ArchiveReport("nothing forgotten", {"rows": 0, "key": False})
    if vehicle is None:
        forget_period(root, month)
        return ArchiveReport(what, {"rows": 0, "key": True})
    done = forget_vehicle(root, vehicle, month)
    line = f"{done.rows} rows removed" if done.rows else f"no rows of {vehicle} in {month}: nothing removed"
    report: dict[str, object] = {"rows": done.rows, "key": False, "files": len(done.files)}
    if arguments.put_to is not None:
        report["put"] = mirror.put(root, arguments.put_to, done.files)
        line += f", {report['put']} files put to {arguments.put_to}"
    return ArchiveReport(line, report)
