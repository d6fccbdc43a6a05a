"""The README of every archive: folders, and every column with unit and meaning, from the
contract.
"""

from __future__ import annotations

from pathlib import Path
from typing import Final

from schemas import mugrid, tables
from schemas.runtime.durable import open_durably
from schemas.tables import Field

NAME: Final = "README.md"
_HEAD: Final = f"""# A GripMap archive

Road grip as vehicles measured it. Plain Parquet (zstd), partitioned by date of measurement (UTC) and z7 zone (a quadkey
behind the letter q); pyarrow, pandas, polars, DuckDB, Spark and GeoPandas read it as it stands. Unit and meaning of a
column are in its field metadata too. This page is generated.

| folder | holds |
|---|---|
| `observations/date=…/zone=…/` | what each vehicle learned about each cell it visited; sorted by cell and time |
| `states/date=…/zone=…/` | where vehicles were and how they moved; sorted likewise |
| `map/date=…/` | the map as it was, an hour apart; GeoParquet 1.1 |
| `rollup/cell_hour/date=…/zone=…/` | parts of statistics per cell, sector and hour; they add up, and stay for ever |
| `weather/` | reports of road weather that the map was made with |
| `inbox/`, `drafts/`, `keys/`, `checkpoints/`, `requests/` | private to the service: do not read or change them |

```python
import duckdb
duckdb.sql('''select cell, sector, count(distinct vehicle), median(mu) filter (value) as mu,
                     max(mu_utilised) as at_least
              from 'observations/*/*/*.parquet' group by cell, sector''')
```

- mu is the peak tyre–road adhesion coefficient, mean of the four wheels. NaN is "not said", which is not "dry".
- `value` says whether mu is a value. Where it is false, mu is mostly the prior of a vehicle that merely rolled: leave
  it out of every mean, median and colour; all that is known is that mu is at least `mu_utilised`.
- `log_likelihood`: {mugrid.BINS} bytes for {mugrid.BINS} equal bins of mu on [{mugrid.LOWER}, {mugrid.UPPER}]; byte k
  is {mugrid.STEPS_PER_NAT} times how many nats bin k lies below the best. Sums over vehicles are evidence, means of mu
  are opinions.
- `cell` is a quadint: the base-4 digits of a Web-Mercator quadkey of zoom 21; a parent is a shift, `cell >> 2*(21-z)`.
- `vehicle` is a pseudonym that changes with the month.
- `late` rows were not fused into the map; `weight` is what the vehicle's vote counted.
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
    """Return the text of the archive's README."""
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
    """Write the page into an archive if it is missing or outdated. A foreign page of that name
    stays.

    Raises:
        OSError: it cannot be written.
    """
    path = root / NAME
    page = page_text().encode()
    there = path.read_bytes() if path.exists() else b""  # bytes: power loss may have left any
    if there != page and (
        not there.strip(b"\0") or there.startswith(_HEAD.splitlines()[0].encode())
    ):
        with open_durably(path) as file:
            file.write(page)
