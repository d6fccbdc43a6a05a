"""`fleet-service page`: serve the live map as a web page."""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import TYPE_CHECKING

from fleet_service.cli.common import add_connection, add_supplier, stop_on_signals, supplier_of
from schemas.errors import InputError
from schemas.runtime import commandline
from schemas.runtime.installing import install_command

if TYPE_CHECKING:
    from fleet_service.client.datex_feed import DatexFile


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the options of `fleet-service page`."""
    parser.add_argument(
        "--archive",
        metavar="DIR",
        type=Path,
        help="archive of a service on this machine; enables the past and the history",
    )
    parser.add_argument(
        "--host", default="127.0.0.1", help="listen address (default 127.0.0.1: this machine only)"
    )
    parser.add_argument(
        "--port",
        type=commandline.parse_port,
        default=8080,
        help="port; 0 selects a free one (default 8080)",
    )
    parser.add_argument(
        "--name",
        action="append",
        default=[],
        help="host name under which a proxy forwards requests",
    )
    parser.add_argument(
        "--metrics",
        metavar="URL",
        action="append",
        default=[],
        help="metrics address of a service, for the health view",
    )
    parser.add_argument(
        "--overlay",
        metavar="FILE",
        type=Path,
        help="Parquet of cell, sector, mu to draw over the map",
    )
    parser.add_argument(
        "--base-map",
        metavar="URL|FILE",
        help="map below the roads: .pmtiles or .mbtiles, or URL with {z}, {x}, {y}",
    )
    parser.add_argument(
        "--attribution", metavar="TEXT", help="attribution of the base map (default: from its file)"
    )
    parser.add_argument(
        "--roads",
        metavar="FILE",
        type=Path,
        help="GeoJSON of road lines with names (default: learned from the fleet)",
    )
    parser.add_argument(
        "--datex",
        metavar="FILE",
        type=Path,
        help="keep a DATEX II publication current in this file, and serve it",
    )
    add_supplier(parser)
    add_connection(parser)


def run(arguments: argparse.Namespace) -> int:
    """Serve the live page of the map until a signal arrives."""
    from fleet_service.client import map_client
    from schemas.runtime.zenoh_session import configuration

    try:
        from fleet_service.page import server
        from fleet_service.page.basemap import base_map
        from fleet_service.page.overlay import read_overlay
        from fleet_service.page.roads import read_roads
    except ImportError as error:
        fix = install_command("page")
        raise InputError("page", f"the package {error.name} is missing", fix) from error
    connection = map_client.connection_settings(arguments.connect, arguments.config)
    configuration(connection)  # here, because the thread that opens the session cannot end the page
    for address in arguments.metrics:
        if not address.startswith(("http://", "https://")):
            raise InputError(
                "metrics", f"{address!r} is not an address", "write it like http://127.0.0.1:9464"
            )
    if arguments.archive is not None:
        _check_archive(arguments.archive)
    if arguments.overlay is not None and read_overlay(arguments.overlay) is None:
        print(f"waiting for the overlay {arguments.overlay}: there is no such file yet", flush=True)
    settings = server.PageSettings(
        connection=connection,
        host=arguments.host,
        port=arguments.port,
        names=arguments.name,
        archive=arguments.archive,
        metrics=arguments.metrics,
        overlay=arguments.overlay,
        base_map=None
        if arguments.base_map is None
        else base_map(arguments.base_map, arguments.attribution),
        roads=None if arguments.roads is None else read_roads(arguments.roads),
        datex=_datex_file(arguments),
    )
    server.run(settings, stop_on_signals(), lambda line: print(line, flush=True))
    return 0


def _check_archive(root: Path) -> None:
    """Print a note if the archive does not exist yet; a service creates it when it starts for the
    first time.

    Raises:
        InputError: the folder contains something else.
    """
    from fleet_service.archive.format.layout import require_archive

    if root.exists() and (not root.is_dir() or any(root.iterdir())):
        require_archive(root)
    else:
        print(
            f"waiting for the archive {root}: its service creates it; the past appears then",
            flush=True,
        )


def _datex_file(arguments: argparse.Namespace) -> DatexFile | None:
    if arguments.datex is None:
        for name in ("country", "supplier"):
            if getattr(arguments, name) is not None:
                raise InputError(name, "needs --datex", "give both, or neither")
        return None
    from fleet_service.client.datex_feed import DatexFile

    commandline.check_ending(
        "datex", commandline.check_out_file("datex", arguments.datex), (".xml",)
    )
    return DatexFile(supplier_of(arguments), arguments.datex, lambda line: print(line, flush=True))
