"""Common tools that read an archive. Each function returns the results of one tool, such as the
number of rows.

A tool that is not installed is left out. Spark has a separate test, because it needs Java and
twenty seconds.
"""

from __future__ import annotations

from collections.abc import Callable
from importlib.util import find_spec
from pathlib import Path
from typing import NamedTuple

from pyarrow import dataset


class Seen(NamedTuple):
    """Results of one tool that has read the observations of an archive: numbers of rows and of rows
    with a likelihood, mean of mu, and zones (map squares of zoom 7).
    """

    rows: int
    mu: float
    with_likelihood: int
    zones: int


def by_pyarrow(root: Path) -> Seen:
    table = dataset.dataset(root / "observations", partitioning="hive").to_table()
    return Seen(
        table.num_rows,
        float(table["mu"].to_numpy().mean()),
        len(table) - table["log_likelihood"].null_count,
        len(table["zone"].unique()),
    )


def by_pandas(root: Path) -> Seen:
    import pandas as pd

    frame = pd.read_parquet(root / "observations")
    return Seen(
        len(frame),
        frame["mu"].mean(),
        frame["log_likelihood"].notna().sum(),
        frame["zone"].nunique(),
    )


def by_polars(root: Path) -> Seen:
    import polars as pl

    frame = pl.scan_parquet(root / "observations", hive_partitioning=True).collect()
    with_likelihood = len(frame) - frame["log_likelihood"].null_count()
    mean = float(frame["mu"].mean())  # type: ignore[arg-type]
    return Seen(len(frame), mean, with_likelihood, frame["zone"].n_unique())


def by_duckdb(root: Path) -> Seen:
    import duckdb

    query = (
        "select count(*), avg(mu), count(log_likelihood), count(distinct zone) from read_parquet(?)"
    )
    with duckdb.connect() as db:
        row = db.execute(query, [str(root / "observations/*/*/*.parquet")]).fetchone()
    assert row is not None
    return Seen(*row)


def by_ibis(root: Path) -> Seen:
    import ibis

    t = ibis.duckdb.connect().read_parquet(
        str(root / "observations/*/*/*.parquet"), hive_partitioning=True
    )
    found = t.aggregate(
        rows=t.count(),
        mu=t.mu.mean(),
        with_likelihood=t.log_likelihood.count(),
        zones=t.zone.nunique(),
    ).to_pyarrow()
    return Seen(*(found[name][0].as_py() for name in Seen._fields))


def by_spark(root: Path) -> Seen:
    from pyspark.sql import SparkSession
    from pyspark.sql import functions as f

    builder = SparkSession.builder.master("local[1]").config("spark.ui.enabled", "false")
    spark = builder.config("spark.sql.session.timeZone", "UTC").getOrCreate()
    frame = spark.read.parquet(str(root / "observations"))
    row = frame.agg(
        f.count("*"), f.avg("mu"), f.count("log_likelihood"), f.count_distinct("zone")
    ).collect()[0]
    return Seen(*row)


READERS: dict[str, Callable[[Path], Seen]] = {
    name: reader
    for name, reader in (
        ("pyarrow", by_pyarrow),
        ("pandas", by_pandas),
        ("polars", by_polars),
        ("duckdb", by_duckdb),
        ("ibis", by_ibis),
    )
    if find_spec(name)
}
