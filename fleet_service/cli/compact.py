"""`fleet-service compact`: move new rows of an archive from segments (files of new rows) to files
by date and zone (map square of zoom 7). The service may be running.
"""

from __future__ import annotations

import argparse

from fleet_service.cli.common import ArchiveReport, add_archive, on_archive
from schemas.errors import InputError


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the options of `fleet-service compact`."""
    add_archive(parser)
    parser.add_argument(
        "--put-to",
        dest="to",
        metavar="URI",
        help="URI to which new files are copied afterwards, e.g. s3://bucket/folder",
    )
    parser.add_argument(
        "--round-rows",
        metavar="N",
        type=int,
        help="maximum number of rows in memory (default: one million, about half a gigabyte)",
    )


def run(arguments: argparse.Namespace) -> int:
    """Compact the archive (move new rows into files sorted by cell), and copy new files to a mirror
    if requested.
    """
    return on_archive(arguments, _compact_archive)


def _compact_archive(arguments: argparse.Namespace) -> ArchiveReport:
    from fleet_service.archive.export import mirror
    from fleet_service.archive.maintenance import rollup
    from fleet_service.archive.maintenance.compaction import ROUND_ROWS, compact

    rows = ROUND_ROWS if arguments.round_rows is None else arguments.round_rows
    if rows < 1:
        raise InputError("round-rows", f"{rows} is below 1", "give the number of rows of one round")
    done = compact(arguments.archive, rows)
    parts = rollup.complete_parts(arguments.archive)
    summary = (
        f"{done.rows} rows of {done.segments} segments moved into {done.files} files, "
        f"{parts} rolled up"
    )
    values: dict[str, object] = {
        "rows": done.rows,
        "segments": done.segments,
        "files": done.files,
        "rolled_up": parts,
    }
    if arguments.to is not None:
        put = mirror.copy_new_files(arguments.archive, arguments.to)
        summary = f"{summary}, {put} put"
        values = {**values, "put": put}
    return ArchiveReport(summary, values)
