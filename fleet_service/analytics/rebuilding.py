"""Rebuilding of the map and the hourly statistics (roll-up) of an archive from raw observations, on
this machine or on Spark. The archive is processed zone by zone (a zone is a map square of zoom 7).

    OUT/map/date=2026-01-31/zone=q1202310/20260131T070000Z.parquet   the map of one moment, all
                                                                     visited cells
    OUT/rollup/cell_hour/date=2026-01-31/zone=q1202310/NAME.parquet  statistics, one file per
                                                                     compacted file, all days

Once the trust in each vehicle is known, a cell does not depend on distant cells. A zone therefore
needs only its own rows and those of a margin around it, and gives the same result as a replay of
the whole archive. Both engines run the same function for each zone and write the same bytes.
"""

from __future__ import annotations

from collections.abc import Iterator
from functools import partial
from pathlib import Path
from typing import Final, NamedTuple

import pyarrow as pa

from fleet_service.analytics.past_map import LATENESS_S, snapshot_table, visited_cells
from fleet_service.archive.format import layout, snapshots
from fleet_service.archive.format.files import MAP, ROLLUP, Encoding, sync_tree, write_table
from fleet_service.archive.format.load import skip_damaged
from fleet_service.archive.maintenance import rollup
from fleet_service.replay.rebuild import past_fusion
from schemas import grid
from schemas.errors import InputError
from schemas.runtime import spark
from schemas.runtime.durable import own_drafts, sweep_drafts
from schemas.wire import Kind

ENGINES: Final = ("local", "spark")


class Rebuild(NamedTuple):
    """Task of a rebuild of the map and the hourly statistics.

    Attributes:
        root: folder of the archive.
        out: folder for the output.
        until: time of the map [ns].
        lateness_s: allowed delay of observations [s]; observations with a longer delay count less.
    """

    root: Path
    out: Path
    until: int
    lateness_s: float = LATENESS_S


class RebuildResult(NamedTuple):
    """Result for one zone (map square of zoom 7): number of cells of the map, and number of files
    of hourly statistics (roll-up).
    """

    zone: int
    cells: int
    rollup_files: int


def require_empty(out: Path) -> None:
    """Raise an error unless a folder is empty or does not exist yet. Otherwise statistics of
    another archive in this folder would be mixed with the new statistics.

    Raises:
        InputError: the folder has content, or cannot be created.
    """
    try:
        out.mkdir(parents=True, exist_ok=True)
        something = next(out.iterdir(), None)
    except OSError as error:
        raise InputError(
            "out", f"cannot use {out} ({error.strerror})", "name a folder you may write to"
        ) from error
    if something is not None:
        raise InputError(
            "out", f"{out} holds {something.name}", "give a new folder, or empty this one"
        )


def rebuild(request: Rebuild, engine: str = "local") -> Iterator[RebuildResult]:
    """Rebuild all zones of an archive; yield the result of each zone, in order.

    Raises:
        InputError: there are no compacted (sorted) observations, a file has a newer version, or the
            engine (this process or Spark) is unknown or not installed.
        OSError: a file cannot be read or written.
    """
    if engine not in ENGINES:
        raise InputError("engine", f"{engine!r} is unknown", f"use one of {', '.join(ENGINES)}")
    zones = zones_of(request.root)
    if not zones:
        raise InputError(
            "archive", f"no compacted observations in {request.root}", "run fleet-service compact"
        )
    work = partial(rebuild_zone, request)
    yield from (
        map(work, zones)
        if engine == "local"
        else spark.run_tasks(spark.open_session(), zones, work)
    )
    sweep_drafts(request.out)


def zones_of(root: Path) -> list[int]:
    """Return the zones for which an archive has compacted (sorted) observations."""
    return sorted(
        {layout.partition_of(path).zone for path in layout.compacted_files(root, Kind.OBSERVATION)}
    )


def rebuild_zone(request: Rebuild, zone: int) -> RebuildResult:
    """Rebuild one zone of an archive. Repeated or concurrent calls are harmless, because they write
    the same files.

    Raises:
        InputError: a file has a newer version.
        OSError: a file cannot be read or written.
    """
    west, south, east, north = (float(side) for side in grid.bounds(zone, grid.ZONE_ZOOM))
    box = (west, south, east, north)
    cells = visited_cells(
        past_fusion(request.root, request.lateness_s, request.until, box), request.until, box
    )
    cells = cells.filter(pa.array(grid.zone_of(cells["cell"].to_numpy()) == zone))
    zone_folder = f"zone=q{grid.quadkey(zone, grid.ZONE_ZOOM)}"
    with own_drafts(request.out) as drafts:
        place = partial(_write_atomically, request.out, drafts)
        if cells.num_rows:
            path = snapshots.path_of(request.out, request.until)
            place(path.parent / zone_folder / path.name, snapshot_table(cells, request.until), MAP)
        parts = 0
        for path in layout.compacted_files(request.root, Kind.OBSERVATION):
            if layout.partition_of(path).zone == zone and (part := _compute_part(path)) is not None:
                place(rollup.part_of(path, request.out), part, ROLLUP)
                parts += 1
    return RebuildResult(zone, cells.num_rows, parts)


def _compute_part(path: Path) -> pa.Table | None:
    try:
        return rollup.compute_part(path, skip_damaged)
    except FileNotFoundError:
        return None  # retention has removed the files of this day


def _write_atomically(
    out: Path, drafts: Path, path: Path, table: pa.Table, encoding: Encoding
) -> None:
    """Write a file atomically, even if another process writes the same file at the same time."""
    write_table(table, drafts / path.name, encoding, named=False)
    path.parent.mkdir(parents=True, exist_ok=True)
    (drafts / path.name).rename(path)
    sync_tree(out, [path.parent])
