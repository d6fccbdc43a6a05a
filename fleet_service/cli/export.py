"""`fleet-service export`: write a part of the archive, or the map at a past moment, to a file for
other programs.

`export datex` queries the running services instead, and writes the slippery stretches for road
authorities. `export iceberg` writes no file: it registers the compacted (sorted) files in Iceberg
tables.
"""

from __future__ import annotations

import argparse
import json
from pathlib import Path
from typing import Final

from fleet_service.cli.common import (
    ArchiveReport,
    add_archive,
    add_connection,
    add_part,
    add_supplier,
    on_archive,
    supplier_of,
    time_span,
)
from schemas.errors import InputError
from schemas.runtime import commandline, progress_messages

ENDINGS: Final = (".parquet", ".geojson", ".csv")
WHAT: Final = ("map", "observations", "rollup")
DATEX: Final = "datex"
ICEBERG: Final = "iceberg"
ROUTERS: Final = ("valhalla", "graphhopper")
_LIVE: Final = ("country", "supplier", "follow", "connect", "config")
_ROADS: Final = ("roads", "exclude_ice")
_PART: Final = ("bbox", "since", "until", "last")
_TABLE: Final = ("catalog", "namespace", "at")
_NOT: Final = {  # options that belong to another kind of export
    **dict.fromkeys(WHAT, (*_LIVE, *_TABLE, *_ROADS)),
    DATEX: ("archive", *_PART, *_TABLE, *_ROADS),
    ICEBERG: (*_LIVE, *_PART, *_ROADS, "out", "snapshot"),
    **dict.fromkeys(
        ROUTERS,
        ("archive", "country", "supplier", "follow", *_TABLE, "since", "until", "last", "snapshot"),
    ),
}
_NEEDS: Final = {
    **dict.fromkeys(WHAT, ("archive", "out")),
    DATEX: ("country", "supplier", "out"),
    ICEBERG: ("archive", "catalog"),
    **dict.fromkeys(ROUTERS, ("roads", "out")),
}


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the options of `fleet-service export`."""
    add_archive(parser, required=False)
    parser.add_argument(
        "what",
        choices=(*WHAT, DATEX, ICEBERG, *ROUTERS),
        metavar="|".join((*WHAT, DATEX, ICEBERG, *ROUTERS)),
        help="part of the archive or of the live map to export",
    )
    parser.add_argument(
        "--out", metavar="FILE", type=Path, help=f"output file ({', '.join(ENDINGS)}; datex: .xml)"
    )
    add_part(parser)
    parser.add_argument(
        "--min-vehicles",
        metavar="K",
        type=int,
        default=1,
        help="map: only cells with at least K vehicles",
    )
    parser.add_argument(
        "--snapshot",
        action="store_true",
        help="map: use the service's last hourly snapshot instead of a replay",
    )
    add_connection(parser)
    add_supplier(parser)
    parser.add_argument(
        "--roads",
        metavar="FILE",
        type=Path,
        help="valhalla, graphhopper: extract of the road network",
    )
    parser.add_argument(
        "--exclude-ice",
        action="store_true",
        help="valhalla: exclude roads with certain ice instead of raising their cost",
    )
    parser.add_argument(
        "--follow", action="store_true", help="datex: keep the file current until a signal"
    )
    parser.add_argument(
        "--catalog",
        metavar="NAME|URI",
        help="iceberg: name in pyiceberg's configuration, or sqlite:///FILE, postgresql+…",
    )
    parser.add_argument(
        "--namespace", metavar="NAME", help="iceberg: namespace of the tables (default: gripmap)"
    )
    parser.add_argument(
        "--at",
        metavar="URL",
        help="iceberg: URL at which readers find the archive's files (default: its path)",
    )


def check_options(arguments: argparse.Namespace) -> None:
    """Raise InputError if an option is missing, or belongs to another kind of export."""
    for name in _NOT[arguments.what]:
        if getattr(arguments, name):
            option = {"since": "from", "until": "to"}.get(name, name)
            raise InputError(option, f"has no effect on export {arguments.what}", "leave it out")
    for name in _NEEDS[arguments.what]:
        if getattr(arguments, name) is None:
            raise InputError(name, f"is missing for export {arguments.what}", f"give --{name}")


def run(arguments: argparse.Namespace) -> int:
    """Export from the archive, or from the live map of the running services."""
    check_options(arguments)
    if arguments.what == DATEX:
        return _publish_datex(arguments)
    if arguments.what in ROUTERS:
        return _route_costs(arguments)
    return on_archive(arguments, _register_iceberg if arguments.what == ICEBERG else _export_rows)


def _register_iceberg(arguments: argparse.Namespace) -> ArchiveReport:
    from fleet_service.archive.maintenance.iceberg import NAMESPACE, Place, register_files

    root = arguments.archive.resolve()
    # Readers of Iceberg do not decode percent signs, so that `root.as_uri()` would name no file.
    at = arguments.at or f"file://{root}"
    place = Place(arguments.catalog, arguments.namespace or NAMESPACE, at)
    done = register_files(root, place)
    line = (
        f"{done.added} files registered, {done.dropped} dropped: {done.rows} rows in "
        f"{place.catalog}"
    )
    return ArchiveReport(line, dict(done._asdict()))


def _route_costs(arguments: argparse.Namespace) -> int:
    """Write a file, computed from the live map and a road network, that makes a route planner avoid
    roads with low friction.
    """
    from fleet_service.analytics.roads.network import read_network
    from fleet_service.client import map_client, routing

    commandline.check_ending("out", commandline.check_out_file("out", arguments.out), (".json",))
    links = read_network(arguments.roads).links
    box = {"format": "arrow"} | ({} if arguments.bbox is None else {"bbox": arguments.bbox})
    table = map_client.served_table(
        map_client.query_map(
            map_client.connection_settings(arguments.connect, arguments.config), box
        )
    )
    lines = routing.cost_lines(
        table, (routing.RoadLine(link.latitude, link.longitude) for link in links)
    )
    if arguments.what == "graphhopper":
        costs = routing.graphhopper_model(lines)
    else:
        costs = routing.valhalla_request(
            lines, routing.ice_cells(table) if arguments.exclude_ice else ()
        )
    with commandline.report_write_errors(arguments.out):
        arguments.out.write_text(json.dumps(costs), encoding="utf-8")
    print(f"{len(lines)} stretches of low grip in {arguments.out}", flush=True)
    if not lines:
        print(f"note: {routing.explain_no_line(table, str(arguments.roads))}", flush=True)
    return 0


def _publish_datex(arguments: argparse.Namespace) -> int:
    from fleet_service.cli.common import stop_on_signals
    from fleet_service.client.datex_feed import DatexFeed, DatexFile, publish_alerts
    from fleet_service.client.map_client import connection_settings

    commandline.check_ending("out", commandline.check_out_file("out", arguments.out), (".xml",))
    feed = DatexFeed(
        DatexFile(supplier_of(arguments), arguments.out, lambda line: print(line, flush=True))
    )
    publish_alerts(
        connection_settings(arguments.connect, arguments.config),
        feed,
        stop_on_signals() if arguments.follow else None,
    )
    return 0


def _export_rows(arguments: argparse.Namespace) -> ArchiveReport:
    from fleet_service.archive.export import extract
    from fleet_service.client.stretches import format_time
    from schemas import query

    commandline.check_ending("out", commandline.check_out_file("out", arguments.out), ENDINGS)
    if arguments.min_vehicles < 1:
        raise InputError(
            "min-vehicles", f"{arguments.min_vehicles} is below 1", "give a whole number from 1"
        )
    bbox = query.parse({} if arguments.bbox is None else {"bbox": arguments.bbox}).bbox
    part = extract.Extract(*time_span(arguments), bbox)
    as_of = ""
    if arguments.what == "map" and not arguments.snapshot:
        from fleet_service.analytics.past_map import map_at, require_past

        require_past(part.until, "to")
        progress_messages.set_status("replaying the archive")
        table = map_at(arguments.archive, part)
        as_of = format_time(part.until)
    else:
        table = extract.WHAT[arguments.what](arguments.archive, part)
        if arguments.what == "map":
            as_of = format_time(extract.snapshot_time(arguments.archive, part))
    if arguments.what == "map":
        table = extract.with_vehicles(table, arguments.min_vehicles)
    extract.write_extract(table, arguments.out)
    line = f"{table.num_rows} rows in {arguments.out}" + (
        f": the map as of {as_of}" if as_of else ""
    )
    return ArchiveReport(
        line,
        {"rows": table.num_rows, "out": str(arguments.out), **({"as_of": as_of} if as_of else {})},
    )
