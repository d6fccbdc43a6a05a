"""`fleet-service rebuild`: compute the map and the hourly statistics of an archive again from raw
observations.
"""

from __future__ import annotations

import argparse
import time
from pathlib import Path

from fleet_service.cli.common import ArchiveReport, add_archive, compact_first, on_archive
from schemas.config import parse_moment
from schemas.runtime import progress_messages


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the options of `fleet-service rebuild`."""
    add_archive(parser)
    parser.add_argument(
        "--out",
        metavar="DIR",
        type=Path,
        required=True,
        help="new folder, which gets map/ and rollup/ by zone",
    )
    parser.add_argument(
        "--to", dest="until", metavar="TIME", help="moment of the map (default: now)"
    )
    parser.add_argument(
        "--engine",
        default="local",
        metavar="local|spark",
        help="where to compute (default %(default)s)",
    )
    parser.add_argument(
        "--as-it-lies",
        action="store_true",
        help="do not compact the log; roll up compacted files only",
    )


def run(arguments: argparse.Namespace) -> int:
    """Compute map and hourly statistics of an archive, and write them to the output folder."""
    return on_archive(arguments, _rebuild_maps)


def _rebuild_maps(arguments: argparse.Namespace) -> ArchiveReport:
    from fleet_service.analytics.rebuilding import Rebuild, rebuild, require_empty

    until = time.time_ns() if arguments.until is None else parse_moment(arguments.until, "to")
    require_empty(arguments.out)
    if not arguments.as_it_lies:
        compact_first(arguments.archive)
    progress_messages.set_status("replaying the archive by zone")
    done = list(
        rebuild(
            Rebuild(arguments.archive.resolve(), arguments.out.resolve(), until), arguments.engine
        )
    )
    cells = sum(one.cells for one in done)
    parts = sum(one.rollup_files for one in done)
    line = (
        f"{len(done)} zones in {arguments.out}: {cells} cells of the map, {parts} files rolled up"
    )
    return ArchiveReport(
        line, {"zones": len(done), "cells": cells, "parts": parts, "out": str(arguments.out)}
    )
