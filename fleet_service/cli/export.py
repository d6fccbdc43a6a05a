"""`fleet-service export`: a part of the archive as a file for other programs."""

from __future__ import annotations

import argparse
from pathlib import Path

from fleet_service.cli.common import add_archive, add_part, on_archive, span


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the options."""
    add_archive(parser)
    parser.add_argument("what", choices=("map", "observations", "rollup"), metavar="map|observations|rollup")
    parser.add_argument("--out", metavar="FILE", type=Path, required=True, help="ends in .parquet, .geojson or .csv")
    add_part(parser)


def run(arguments: argparse.Namespace) -> int:
    """Run the command on its archive."""
    return on_archive(arguments, _export)


def _export(arguments: argparse.Namespace) -> str:
    from fleet_service.archive import export
    from schemas import query

    bbox = query.parse({} if arguments.bbox is None else {"bbox": arguments.bbox}).bbox
    part = export.Extract(*span(arguments), bbox)
    table = export.WHAT[arguments.what](arguments.archive, part)
    export.write(table, arguments.out)
    return f"{table.num_rows} rows in {arguments.out}"
