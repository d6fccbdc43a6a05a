"""`contract`: for each link of a road network, whether the friction that a maintenance contract
requires was kept, and the longest breach.

A link is divided into pieces of PIECE_M, and the worst piece counts, so that ice on a tenth of the
link is not averaged away. Values are collected in time slots of SLOT_S. They are averaged per
vehicle first, so that a car that passes ten times counts once. A slot is certainly below the
required level if the 90 % interval of its mean lies below the level. The level is certainly kept if
this interval lies above the level. A breach begins with a slot below the level and ends with the
next slot that is not below the level. `least_s` is the duration of the longest certain breach.
`most_s` is the longest possible breach: from a slot in which the level was certainly kept to the
next such slot. Unmeasured time is unknown, and never counts as kept.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any, Final, NamedTuple

import ibis
import numpy as np
import pyarrow as pa
from scipy.stats import t as student

from fleet_service.analytics.engines import QueryEngine, Table, has_value
from fleet_service.analytics.options import Options
from fleet_service.analytics.roads.join import read_roads
from schemas.errors import InputError
from schemas.numeric import BoolArray, FloatArray, IntArray
from schemas.thresholds import Z_95

SLOT_S: Final = 1800
PIECE_M: Final = 50.0  # [m] about the distance in which a sliding car stops in a town
LEAST_SHARE: Final = 0.8  # least measured share of a link's length for the verdict "kept"
# [s] Slots below the level that are farther apart count as two breaches, because the road may have
# been salted in between.
GAP_S: Final = 7200
INTERVAL_STD: Final = 2.0 * Z_95  # width of a 90 % interval in standard deviations
# Standard deviation of a vehicle's error that its interval does not cover: tyres, calibration.
LEAST_STD: Final = 0.05
KEPT = "kept"
BROKEN = "broken"
UNKNOWN = "unknown"
_ROW: Final[dict[str, pa.DataType]] = {
    "link": pa.string(),
    "direction": pa.string(),
    "name": pa.string(),
    "verdict": pa.string(),
    "breach_s": pa.int64(),
    "least_s": pa.int64(),
    "most_s": pa.int64(),
    "begin": pa.int64(),
    "mu_worst": pa.float64(),
    "mu_worst_lower": pa.float64(),
    "mu_worst_upper": pa.float64(),
    "measured_share": pa.float64(),
    "length_m": pa.float64(),
    "vehicles": pa.int64(),
    "values": pa.int64(),
}


def expression(t: Table, places: Table) -> Table:
    """Return a table with the mean of each vehicle's values of mu, for each piece of a road link
    and each time slot, and with the mean of the variances that the vehicle reported.

    Args:
        t: observations.
        places: table with `cell`, `sector`, `link`, `direction`, `piece`.
    """
    t = t.filter(has_value(t)).mutate(slot=(t.time / SLOT_S).floor().cast("int64"))
    std = (t.mu_upper.cast("float64") - t.mu_lower.cast("float64")) / INTERVAL_STD
    t = t.mutate(y=t.mu.cast("float64"), variance=std * std)
    rows = t.inner_join(
        places, [t.cell == places.cell, t.sector == places.sector], rname="place_{name}"
    )
    return rows.group_by(["link", "direction", "piece", "slot", "vehicle"]).aggregate(
        y=rows.y.mean(), variance=rows.variance.mean(), values=rows.count()
    )


def ask(engine: QueryEngine, options: Options) -> pa.Table:
    """Return a table with one row per measured road link and direction, the worst first: how far
    the friction required by the contract was kept.

    Raises:
        InputError: the table of roads, the required level, or the time within which it must be
            restored is missing.
    """
    if options.roads is None:
        raise InputError(
            "roads",
            "the table of roads is missing",
            "create it: fleet-service roads EXTRACT --out roads.parquet",
        )
    if options.level is None or options.within_s is None:
        missing = "level" if options.level is None else "within"
        raise InputError(missing, "is missing for contract", "give e.g. --level .35 --within 4h")
    roads = read_roads(Path(options.roads))
    t = engine.observations()
    middle = (roads["from_m"].to_numpy() + roads["to_m"].to_numpy()) / 2.0
    roads = roads.append_column("piece", pa.array((middle // PIECE_M).astype(np.int64)))
    places = roads.select(["cell", "sector", "link", "direction", "piece"])
    found = engine.answer(expression(t, ibis.memtable(places)))
    if not found.num_rows:
        options.report(f"no measured friction lies on a road of {options.roads}: its coordinates?")
    span = engine.answer(t.aggregate(begin=t.time.min(), end=t.time.max())).to_pylist()[0]
    seen = engine.answer(t.filter(has_value(t)).select("cell", "sector").distinct())
    return _link_rows(found, roads, seen, (span["begin"], span["end"]), options)


def slot_intervals(found: pa.Table) -> dict[str, FloatArray]:
    """Return arrays by name with mean and 90 % interval of mu for each piece of a road link and
    each time slot, computed from the values of its vehicles.

    The error of a mean is the larger of two estimates: from the spread between vehicles, and from
    the intervals that they reported.
    """
    y = found["y"].to_numpy()
    variance = found["variance"].to_numpy()
    key = found["key"].to_numpy()
    first, which, n = np.unique(key, return_index=True, return_inverse=True, return_counts=True)[1:]
    mean = np.bincount(which, y) / n
    spread = np.bincount(which, (y - mean[which]) ** 2) / np.maximum(n - 1, 1)
    reported = np.bincount(which, variance + LEAST_STD**2) / n
    several = n > 2
    factor = np.where(several, student.ppf(0.95, np.maximum(n - 1, 1)), INTERVAL_STD / 2.0)
    error = np.maximum(
        factor * np.sqrt(np.where(several, spread, 0.0) / n),
        INTERVAL_STD / 2.0 * np.sqrt(reported / n),
    )
    return {"first": first, "mu": mean, "lower": mean - error, "upper": mean + error, "vehicles": n}


def longest_breach(
    slot: IntArray,
    lower: FloatArray,
    mu: FloatArray,
    upper: FloatArray,
    level: float,
    span: tuple[int, int],
) -> tuple[int, int, int, int]:
    """Return four numbers [s] for one piece of a road link. The first three are durations: of the
    longest breach according to the means, of the longest certain breach, and of the longest
    possible breach. The fourth is the begin of the longest breach according to the means (0 if
    there is none).

    Args:
        slot: (n,) numbers of time slots, ascending.
        lower, mu, upper: (n,) 90 % interval and mean of the friction in each slot.
        level: friction that the maintenance contract requires.
        span: begin and end [s] of all measurements. Nothing is known outside this time, so the
            parts of slots outside it are not counted.
    """
    begins = np.maximum(slot * SLOT_S, span[0])
    closes = np.minimum((slot + 1) * SLOT_S, span[1])
    first, after = _find_runs(mu < level)
    ends = np.where(after < len(slot), begins[np.minimum(after, len(slot) - 1)], closes[after - 1])
    lasted = ends - begins[first]
    far = np.append(False, np.diff(begins) > GAP_S)
    sure, over = _find_runs(upper < level, far)
    surely = closes[over - 1] - begins[sure]
    is_kept = lower >= level
    unsure = np.append(begins[is_kept], span[1]) - np.append(span[0], closes[is_kept])
    begin = int(begins[first[lasted.argmax()]]) if len(first) else 0
    return int(lasted.max(initial=0)), int(surely.max(initial=0)), int(unsure.max(initial=0)), begin


def _find_runs(is_below: BoolArray, far: BoolArray | None = None) -> tuple[IntArray, IntArray]:
    """Return two arrays for the runs of successive True values in `is_below`: the first position of
    each run, and the position after its last value. `far` is True for each position that follows a
    gap in time; if it is given, no run extends across such a gap.
    """
    number = np.cumsum(~is_below if far is None else ~is_below | far)
    at = np.flatnonzero(is_below)
    new = np.append(True, np.diff(number[at]) != 0)[: len(at)]
    return at[new], at[np.append(new[1:], True)[: len(at)]] + 1


class _Measured(NamedTuple):
    """Measurements of one road link.

    Attributes:
        pieces: for each piece (part of the link, PIECE_M long), the indices of its time slots in
            the result of `slot_intervals`.
        vehicles: vehicles that measured the link.
        values: numbers of friction values, one item per piece, time slot and vehicle.
    """

    pieces: dict[int, list[int]]
    vehicles: set[str]
    values: list[int]


_PieceSlot = tuple[str, str, int, int]  # link, direction, piece, time slot


def _link_rows(
    found: pa.Table, roads: pa.Table, seen: pa.Table, span: tuple[int, int], options: Options
) -> pa.Table:
    about = {
        (row["link"], row["direction"]): row
        for row in roads.group_by(["link", "direction"], use_threads=False)
        .aggregate([("name", "first"), ("length_m", "first")])
        .to_pylist()
    }
    share = _measured_share(roads, seen)
    rows = found.to_pylist()
    names = [
        (str(row["link"]), str(row["direction"]), int(row["piece"]), int(row["slot"]))
        for row in rows
    ]
    keys = sorted(set(names))
    number = {key: k for k, key in enumerate(keys)}
    found = found.append_column("key", pa.array([number[key] for key in names], pa.int64()))
    each = slot_intervals(found)
    out = [
        {
            "link": key[0],
            "direction": key[1],
            "name": about[key]["name_first"],
            "measured_share": share[key],
            "length_m": about[key]["length_m_first"],
            **_judge_link(own, keys, each, span, options, share[key]),
        }
        for key, own in _group_by_link(rows, names, keys).items()
    ]
    return pa.Table.from_pylist(out, schema=pa.schema(_ROW))


def _group_by_link(
    rows: list[dict[str, Any]], names: list[_PieceSlot], keys: list[_PieceSlot]
) -> dict[tuple[str, str], _Measured]:
    """Return the measurements of each road link and direction. `names` are the pieces and slots of
    the `rows`, and `keys` those of the result of `slot_intervals`.
    """
    links: dict[tuple[str, str], _Measured] = {}
    for (link, direction, _, _), row in zip(names, rows, strict=True):
        own = links.setdefault((link, direction), _Measured({}, set(), []))
        own.vehicles.add(row["vehicle"])
        own.values.append(int(row["values"]))
    for k, (link, direction, piece, _) in enumerate(keys):
        links[link, direction].pieces.setdefault(piece, []).append(k)
    return links


def _judge_link(
    own: _Measured,
    keys: list[_PieceSlot],
    each: dict[str, FloatArray],
    span: tuple[int, int],
    options: Options,
    share: float,
) -> dict[str, Any]:
    """Return the columns of one road link that follow from its measurements: verdict, breaches, and
    the interval of its worst piece and slot. `share` is the measured share of the link's length.
    """
    level = options.level or 0.0
    within = options.within_s or 0.0
    breaches = []
    for of_piece in own.pieces.values():
        slot = np.array([keys[k][3] for k in of_piece], np.int64)
        lower = each["lower"][of_piece]
        mu = each["mu"][of_piece]
        upper = each["upper"][of_piece]
        breaches.append(longest_breach(slot, lower, mu, upper, level, span))
    by_mean, begin = max((one[0], one[3]) for one in breaches)
    least = max(one[1] for one in breaches)
    most = max(one[2] for one in breaches)
    worst = min(
        (k for of_piece in own.pieces.values() for k in of_piece),
        key=lambda k: float(each["mu"][k]),
    )
    enough = share >= LEAST_SHARE and len(own.vehicles) >= options.least_vehicles
    verdict = UNKNOWN
    if least > within:
        verdict = BROKEN
    elif most <= within and enough:
        verdict = KEPT
    return {
        "verdict": verdict,
        "breach_s": by_mean,
        "least_s": least,
        "most_s": most,
        "begin": begin or None,
        "mu_worst": each["mu"][worst],
        "mu_worst_lower": each["lower"][worst],
        "mu_worst_upper": each["upper"][worst],
        "vehicles": len(own.vehicles),
        "values": sum(own.values),
    }


def _measured_share(roads: pa.Table, seen: pa.Table) -> dict[tuple[str, str], float]:
    """Return, for each road link and direction, the share of the link's length that lies in cells
    with a value of friction.
    """
    rows = roads.join(seen, ["cell", "sector"], join_type="inner").sort_by("from_m")
    total: dict[tuple[str, str], float] = {}
    reached: dict[tuple[str, str], float] = {}
    for row in rows.select(["link", "direction", "from_m", "to_m", "length_m"]).to_pylist():
        key = (row["link"], row["direction"])
        new = max(row["to_m"] - max(row["from_m"], reached.get(key, 0.0)), 0.0)
        total[key] = total.get(key, 0.0) + new / max(row["length_m"], 1e-9)
        reached[key] = max(reached.get(key, 0.0), row["to_m"])
    return {key: min(share, 1.0) for key, share in total.items()}
