"""Roll-up: additive statistics per cell, heading sector and hour. They stay when the rows from
which they were computed are removed.

    rollup/cell_hour/date=2026-01-31/zone=q1202310/NAME.parquet

There is one file (a part) per compacted (sorted) file, with the same name. An hour's statistics are
the sum over all parts. Therefore a missing part can be computed at any time, and a part is computed
again when its rows are rewritten.

How parts are merged (columns of `tables.CELL_HOUR`)
    sums, counts     add
    mu_min, mu_max   minimum, maximum
    vehicle_bits     bitwise OR

The 64 bits `vehicle_bits` serve to count distinct vehicles over several parts. Each vehicle sets
one bit, which its pseudonym selects. V vehicles set about 64·(1 - exp(-V/64)) bits, so the estimate
is V ≈ -64·ln(share of zero bits) (linear counting: Whang, Vander-Zanden and Taylor 1990, eq. 2).
"""

from __future__ import annotations

from pathlib import Path
from typing import Any, Final

import numpy as np
import pyarrow as pa

from fleet_service.archive.format import layout, segments
from fleet_service.archive.format.files import ROLLUP, put_in_place
from fleet_service.archive.format.load import Damaged, load_rows, set_aside
from schemas import mugrid, tables
from schemas.numeric import IntArray
from schemas.wire import Kind

TABLE: Final = "rollup/cell_hour"
HOUR_NS: Final = 3_600_000_000_000
_COLUMNS: Final = [
    "cell",
    "sector",
    "leave_time",
    "vehicle",
    "mu",
    "mu_utilised",
    "log_likelihood",
    "weight",
    "late",
]
_BITS: Final = 64


def part_of(path: Path, below: Path | None = None) -> Path:
    """Return the path of the hourly statistics (roll-up part) that belong to a compacted (sorted)
    file of observations. With `below`, the path is below that folder instead of the archive.
    """
    root = path.parents[3] if below is None else below
    return root / TABLE / path.parents[1].name / path.parent.name / path.name


def complete_parts(root: Path, until_day: int | None = None) -> int:
    """Compute the missing hourly statistics (roll-up parts) of an archive; return the number of
    files written.

    Raises:
        OSError: a file cannot be read or written.
    """
    missing = [
        path
        for path in layout.compacted_files(root, Kind.OBSERVATION, until_day=until_day)
        if not part_of(path).exists()
    ]
    for path in missing:
        make_part(root, path)
    return len(missing)


def make_part(root: Path, path: Path) -> None:
    """Compute and write the hourly statistics (roll-up part) of one compacted (sorted) file;
    existing statistics are replaced.

    Raises:
        OSError: a file cannot be read or written.
    """
    table = compute_part(path, set_aside)
    if table is not None:
        put_in_place(root, table, part_of(path), ROLLUP)


def compute_part(path: Path, damaged: Damaged) -> pa.Table | None:
    """Return the hourly statistics (roll-up part) of one compacted (sorted) file as a table. If the
    file is damaged, call `damaged` and return None.

    Raises:
        OSError: the file cannot be read.
    """
    table = load_rows(path, tables.OBSERVATION_ARCHIVE, _COLUMNS, damaged=damaged)
    return None if table is None else roll_up(table)


def roll_up(table: pa.Table) -> pa.Table:
    """Return additive statistics of observations (sums, counts, extremes) per cell, heading sector
    and hour, sorted in this order.
    """
    rows = segments.rows_of(table)
    hour = rows["leave_time"] // HOUR_NS
    order = np.lexsort((hour, rows["sector"], rows["cell"]))
    rows = {name: column[order] for name, column in rows.items()}
    hour = hour[order]
    new = np.diff(rows["cell"], prepend=-1).astype(bool) | (np.diff(hour, prepend=-1) != 0)
    starts = np.flatnonzero(new | (np.diff(rows["sector"], prepend=-1) != 0))
    if not len(starts):
        return tables.CELL_HOUR_SCHEMA.empty_table()
    columns = _cell_statistics(rows, starts)
    columns |= {
        "cell": rows["cell"][starts],
        "sector": rows["sector"][starts],
        "hour": hour[starts] * (HOUR_NS // 1000),
    }
    arrays = [_make_array(columns[f.name], f.type) for f in tables.CELL_HOUR_SCHEMA]
    return pa.Table.from_arrays(arrays, schema=tables.CELL_HOUR_SCHEMA)


def _cell_statistics(rows: segments.Rows, starts: IntArray) -> dict[str, Any]:
    n = len(rows["cell"])
    group = np.repeat(np.arange(len(starts)), np.diff(starts, append=n))
    with_mu = ~np.isnan(rows["mu"])
    mu = np.where(with_mu, rows["mu"], 0.0).astype(np.float64)
    bin_ = np.clip(np.searchsorted(mugrid.EDGES, mu, side="right") - 1, 0, mugrid.BINS - 1)
    histogram = np.zeros((len(starts), mugrid.BINS), np.int32)
    np.add.at(histogram, (group[with_mu], bin_[with_mu]), 1)
    _, who = np.unique(rows["vehicle"].astype(str), return_inverse=True)
    names = np.array(
        [int(name[:2], 16) % _BITS for name in np.unique(rows["vehicle"].astype(str))], np.uint64
    )
    pairs = np.unique(group * (int(who.max()) + 1) + who)
    value = segments.is_value(rows["mu"], rows["mu_utilised"])
    return {
        "observations": np.diff(starts, append=n),
        "late": np.add.reduceat(rows["late"].astype(np.int64), starts),
        "vehicles": np.bincount(pairs // (int(who.max()) + 1), minlength=len(starts)),
        "vehicle_bits": np.bitwise_or.reduceat(np.uint64(1) << names[who], starts).view(np.int64),
        "mu_count": np.add.reduceat(with_mu.astype(np.int64), starts),
        "mu_sum": np.add.reduceat(mu, starts),
        "mu_sum_squares": np.add.reduceat(mu * mu, starts),
        "mu_min": np.minimum.reduceat(np.where(with_mu, rows["mu"], np.inf), starts),
        "mu_max": np.maximum.reduceat(np.where(with_mu, rows["mu"], -np.inf), starts),
        "utilised_max": np.fmax.reduceat(rows["mu_utilised"], starts),
        "value_count": np.add.reduceat(value.astype(np.int64), starts),
        "value_sum": np.add.reduceat(np.where(value, mu, 0.0), starts),
        "mu_histogram": histogram,
        "log_likelihood_sum": np.add.reduceat(
            rows["log_likelihood"].astype(np.int32), starts, axis=0
        ),
    }


# `values` are columns of many types.
def _make_array(values: Any, kind: pa.DataType) -> pa.Array[Any]:  # noqa: ANN401
    if pa.types.is_list(kind):
        offsets = np.arange(len(values) + 1, dtype=np.int32) * mugrid.BINS
        buffers = [None, pa.py_buffer(offsets.tobytes())]
        return pa.Array.from_buffers(
            kind, len(values), buffers, children=[pa.array(values.reshape(-1), pa.int32())]
        )
    column: pa.Array[Any] = pa.array(values).cast(kind, safe=False)
    return column
