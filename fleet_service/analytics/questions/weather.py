"""`weather`: statistics of the reported values of mu, by the air temperature that the nearest
weather station measured in the same hour.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any, Final

import ibis
import numpy as np
import pyarrow as pa
import pyarrow.compute as pc
import pyarrow.csv as pacsv
import pyarrow.parquet as pq

from fleet_service.analytics.engines import QueryEngine, Table, has_value
from fleet_service.analytics.options import Options
from schemas.errors import InputError
from schemas.thresholds import SLIPPERY_MU

NEEDED: Final = ("station", "time", "latitude", "longitude", "temperature")
RANGES: Final = {
    "latitude": (-90.0, 90.0),
    "longitude": (-180.0, 180.0),
    "temperature": (-90.0, 60.0),
}
FARTHEST_DEG: Final = 0.9  # a station more than 100 km away does not show the local temperature
BAND: Final = 2.0  # [°C] width of the temperature band of one row
_HOUR_S: Final = 3600
_BITS: Final = 22  # bits by which the number of a cell is longer than that of a region: 2·(21 - 10)


def nearest_readings(t: Table, path: Path) -> Table:
    """Return observations with a column `temperature` [°C]: the reading of the nearest station,
    within 100 km, in the same hour.

    Raises:
        InputError: the table of stations cannot be used.
    """
    stations, readings = read_stations(path)
    return _join_stations(t, ibis.memtable(stations), ibis.memtable(readings))


def expression(t: Table, stations: Table, readings: Table) -> Table:
    """Return a table with one row per temperature band [temperature, temperature + BAND): number of
    values, percentiles of mu, and share of slippery values.

    Args:
        t: observations.
        stations: table with `station`, `latitude`, `longitude`.
        readings: table with `station`, `hour`, `temperature` [°C].
    """
    t = _join_stations(t.filter(has_value(t)), stations, readings)
    t = t.mutate(y=t.mu.cast("float64"), band=(t.temperature / BAND).floor() * BAND)
    return t.group_by(temperature=t.band).aggregate(
        values=t.count(),
        vehicles=t.vehicle.nunique(),
        mu_mean=t.y.mean(),
        mu_p10=t.y.quantile(0.1),
        mu_p50=t.y.quantile(0.5),
        share_slippery=(t.y < SLIPPERY_MU).cast("float64").mean(),
    )


def _join_stations(t: Table, stations: Table, readings: Table) -> Table:
    t = t.mutate(region=t.cell >> _BITS, hour=(t.time / _HOUR_S).floor().cast("int64"))
    regions = t.group_by("region").aggregate(lat=t.latitude.mean(), lon=t.longitude.mean())
    pairs = regions.cross_join(stations)
    square = ((pairs.lat - pairs.latitude) ** 2) + (
        (pairs.lon - pairs.longitude) * (pairs.lat * np.pi / 180).cos()
    ) ** 2
    pairs = pairs.mutate(square=square).filter(square < FARTHEST_DEG**2)
    pairs = pairs.mutate(
        rank=ibis.row_number().over(group_by="region", order_by=[pairs.square, pairs.station])
    )
    nearest = pairs.filter(pairs["rank"] == 0).select("region", "station")
    t = t.inner_join(nearest, "region")
    return t.inner_join(
        readings, [t.station == readings.station, t.hour == readings.hour], rname="reading_{name}"
    )


def ask(engine: QueryEngine, options: Options) -> pa.Table:
    """Return a table of the measured friction with one row per band of air temperature, for the
    selected part of the archive. The docstring of `expression` explains the columns.

    Raises:
        InputError: the table of stations is missing, or lacks a column.
    """
    if options.stations is None:
        raise InputError(
            "stations",
            "the table of readings is missing",
            f"give a CSV or Parquet file with {', '.join(NEEDED)}",
        )
    stations, readings = read_stations(options.stations)
    found = engine.answer(
        expression(engine.observations(), ibis.memtable(stations), ibis.memtable(readings))
    )
    if not found.num_rows:
        options.report("no station within 100 km has a reading in the hour of an observation")
    return found


def read_stations(path: Path) -> tuple[pa.Table, pa.Table]:
    """Return two tables: the stations, and the mean temperature readings per station and hour.

    Raises:
        InputError: the file cannot be read, or lacks a column.
    """
    try:
        table = pq.read_table(path) if path.suffix == ".parquet" else pacsv.read_csv(path)
    except (OSError, pa.ArrowInvalid) as error:
        raise InputError(
            "stations", f"cannot read {path} ({error})", "give a CSV or Parquet file"
        ) from error
    missing = [name for name in NEEDED if name not in table.schema.names]
    if missing:
        raise InputError(
            "stations", f"{path.name} has no {missing[0]}", f"give columns {', '.join(NEEDED)}"
        )
    try:
        time = table["time"].cast(pa.timestamp("s"), safe=False).cast(pa.int64())
        numbers = {name: table[name].cast(pa.float64()) for name in NEEDED[2:]}
    except (pa.ArrowInvalid, pa.ArrowNotImplementedError) as error:
        problem = f"{path.name} has an invalid value ({str(error).splitlines()[0][:100]})"
        fix = (
            "write times like 2026-01-31T07:00:00, numbers with a decimal point, and leave "
            "unknown values empty"
        )
        raise InputError("stations", problem, fix) from error
    _check_ranges(path.name, numbers)
    table = pa.table({"station": table["station"].cast(pa.string()), **numbers})
    table = table.append_column("hour", pc.divide(time, _HOUR_S))
    table = table.filter(pc.and_(pc.is_valid(table["temperature"]), pc.is_valid(time)))
    stations = table.group_by("station").aggregate([("latitude", "mean"), ("longitude", "mean")])
    readings = table.group_by(["station", "hour"]).aggregate([("temperature", "mean")])
    return (
        stations.rename_columns(["station", "latitude", "longitude"]),
        readings.rename_columns(["station", "hour", "temperature"]),
    )


def _check_ranges(name: str, numbers: dict[str, pa.ChunkedArray[Any]]) -> None:
    """Raise an InputError if a position or temperature in the file `name` is impossible."""
    for column, (least, most) in RANGES.items():
        for value in (pc.min(numbers[column]).as_py(), pc.max(numbers[column]).as_py()):
            if value is not None and not least <= value <= most:
                problem = f"{name} has the {column} {value:g}, outside {least:g} to {most:g}"
                raise InputError("stations", problem, "give degrees, and degrees Celsius")
