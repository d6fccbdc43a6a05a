"""Example: read an archive with pandas, DuckDB and GeoPandas, and with GripMap's built-in
evaluations ("questions").

python deploy/examples/archive_questions.py ARCHIVE FOLDER
"""

from __future__ import annotations

import sys
from pathlib import Path

import duckdb
import geopandas
import pandas as pd

import fleet_service


def main(archive: Path, folder: Path) -> None:
    """Compute the median friction per cell with DuckDB and with pandas. Find the road stretches
    with the lowest friction with GripMap, and write a map of them for a geographic information
    system.
    """
    folder.mkdir(parents=True, exist_ok=True)
    files = f"{archive}/observations/*/*/*.parquet"
    # If `value` is false, mu is only known to be at least mu_utilised. Such rows are left out.
    sql = f"select cell, sector, median(mu) as mu from '{files}' where value group by all"
    by_duckdb = (
        duckdb.sql(sql)  # type: ignore[union-attr]
        .df()
        .set_index(["cell", "sector"])
        .sort_index()
    )

    rows = pd.concat(
        pd.read_parquet(path) for path in sorted(archive.glob("observations/*/*/*.parquet"))
    )
    by_pandas = rows[rows["value"]].groupby(["cell", "sector"])["mu"].median()
    print(f"largest difference of the two: {(by_duckdb['mu'] - by_pandas).abs().max():.2g}")

    worst = fleet_service.ask_archive(archive, "worst")
    print(worst.drop_columns(["members"]).to_pandas().head().to_string(index=False))
    for ending in ("html", "png", "geo.parquet"):
        fleet_service.write_answer(worst, "worst", folder / f"worst.{ending}")
    stretches = geopandas.read_parquet(folder / "worst.geo.parquet")
    print(
        f"{len(stretches)} stretches, {stretches.geometry.to_crs(3006).area.sum():.0f} square "
        "metres of cells"
    )


if __name__ == "__main__":
    if len(sys.argv) < 2:
        sys.exit("usage: python deploy/examples/archive_questions.py ARCHIVE [FOLDER]")
    main(Path(sys.argv[1]), Path(sys.argv[2] if len(sys.argv) > 2 else "try/questions"))
