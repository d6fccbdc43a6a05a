"""The README file of an archive: folders, and every column with unit and meaning, generated from
the contract (the tables in `schemas/tables.py`).
"""

from __future__ import annotations

from pathlib import Path
from typing import Final

from schemas import mugrid, tables
from schemas.runtime.durable import open_durably
from schemas.tables import Field

NAME: Final = "README.md"
_HEAD: Final = f"""# A GripMap archive

Road friction measured by vehicles. The files are plain Parquet (zstd), partitioned by date of
measurement (UTC) and z7 zone (a quadkey behind the letter q); pyarrow, pandas, polars, DuckDB,
Spark and GeoPandas can read them directly. Unit and meaning of a column are also in its field
metadata. This page is generated.

| folder | holds |
|---|---|
| `observations/date=…/zone=…/` | a row per visit of a vehicle to a cell; sorted by cell and time |
| `states/date=…/zone=…/` | position and motion of vehicles; sorted in the same way |
| `map/date=…/` | snapshots of the map, one per hour; GeoParquet 1.1 |
| `rollup/cell_hour/date=…/zone=…/` | mergeable statistics by cell, sector and hour; never removed |
| `weather/` | road weather that the map used |
| `inbox/`, `drafts/`, `keys/`, `checkpoints/`, `requests/` | private: do not read or change |

```python
import duckdb
duckdb.sql('''select cell, sector, count(distinct vehicle), median(mu) filter (value) as mu,
                     max(mu_utilised) as at_least
              from 'observations/*/*/*.parquet' group by cell, sector''')
```

- mu is the peak tyre–road adhesion coefficient, mean of the four wheels. NaN means unknown, which
  does not mean dry.
- `value` is true if mu was measured. If it is false, the vehicle used little grip and mu is mostly
  a prior. Leave such rows out of every mean, median and colour. It is only known that mu is at
  least `mu_utilised`.
- `log_likelihood`: {mugrid.BINS} bytes for {mugrid.BINS} equal bins of mu on [{mugrid.LOWER},
  {mugrid.UPPER}]; byte k is {mugrid.STEPS_PER_NAT} times the distance of bin k below the best bin
  in nats. Add the values of several vehicles to combine their evidence; a mean of mu ignores its
  uncertainty.
- `cell` is a quadint: the base-4 digits of a Web-Mercator quadkey of zoom 21; a parent is a shift,
  `cell >> 2*(21-z)`.
- `vehicle` is a pseudonym that changes with the month.
- `late` rows were not fused into the map; `weight` is the weight of the vehicle's vote.
"""
_TABLES: Final[tuple[tuple[str, tuple[Field, ...]], ...]] = (
    ("observations", tables.OBSERVATION_KEPT),
    (
        "states",
        tables.stored_columns(
            *tables.STATE, *tables.IDENTITY, tables.STATE_CELL, *tables.BOOKKEEPING[:1]
        ),
    ),
    ("map", tables.MAP_KEPT),
    ("rollup/cell_hour", tables.CELL_HOUR),
)


def page_text() -> str:
    """Return the text of the archive's README: folders, and every column with unit and meaning."""
    parts = [_HEAD]
    for name, fields in _TABLES:
        parts.append(f"\n## `{name}`\n\n| column | type | unit | meaning |\n|---|---|---|---|\n")
        parts += [
            f"| `{f.name}` | {f.type} | {_escape_cell(f.unit)} | {_field_meaning(f)} |\n"
            for f in fields
        ]
    return "".join(parts)


def _field_meaning(f: Field) -> str:
    return _escape_cell(f.meaning) + (f"; multiples of {f.step:g}" if f.step else "")


def _escape_cell(value: str) -> str:
    return value.replace("|", "\\|")


def write_if_outdated(root: Path) -> None:
    """Write the README into an archive if it is missing or outdated. A README that GripMap did not
    write stays unchanged.

    Raises:
        OSError: the file cannot be written.
    """
    path = root / NAME
    page = page_text().encode()
    # Read bytes and not text, because a power loss may have left invalid content.
    current = path.read_bytes() if path.exists() else b""
    if current != page and (
        not current.strip(b"\0") or current.startswith(_HEAD.splitlines()[0].encode())
    ):
        with open_durably(path) as file:
            file.write(page)
