"""`fleet-service query`: query the map once, and print or write the answer."""

from __future__ import annotations

import argparse
import sys
from pathlib import Path
from typing import Final

from fleet_service.cli.common import add_connection, describe_covered_box
from schemas.errors import InputError
from schemas.runtime import commandline

# The ending of the file selects the format in which the service answers.
FORMS: Final = {
    ".arrow": "arrow",
    ".parquet": "arrow",
    ".csv": "arrow",
    ".geojson": "geojson",
    ".json": "json",
}
NOBODY: Final = 1  # exit code if no service answers for some part of the area


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the options of `fleet-service query`."""
    parser.add_argument("--bbox", metavar="W,S,E,N", help="box in degrees (default: everything)")
    parser.add_argument(
        "--route",
        metavar="LON,LAT|LON,LAT",
        help="route; the answer has its cells in driving order",
    )
    parser.add_argument("--min-vehicles", metavar="K", help="only cells with at least K vehicles")
    parser.add_argument(
        "--at",
        metavar="TIME",
        help="moment of the map, e.g. 2026-01-31T07:00:00Z; UTC without a zone",
    )
    parser.add_argument(
        "--basis",
        metavar="borrowed",
        help="borrowed: also unvisited cells, imputed from neighbours",
    )
    parser.add_argument(
        "--format", metavar="arrow|geojson|json", help="arrow (default) prints a table"
    )
    parser.add_argument(
        "--out",
        metavar="FILE",
        type=Path,
        help=f"output file; its ending selects the form: {', '.join(FORMS)}",
    )
    add_connection(parser)


def run(arguments: argparse.Namespace) -> int:
    """Query the map, and print or write the answer. Return exit code 1 if no service answers for a
    part of the area.
    """
    form = _output_format(arguments.out, arguments.format)
    from fleet_service.client import map_client

    query_options = {
        name: getattr(arguments, name) for name in ("bbox", "route", "min_vehicles", "at", "basis")
    }
    parameters = {
        name: value
        for name, value in (*query_options.items(), ("format", form))
        if value is not None
    }
    answer = map_client.query_map(
        map_client.connection_settings(arguments.connect, arguments.config), parameters
    )
    if not answer.served:
        print(
            "no service answers for the map: start one; this is not the same as an empty map",
            file=sys.stderr,
        )
        return NOBODY
    if arguments.bbox is not None and answer.is_empty:
        _say_what_is_covered(arguments)
    if arguments.out is None:
        print(map_client.format_answer(answer))
    elif answer.table is not None and arguments.out.suffix in (".parquet", ".csv"):
        from fleet_service.archive.export import extract
        from fleet_service.archive.format import geo

        extract.write_extract(geo.with_cells(answer.table), arguments.out)
    else:
        map_client.write_answer(answer, arguments.out)
    if answer.gap_description is not None:
        print(answer.gap_description, file=sys.stderr)
        return NOBODY
    return 0


def _say_what_is_covered(arguments: argparse.Namespace) -> None:
    """If a query found no cell in its box, print the box of the whole map. This helps a user who
    has swapped latitude and longitude.
    """
    from fleet_service.client import map_client

    whole_map = map_client.query_map(
        map_client.connection_settings(arguments.connect, arguments.config), {}
    ).table
    if whole_map is None or not whole_map.num_rows:
        return
    west_end, south_end, east_end, north_end = (
        whole_map[name].to_numpy() for name in ("west", "south", "east", "north")
    )
    box = [
        float(west_end.min()),
        float(south_end.min()),
        float(east_end.max()),
        float(north_end.max()),
    ]
    queried_box = [float(side) for side in arguments.bbox.split(",")]
    print(describe_covered_box("map", box, queried_box), file=sys.stderr)


def _output_format(out: Path | None, given: str | None) -> str | None:
    if out is None:
        return given
    commandline.check_out_file("out", out)
    if not out.suffix:
        return given
    form = FORMS[commandline.check_ending("out", out, tuple(FORMS))]
    if given not in (None, form):
        raise InputError(
            "format",
            f"{given} does not match {out.name}",
            f"omit --format: the ending implies {form}",
        )
    return form
