"""The commands of the archive. Only `forget` wants the service stopped, for a service remembers more than its files."""

from __future__ import annotations

import argparse
import time
from collections.abc import Callable
from datetime import UTC, datetime
from pathlib import Path
from typing import TYPE_CHECKING

from schemas.config import moment
from schemas.errors import InputError

if TYPE_CHECKING:
    Commands = argparse._SubParsersAction[argparse.ArgumentParser]


def add_commands(commands: Commands) -> None:
    """Declare them."""
    compact = _command(commands, "compact", _compact, "sort the log into files by date and zone, roll them up")
    compact.add_argument("--to", metavar="URI", help="then put what is new there, e.g. s3://bucket/folder")
    compact.add_argument(
        "--round-rows", metavar="N", type=int, help="rows in memory at once; default a million, half a gigabyte"
    )
    retention = _command(commands, "retention", _retention, "remove old raw rows; their roll-ups stay")
    retention.add_argument("--raw-days", metavar="N", type=int, required=True, help="days of raw rows that stay")
    forget = _command(commands, "forget", _forget, "destroy the key of a month, or remove one vehicle's rows of it")
    forget.add_argument("--period", metavar="MONTH", required=True, help="e.g. 2026-01")
    forget.add_argument("--vehicle", metavar="NAME", help="only this vehicle; its rows are removed")
    export = _command(commands, "export", _export, "write a part as GeoParquet, GeoJSON or CSV")
    export.add_argument("what", choices=("map", "observations", "rollup"), metavar="map|observations|rollup")
    export.add_argument("--out", metavar="FILE", type=Path, required=True, help="ends in .parquet, .geojson or .csv")
    add_part(export)


def add_part(parser: argparse.ArgumentParser) -> None:
    """Declare which part of an archive is wanted."""
    parser.add_argument("--from", dest="since", metavar="TIME", help="e.g. 2026-01-31 or 2026-01-31T07:00:00Z, UTC")
    parser.add_argument("--to", dest="until", metavar="TIME", help="likewise, excluded; default now")
    parser.add_argument("--bbox", metavar="W,S,E,N", help="degrees; without it, everything")


def span(arguments: argparse.Namespace) -> tuple[int, int]:
    """From when until when [ns], of the options of `add_part`.

    Raises:
        InputError: one of them is no time.
    """
    since = 0 if arguments.since is None else moment(arguments.since, "from")
    return since, time.time_ns() if arguments.until is None else moment(arguments.until, "to")


def _command(
    commands: Commands, name: str, run: Callable[[argparse.Namespace], str], what: str
) -> argparse.ArgumentParser:
    parser = commands.add_parser(name, help=what)
    parser.add_argument("--archive", metavar="DIR", type=Path, required=True, help="of a service, running or not")
    parser.set_defaults(command=lambda arguments: _done(arguments, run))
    return parser


def _done(arguments: argparse.Namespace, run: Callable[[argparse.Namespace], str]) -> int:
    if not arguments.archive.is_dir():
        raise InputError("archive", f"{arguments.archive} is no folder", "give the archive of a service")
    try:
        print(run(arguments))
    except OSError as error:
        raise InputError("archive", f"cannot use {error.filename} ({error.strerror})", "nothing is lost") from error
    return 0


def _compact(arguments: argparse.Namespace) -> str:
    from fleet_service.archive import mirror, rollup
    from fleet_service.archive.compaction import ROUND_ROWS, compact

    rows = ROUND_ROWS if arguments.round_rows is None else arguments.round_rows
    if rows < 1:
        raise InputError("round-rows", f"{rows} is below 1", "give the rows of one round")
    done = compact(arguments.archive, rows)
    parts = rollup.complete(arguments.archive)
    said = f"{done.rows} rows of {done.segments} segments moved into {done.files} files, {parts} rolled up"
    return said if arguments.to is None else f"{said}, {mirror.put(arguments.archive, arguments.to)} put"


def _retention(arguments: argparse.Namespace) -> str:
    from fleet_service.archive.retention import retire

    done = retire(arguments.archive, arguments.raw_days, datetime.now(UTC).date())
    return f"raw rows of {done.days} days removed, {done.files} files; their roll-ups stay"


def _forget(arguments: argparse.Namespace) -> str:
    from fleet_service.archive.retention import forget_period, forget_vehicle

    if arguments.vehicle is None:
        forget_period(arguments.archive, arguments.period)
        return f"the key of {arguments.period} is destroyed"
    return f"{forget_vehicle(arguments.archive, arguments.vehicle, arguments.period)} rows removed"


def _export(arguments: argparse.Namespace) -> str:
    from fleet_service.archive import export
    from schemas import query

    bbox = query.parse({} if arguments.bbox is None else {"bbox": arguments.bbox}).bbox
    part = export.Extract(*span(arguments), bbox)
    table = export.WHAT[arguments.what](arguments.archive, part)
    export.write(table, arguments.out)
    return f"{table.num_rows} rows in {arguments.out}"
