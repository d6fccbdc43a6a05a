"""`fleet-service retention`: old raw rows removed. The service may run meanwhile."""

from __future__ import annotations

import argparse
from datetime import UTC, datetime

from fleet_service.cli.common import add_archive, on_archive


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the options."""
    add_archive(parser)
    parser.add_argument("--raw-days", metavar="N", type=int, required=True, help="days of raw rows that stay")


def run(arguments: argparse.Namespace) -> int:
    """Run the command on its archive."""
    return on_archive(arguments, _retention)


def _retention(arguments: argparse.Namespace) -> str:
    from fleet_service.archive.retention import retire

    done = retire(arguments.archive, arguments.raw_days, datetime.now(UTC).date())
    return f"raw rows of {done.days} days removed, {done.files} files; their roll-ups stay"
