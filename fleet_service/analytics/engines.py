"""Query engines: DuckDB in this process, or Spark. Both present the archive's files as the same
Ibis tables.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final, TypeAlias

import pyarrow as pa
import pyarrow.parquet as pq

from fleet_service.archive.export.extract import Extract
from fleet_service.archive.format import layout, snapshots
from schemas.errors import InputError
from schemas.runtime import spark
from schemas.runtime.installing import install_command
from schemas.thresholds import EXCITED_SHARE, NS
from schemas.wire import Kind

try:
    import ibis
except ImportError as error:
    raise InputError("analyze", "Ibis is not installed", install_command("analytics")) from error

Table: TypeAlias = Any  # an ibis.Table, whose package has no types
ENGINES: Final = ("duckdb", "spark")
_MAP_COLUMNS: Final = (
    # Ibis cannot read geometries with a coordinate system, so geometry is left out. Before format
    # 1.2, lower bounds had a μ, too.
    "cell, sector, CASE WHEN basis = 'bound' THEN NULL ELSE mu END AS mu, mu_lower, mu_upper, "
    "basis, vehicles"
)
NAMES: Final = {"observations": layout.TABLES[Kind.OBSERVATION], "map": snapshots.TABLE}


@dataclass
class QueryEngine:
    """Connection to a query engine (DuckDB or Spark), with the files of the selected part of an
    archive.

    Args:
        name: one of ENGINES.
        root: folder of the archive; only compacted (sorted) files are read.
        extract: selected times and box.
        progress: True to let the engine draw its own progress bar.

    Raises:
        InputError: the engine is not installed.
    """

    name: str
    root: Path
    extract: Extract
    progress: bool = False

    def __post_init__(self) -> None:
        self._spark: Any = None
        if self.name == "spark":
            self._spark = spark.open_session(progress=self.progress)
            self.connection = ibis.pyspark.connect(self._spark)
        else:
            self.connection = ibis.duckdb.connect()
            self.connection.raw_sql("SET TimeZone = 'UTC'")
            # Cache file footers, which helps questions about few rows.
            self.connection.raw_sql("SET parquet_metadata_cache = true")
            if self.progress:  # in a notebook, even "false" would require ipywidgets
                self.connection.raw_sql("SET enable_progress_bar = true")

    def files(self, table: str) -> list[Path]:
        """Return the archive files of a table that may contain rows of the selected part. Files of
        map snapshots are also returned for the day before, because values are compared with earlier
        snapshots.
        """
        before = 1 if table == "map" else 0
        first = self.extract.since // layout.DAY_NS - before
        last = self.extract.until // layout.DAY_NS
        pattern = "*.parquet" if table == "map" else "*/*.parquet"
        return [
            path
            for folder in layout.day_folders(self.root, NAMES[table], first, last)
            for path in sorted(folder.glob(pattern))
        ]

    def observations(self) -> Table:
        """Return a table of the selected observations; `time` is in seconds since 1970, `day` is a
        date.

        Raises:
            InputError: there are no observations.
        """
        paths = self.files("observations")
        if not paths:
            problem = f"no compacted observations in {self.root} for these days"
            raise InputError(
                "archive", problem, "run fleet-service compact, or choose another period"
            )
        t = self._read("observations", paths, "leave_time", "time")
        t = t.mutate(day=t.date.cast("date"))
        t = t.filter(t.time >= self.extract.since // NS, t.time < -(-self.extract.until // NS))
        if self.extract.bbox is not None:
            west, south, east, north = self.extract.bbox
            t = t.filter(
                t.longitude >= west, t.longitude < east, t.latitude >= south, t.latitude < north
            )
        return t

    def maps(self) -> Table:
        """Return a table of the map's snapshots; `snapshot` is the time of the snapshot in seconds
        since 1970.

        Raises:
            InputError: there are no snapshots.
        """
        paths = self.files("map")
        if not paths:
            raise InputError(
                "archive",
                f"no snapshots of the map in {self.root}",
                "let the service write hourly snapshots (service.snapshot_s above 0)",
            )
        return self._read("map", paths, "snapshot_time", "snapshot", _MAP_COLUMNS)

    def rows(self) -> int:
        """Return the number of observations in the selected files. Only the footers of the Parquet
        files are read, not their rows.
        """
        return sum(int(pq.read_metadata(path).num_rows) for path in self.files("observations"))

    def answer(self, expression: Table) -> pa.Table:
        """Evaluate an Ibis expression (query) and return its result as an Arrow table."""
        found: pa.Table = expression.to_pyarrow()
        return found

    def _read(
        self, name: str, paths: Sequence[Path], moment: str, seconds: str, columns: str = "*"
    ) -> Table:
        """Return a table of the given files with one additional column: a time in whole seconds
        since 1970. Queries use the additional column instead of the original time column, because
        DuckDB and Spark convert times differently.

        Args:
            name: name of the table.
            paths: Parquet files.
            moment: name of the original time column.
            seconds: name of the additional column.
            columns: names of the other columns to read, separated by commas.
        """
        texts = [str(path) for path in paths]
        if self._spark is None:
            quoted = ", ".join("'" + text.replace("'", "''") + "'" for text in texts)
            files = f"read_parquet([{quoted}], hive_partitioning = true, union_by_name = true)"
            whole = f"epoch_us({moment}) // 1000000 AS {seconds}"
            self.connection.raw_sql(
                f"CREATE OR REPLACE VIEW {name} AS SELECT {columns}, {whole} FROM {files}"
            )
        else:
            found = (
                self._spark.read.option("basePath", str(self.root / NAMES[name]))
                .option("mergeSchema", "true")
                .parquet(*texts)
            )
            found.selectExpr(
                *columns.split(", "), f"unix_seconds({moment}) AS {seconds}"
            ).createOrReplaceTempView(name)
        return self.connection.table(name)


def has_value(t: Table) -> Any:  # noqa: ANN401 a boolean column of Ibis
    """Return a condition that is true for rows with a value of mu, and false for rows with only a
    lower bound. A row has a value if the vehicle used at least the share EXCITED_SHARE of the
    friction mu that it reports (the rule is in `schemas/README.md`).

    Rows with NaN are excluded explicitly, because both engines treat NaN as larger than any number.
    """
    share = ibis.literal(EXCITED_SHARE - _NEARLY, "float64")
    enough = t.mu_utilised.cast("float64") >= share * t.mu.cast("float64")
    return ~t.mu.isnan() & ~t.mu_utilised.isnan() & enough


# Tolerance far below the columns' steps, so that engines with different rounding agree.
_NEARLY: Final = 1e-6
