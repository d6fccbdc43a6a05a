"""Additional map that the page can draw over the live map, such as the true friction of a
simulation. It is read from a Parquet file with the columns cell, heading sector and mu.

The file is read on each request, because it may appear while the page is running.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pyarrow as pa
import pyarrow.parquet as pq

from schemas.errors import InputError


def read_overlay(path: Path | None) -> dict[str, list[Any]] | None:
    """Read an overlay, which is an additional map that the page draws over the live map. Return the
    columns `cell` (numbers as text), `sector` and `mu`; None if `path` is None or the file does not
    exist yet.

    The file may have several rows for a cell and heading sector. `mu` is their mean.

    Raises:
        InputError: the file lacks one of the columns cell, sector and mu.
    """
    if path is None or not path.is_file():
        return None
    try:
        table = pq.read_table(path, columns=["cell", "sector", "mu"], partitioning=None)
    except (OSError, pa.ArrowException) as error:
        raise InputError(
            "overlay",
            f"{path.name} lacks the columns cell, sector and mu",
            "give a file with these columns",
        ) from error
    found = table.group_by(["cell", "sector"]).aggregate([("mu", "mean")])
    return {
        "cell": [str(cell) for cell in found["cell"].to_pylist()],
        "sector": found["sector"].to_pylist(),
        "mu": found["mu_mean"].to_numpy().round(3).tolist(),
    }
