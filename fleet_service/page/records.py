"""Map cells as 13-byte records for the page, one block per tile. At small zoom levels, cells are
aggregated to the worst value. Pure (no I/O).

A block is a head of 32 bytes followed by its columns, little-endian, so that a browser can use them
without copying: `last` (4 bytes per cell), `place` (2), and `mu`, `lower`, `upper`, `slippery`,
`basis`, `vehicles`, `unknown` (1 each). The length of a block is a multiple of four bytes.
"""

from __future__ import annotations

import struct
from collections.abc import Callable
from typing import Any, Final, NamedTuple

import numpy as np
import pyarrow as pa
from numpy.typing import NDArray

from fleet_service.page.colours import KNOWN_SLIPPERY
from schemas import grid
from schemas.numeric import FloatArray
from schemas.thresholds import NS

# last: newest observation [s since 1970]. place: cell within the tile · 4 + sector. mu, lower,
# upper: in units of 1/MU_STEPS; 255 means no number. slippery: P(μ < .4) in units of 1/SHARE_STEPS.
# vehicles: 255 means 255 or more. unknown: share of the covered cells that were not measured.
RECORD: Final = np.dtype(
    [
        ("last", "<u4"),
        ("place", "<u2"),
        ("mu", "u1"),
        ("lower", "u1"),
        ("upper", "u1"),
        ("slippery", "u1"),
        ("basis", "u1"),
        ("vehicles", "u1"),
        ("unknown", "u1"),
    ]
)
Records = NDArray[np.void]
# tile, version, base version of changes (0: complete tile), number of cells, level, moment
HEAD: Final = struct.Struct("<4IB7xd")
MU_STEPS: Final = 200
SHARE_STEPS: Final = 254
NO_NUMBER: Final = 255
BOUND = 0
MEASURED = 1
BORROWED = 2
GONE = 255
CELL_LEVEL: Final = grid.CELL_ZOOM
LEAST_LEVEL: Final = grid.TILE_ZOOM


class TileBlock(NamedTuple):
    """Block (encoded records of map cells) for a browser: all records of a tile, or only its
    changes.

    Attributes:
        tile: quadint (number) of the tile, zoom 14.
        level: zoom of the records, 14 to 21.
        version: number of changes of the tile, from 1.
        base: version to which the changes apply; 0 for a complete tile.
        moment: time of the data [s since 1970].
        records: records ordered by place. In `basis` (measured, bounded or estimated), GONE means
            that the place has no cell any more.
    """

    tile: int
    level: int
    version: int
    base: int
    moment: float
    records: Records

    def encoded(self) -> bytes:
        """Return the block (map cells of a tile) as bytes: head, then columns."""
        head = HEAD.pack(
            self.tile, self.version, self.base, len(self.records), self.level, self.moment
        )
        names: tuple[str, ...] = RECORD.names or ()
        body = b"".join(self.records[name].tobytes() for name in names)
        return head + body + b"\0" * (-len(body) % 4)


