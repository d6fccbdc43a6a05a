"""Export of parts of the archive as GeoParquet, GeoJSON or CSV; the ending of the file name selects
the format.
"""

from __future__ import annotations

import io
import json
import math
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any, Final, NamedTuple

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc
import pyarrow.csv as pacsv

from fleet_service.archive.format import geo, layout, reading, snapshots
from fleet_service.archive.format.files import MAP, write_table
from fleet_service.archive.format.load import load_rows
from fleet_service.archive.format.row_filter import ValueRange
from fleet_service.archive.maintenance import rollup
from schemas import grid, tables
from schemas.errors import InputError
from schemas.numeric import BoolArray
from schemas.runtime import commandline
from schemas.runtime.durable import open_durably
from schemas.thresholds import US_STEP
from schemas.wire import Kind

# columns of the roll-up that describe measured friction
_OF_MU: Final = ("mu_sum", "mu_sum_squares", "mu_min", "mu_max", "value_sum")
Box = tuple[float, float, float, float]


class Extract(NamedTuple):
    """Selected part of the archive: start (included) and end (excluded) of the time range [ns], and
    a box of west, south, east, north [deg] or None for everywhere.
    """

    since: int
    until: int
    bbox: Box | None = None


def read_observations(root: Path, part: Extract) -> pa.Table:
    """Return the selected observations of an archive as a GeoParquet table of points; new rows in
    the inbox (files that are not yet sorted by cell) are included.
    """
    where = [_time_filter("leave_time", part)]
    if part.bbox is not None:
        west, south, east, north = part.bbox
        where.append(ValueRange("longitude", west, math.nextafter(east, -math.inf)))
        where.append(ValueRange("latitude", south, math.nextafter(north, -math.inf)))
    days = (part.since // layout.DAY_NS, part.until // layout.DAY_NS)
    found = [
        *reading.read_tables(root, Kind.OBSERVATION, where=where, days=days),
        tables.OBSERVATION_ARCHIVE.empty_table(),
    ]
    table = pa.concat_tables(found).sort_by([("cell", "ascending"), ("leave_time", "ascending")])
    table = mask_unmeasured(table, ("mu",), table["value"].to_numpy().astype(bool))
    return geo.with_points(table, table["longitude"].to_numpy(), table["latitude"].to_numpy())


def snapshot_time(root: Path, part: Extract) -> int:
    """Return the time [ns] of the last map snapshot before the end of the selected time range."""
    return snapshots.time_of(_find_snapshot(root, part))


def _find_snapshot(root: Path, part: Extract) -> Path:
    path = snapshots.newest_snapshot(root, part.until)
    if path is None:
        raise InputError(
            "to",
            "the archive has no snapshot of the map at or before this time",
            "give a later time",
        )
    return path


def with_vehicles(table: pa.Table, vehicles: int) -> pa.Table:
    """Return the rows of a map snapshot whose cells were visited by at least `vehicles`
    vehicles.
    """
    return table.filter(pc.greater_equal(table["vehicles"], pa.scalar(vehicles, pa.int32())))


def map_then(root: Path, part: Extract) -> pa.Table:
    """Return the last map snapshot before the end of the selected time range, limited to the
    selected box, as a table with cell polygons.
    """
    path = _find_snapshot(root, part)
    table = load_rows(path, tables.MAP_ARCHIVE)
    if table is None:
        raise InputError("to", f"the snapshot {path} is damaged", "give an earlier time")
    # Files before format 1.2 have a number in `mu` even if only a lower bound is known.
    table = mask_unmeasured(table, ("mu",), np.array(table["basis"].to_pylist(), str) != "bound")
    return geo.with_cells(_cells_in_box(table, part.bbox))


def mask_unmeasured(table: pa.Table, names: Sequence[str], known: BoolArray) -> pa.Table:
    """Return the table with nulls in the columns `names` where `known` (n,) is False, which means
    that only a lower bound of friction is known. Without the nulls a map program would colour the
    lower bound like a measured value.
    """
    for name in names:
        column = table[name]
        masked: pa.ChunkedArray[Any] = pc.if_else(
            pa.array(known), column, pa.scalar(None, column.type)
        )
        table = table.set_column(
            table.schema.get_field_index(name), table.schema.field(name), masked
        )
    return table


def cell_hours(root: Path, part: Extract) -> pa.Table:
    """Return the selected hourly statistics per cell (roll-up) as a table with cell polygons."""
    where = [_time_filter("hour", part)]
    days = layout.day_folders(
        root, rollup.TABLE, part.since // layout.DAY_NS, part.until // layout.DAY_NS
    )
    paths = sorted(path for folder in days for path in folder.glob("*/*.parquet"))
    loaded = (load_rows(path, tables.CELL_HOUR_SCHEMA, where=where) for path in paths)
    found = [table for table in loaded if table is not None]
    table = pa.concat_tables([*found, tables.CELL_HOUR_SCHEMA.empty_table()])
    measured = np.nan_to_num(table["value_count"].to_numpy()) > 0  # null before format 1.2
    table = mask_unmeasured(table, _OF_MU, measured)
    return geo.with_cells(
        _cells_in_box(table, part.bbox).sort_by([("cell", "ascending"), ("hour", "ascending")])
    )


WHAT: Final[dict[str, Callable[[Path, Extract], pa.Table]]] = {
    "map": map_then,
    "observations": read_observations,
    "rollup": cell_hours,
}


def _time_filter(column: str, part: Extract) -> ValueRange:
    """Return a filter that a row passes if its time lies within the selected time range: start
    included, end excluded.
    """
    return ValueRange(column, -(-part.since // US_STEP), -(-part.until // US_STEP) - 1)


def _cells_in_box(table: pa.Table, bbox: Box | None) -> pa.Table:
    """Return the rows of the table whose cells touch the box; all rows if the box is None."""
    if bbox is None:
        return table
    return table.filter(pa.array(grid.touches(bbox, grid.bounds(table["cell"].to_numpy()))))


def write_extract(table: pa.Table, path: Path) -> None:
    """Write a GeoParquet table in the format that the ending of the file name selects. CSV omits
    binary and nested columns.

    Raises:
        InputError: the ending is unknown, or the file cannot be written.
    """
    writer = _WRITERS.get(path.suffix)
    if writer is None:
        raise InputError(
            "out", f"{path.name} has no known ending", f"use one of {', '.join(_WRITERS)}"
        )
    with commandline.report_write_errors(path):
        writer(table, path)


def geojson_features(table: pa.Table) -> Iterator[dict[str, Any]]:
    """Yield the rows of a GeoParquet table as GeoJSON features; binary and nested columns are
    omitted.
    """
    flat = _drop_nested(table)
    for geometry, *values in zip(
        geo.geojson_shapes(table),
        *(_json_values(flat, name) for name in flat.schema.names),
        strict=True,
    ):
        properties = dict(zip(flat.schema.names, values, strict=True))
        yield {"type": "Feature", "geometry": geometry, "properties": properties}


def _write_geojson(table: pa.Table, path: Path) -> None:
    with open_durably(path) as raw:
        file = io.TextIOWrapper(raw, encoding="utf-8")
        file.write('{"type": "FeatureCollection", "features": [\n')
        for place, feature in enumerate(geojson_features(table)):
            file.write((",\n" if place else "") + json.dumps(feature, allow_nan=False))
        file.write("\n]}\n")
        file.detach()  # flushes the text; `open_durably` closes the file


def iso_text(us: int) -> str:
    """Return a time [µs since 1970] as ISO 8601 text, UTC."""
    return str(np.datetime_as_string(np.datetime64(us, "us"), "ms", "UTC"))


def _json_values(table: pa.Table, name: str) -> list[Any]:
    """Return a table column as a list of values for JSON: times as ISO 8601 text, null for NaN,
    floats rounded to single precision.
    """
    column = table[name]
    if pa.types.is_timestamp(column.type):
        us = column.cast(tables.US, safe=False).cast(pa.int64()).to_pylist()
        return [None if one is None else iso_text(one) for one in us]
    if pa.types.is_date(column.type):
        return [None if day is None else day.isoformat() for day in column.to_pylist()]
    if pa.types.is_floating(column.type):
        values = column.to_numpy().astype(np.float64).round(6 if column.type == pa.float32() else 9)
        return [value if np.isfinite(value) else None for value in values.tolist()]
    return column.to_pylist()


def _drop_nested(table: pa.Table) -> pa.Table:
    plain = [
        f.name for f in table.schema if not (pa.types.is_nested(f.type) or "binary" in str(f.type))
    ]
    return table.select(plain)


def _write_csv(table: pa.Table, path: Path) -> None:
    with open_durably(path) as file:
        flat = _drop_nested(table)
        for place, name in enumerate(flat.schema.names):
            if pa.types.is_timestamp(flat.schema.field(name).type):
                flat = flat.set_column(place, name, pa.array(_json_values(flat, name), pa.string()))
        pacsv.write_csv(flat, file)


_WRITERS: Final[dict[str, Callable[[pa.Table, Path], None]]] = {
    ".parquet": lambda table, path: write_table(table, path, MAP),
    ".geojson": _write_geojson,
    ".csv": _write_csv,
}
