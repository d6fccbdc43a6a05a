"""`fleet-service roads`: assign each map cell and heading sector to a link of a road network.
`analyze contract` uses the result.
"""

from __future__ import annotations

import argparse
from pathlib import Path

from schemas.runtime import commandline, progress_messages


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the options of `fleet-service roads`."""
    parser.add_argument(
        "extract",
        metavar="EXTRACT",
        type=Path,
        help=".osm.pbf, .osm, or lines: .gpkg, .geojson, .shp",
    )
    parser.add_argument(
        "--out", metavar="FILE", type=Path, required=True, help="output file (.parquet)"
    )
    parser.add_argument(
        "--id",
        metavar="COLUMN",
        default="id",
        help="files of lines: column of the link's id (default %(default)s)",
    )
    parser.add_argument(
        "--name",
        metavar="COLUMN",
        default="name",
        help="files of lines: column of the link's name (default %(default)s)",
    )


def run(arguments: argparse.Namespace) -> int:
    """Read a road network, assign map cells to its road links, and write the table.

    Raises:
        InputError: the extract cannot be read, or the file cannot be written.
    """
    import pyarrow.parquet as pq

    from fleet_service.analytics.roads.join import join_roads
    from fleet_service.analytics.roads.network import read_network
    from schemas.runtime.durable import open_durably

    commandline.check_ending("out", commandline.check_out_file("out", arguments.out), (".parquet",))
    progress_messages.set_status(f"reading {arguments.extract}")
    network = read_network(arguments.extract, arguments.id, arguments.name)
    progress_messages.set_status(f"joining {len(network.links)} directed links")
    table = join_roads(network)
    with commandline.report_write_errors(arguments.out), open_durably(arguments.out) as file:
        pq.write_table(table, file, compression="zstd")
    licence = network.source.get("licence")
    print(
        f"{table.num_rows} places on {len(network.links)} directed links in {arguments.out}"
        + (f"; {licence}" if licence else "")
    )
    for note in network.notes:
        print(f"note: {note}")
    return 0