def of_table(table: pa.Table) -> Records:
    """Return the cells of one tile (table in the schema of the map, n rows) as records (n,),
    ordered by place within the tile.

    Intervals are rounded outwards and P(slippery) upwards, so that no cell appears drier than
    reported.
    """
    found = np.zeros(table.num_rows, RECORD)
    found["last"] = np.clip(table["last_time"].cast(pa.int64()).to_numpy() // NS, 0, 2**32 - 1)
    found["place"] = (table["cell"].to_numpy() & 0x3FFF) * grid.SECTORS + table["sector"].to_numpy()
    found["mu"] = _to_steps(np.rint, table["mu"], MU_STEPS)
    found["lower"] = _to_steps(np.floor, table["mu_lower"], MU_STEPS)
    found["upper"] = _to_steps(np.ceil, table["mu_upper"], MU_STEPS)
    found["slippery"] = _to_steps(np.ceil, table["p_slippery"], SHARE_STEPS)
    basis = table["basis"].to_numpy()
    # A lower bound has no value to colour, although older versions state one.
    found["mu"][basis == "bound"] = NO_NUMBER
    # Snapshots of older versions mark known ice as a lower bound.
    known = (basis == "measured") | (
        (basis == "bound") & (found["slippery"] > KNOWN_SLIPPERY * SHARE_STEPS)
    )
    found["basis"] = np.select([known, basis == "borrowed"], [MEASURED, BORROWED], BOUND)
    found["vehicles"] = np.minimum(table["vehicles"].to_numpy(), 255)
    found["unknown"] = np.where(found["basis"] == MEASURED, 0, SHARE_STEPS)
    return found[np.argsort(found["place"], kind="stable")]


def _to_steps(
    rounding: Callable[[FloatArray], FloatArray], column: pa.ChunkedArray[Any], steps: int
) -> NDArray[np.uint8]:
    value = column.to_numpy().astype(np.float64)
    whole = np.clip(rounding(np.nan_to_num(value) * steps), 0, NO_NUMBER - 1)
    return np.where(np.isfinite(value), whole, NO_NUMBER).astype(np.uint8)


def as_values(row: Any) -> dict[str, Any]:  # noqa: ANN401 one record
    """Return the fields of a cell's record as numbers by name; `mu` is None if no value was
    measured.
    """
    measured = row["basis"] != BOUND and row["mu"] != NO_NUMBER
    return {
        "mu": int(row["mu"]) / MU_STEPS if measured else None,
        "mu_lower": int(row["lower"]) / MU_STEPS,
        "mu_upper": int(row["upper"]) / MU_STEPS,
        "p_slippery": min(int(row["slippery"]) / SHARE_STEPS, 1.0),
        "basis": {MEASURED: "measured", BORROWED: "borrowed"}.get(int(row["basis"]), "bound"),
        "vehicles": int(row["vehicles"]),
    }


def aggregate_worst(records: Records, level: int) -> Records:
    """Return records of cells (n,) combined to larger squares (ancestors) at the zoom `level`, from
    14 to 21. All headings of a square are combined.

    A larger square gets, for each quantile of mu, the minimum over the measured cells in it, and
    the largest P(slippery). So it never appears less slippery than a cell in it. `unknown` is the
    share of the cells and headings in the square that have only lower bounds.
    """
    if not len(records):
        return records
    place = (records["place"] >> (2 + 2 * (CELL_LEVEL - level))) << 2
    first = np.flatnonzero(np.append(True, place[1:] != place[:-1]))
    is_measured = records["basis"] == MEASURED
    count = np.diff(np.append(first, len(records)))
    share = 1.0 - np.add.reduceat(is_measured.astype(np.int64), first) / count
    has_measured = np.repeat(share < 1.0, count)
    # Cells with only a lower bound count if no cell of the square was measured.
    is_counted = is_measured | ~has_measured
    found = np.zeros(len(first), RECORD)
    found["place"] = place[first]
    for name in ("mu", "lower", "upper"):
        found[name] = np.minimum.reduceat(np.where(is_counted, records[name], NO_NUMBER), first)
    for name in ("slippery", "vehicles"):
        found[name] = np.maximum.reduceat(np.where(is_counted, records[name], 0), first)
    found["last"] = np.maximum.reduceat(records["last"], first)
    found["basis"] = np.where(share < 1.0, MEASURED, BOUND)
    found["mu"][share == 1.0] = NO_NUMBER
    found["unknown"] = np.ceil(share * SHARE_STEPS)
    return found


def changed_records(before: Records, after: Records) -> Records:
    """Return the records (map cells) that must be applied to the records `before` to obtain
    `after`; all are ordered by place.
    """
    places = np.union1d(before["place"], after["place"])
    old, new = (np.zeros(len(places), RECORD) for _ in range(2))
    for one, records in ((old, before), (new, after)):
        one["basis"] = GONE
        one["place"] = places
        one[np.searchsorted(places, records["place"])] = records
    return np.asarray(new[old != new])
