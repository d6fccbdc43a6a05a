"""`fleet-service export`: a part of the archive as a file for other programs; the map as it stands now, or stood."""

from __future__ import annotations

import argparse
from datetime import UTC, datetime
from pathlib import Path
from typing import Final

from fleet_service.cli.common import ArchiveReport, add_archive, add_part, on_archive, span
from schemas.errors import InputError
from schemas.runtime import commandline, talk
from schemas.thresholds import NS

ENDINGS: Final = (".parquet", ".geojson", ".csv")


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the options."""
    add_archive(parser)
    parser.add_argument("what", choices=("map", "observations", "rollup"), metavar="map|observations|rollup")
    parser.add_argument("--out", metavar="FILE", type=Path, required=True, help=f"ends in {', '.join(ENDINGS)}")
    add_part(parser)
    parser.add_argument(
        "--min-vehicles", metavar="K", type=int, default=1, help="map: only cells of K vehicles or more"
    )
    parser.add_argument("--snapshot", action="store_true", help="map: the service's last hourly one, at once")


def run(arguments: argparse.Namespace) -> int:
    """Run the command on its archive."""
    return on_archive(arguments, _export)


def _export(arguments: argparse.Namespace) -> ArchiveReport:
    from fleet_service.archive import export
    from schemas import query

    commandline.ending("out", commandline.out_folder("out", arguments.out), ENDINGS)
    if arguments.min_vehicles < 1:
        raise InputError("min-vehicles", f"{arguments.min_vehicles} is below 1", "give a whole number from 1")
    bbox = query.parse({} if arguments.bbox is None else {"bbox": arguments.bbox}).bbox
    part = export.Extract(*span(arguments), bbox)
    as_of = ""
    if arguments.what == "map" and not arguments.snapshot:
        from fleet_service.analytics.past_map import map_at

        talk.doing("replaying the archive")
        table = map_at(arguments.archive, part)
        as_of = _text(part.until)
    else:
        table = export.WHAT[arguments.what](arguments.archive, part)
        if arguments.what == "map":
            as_of = _text(export.snapshot_time(arguments.archive, part))
    if arguments.what == "map":
        table = export.seen_by(table, arguments.min_vehicles)
    export.write(table, arguments.out)
    line = f"{table.num_rows} rows in {arguments.out}" + (f": the map as of {as_of}" if as_of else "")
    return ArchiveReport(
        line, {"rows": table.num_rows, "out": str(arguments.out), **({"as_of": as_of} if as_of else {})}
    )


def _text(ns: int) -> str:
    return f"{datetime.fromtimestamp(ns // NS, UTC):%Y-%m-%dT%H:%M:%SZ}"
