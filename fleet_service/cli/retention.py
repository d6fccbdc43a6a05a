"""`fleet-service retention`: remove old raw rows from an archive. The service may be running."""

from __future__ import annotations

import argparse
from datetime import UTC, datetime

from fleet_service.cli.common import (
    ArchiveReport,
    add_archive,
    add_dry_run,
    confirm_deletion,
    on_archive,
)


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the options of `fleet-service retention`."""
    add_archive(parser)
    parser.add_argument(
        "--raw-days",
        metavar="N",
        type=int,
        required=True,
        help="number of days for which raw rows are kept",
    )
    add_dry_run(parser)


def run(arguments: argparse.Namespace) -> int:
    """Remove the raw rows of an archive that are older than the retention limit of the options."""
    return on_archive(arguments, _retire_rows)


def _retire_rows(arguments: argparse.Namespace) -> ArchiveReport:
    from fleet_service.archive.maintenance.retention import due_folders, retire_rows

    today = datetime.now(UTC).date()
    folders = due_folders(arguments.archive, arguments.raw_days, today)
    what = f"raw rows of {len(folders)} days"
    if arguments.dry_run:
        return ArchiveReport(f"{what} would be removed", {"days": len(folders), "files": 0})
    if folders and not confirm_deletion(
        arguments, f"{what} are removed, {folders[0].name} the first"
    ):
        return ArchiveReport("nothing removed", {"days": 0, "files": 0})
    done = retire_rows(arguments.archive, arguments.raw_days, today)
    line = f"raw rows of {done.days} days removed, {done.files} files; their roll-ups stay"
    return ArchiveReport(line, {"days": done.days, "files": done.files})
