"""`change-rates`: how fast roads become slippery or recover, by temperature and by hour, from the
archive's values.

Two successive values of a cell, from different vehicles, are compared. They are unlike if one is
slippery and the other is not. The probability of this after a time Δ is

    P(unlike | Δ) = e + (m − e) (1 − exp(−λ Δ)),   m = 2 π (1 − π)

    λ   rate of change of the road, as in the computation of the map (CHANGE_S is 1/λ)      [1/s]
    e   probability that two values of the same road are unlike because of errors
    m   probability that values of two roads are unlike; π is the share of slippery values in the
        class (a temperature band, or a part of the day)

The map's computation uses the same model of change (`fleet_service/fusion/README.md`). λ and e are
maximum-likelihood estimates over bins of Δ. Roads of a region change together, so pairs of values
are not independent, but days are. Therefore the 90 % interval is computed by bootstrap: days are
drawn with replacement. With fewer than LEAST_DAYS days, no interval is given.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Final

import ibis
import numpy as np
import pyarrow as pa
import pyarrow.compute as pc
from scipy.optimize import minimize

from fleet_service.analytics.engines import QueryEngine, Table, has_value
from fleet_service.analytics.options import Options
from fleet_service.analytics.questions.weather import nearest_readings
from fleet_service.fusion.constants import CHANGE_S
from fleet_service.fusion.weather import AIR_ABOVE_ROAD_C, FREEZING_C, STEADY_C
from schemas.numeric import FloatArray
from schemas.thresholds import SLIPPERY_MU

# [s] Longest time between two compared values; within more time, a road may change repeatedly.
LONGEST_S: Final = 3 * 3600
BINS_PER_OCTAVE: Final = 1
LEAST_DAYS: Final = 5
DRAWS: Final = 200
ENDS: Final = (5.0, 95.0)
HOURS: Final = 6  # length of a class of the time of day [h]
LEAST_PAIRS: Final = 50  # a class with fewer pairs of values gets no answer
UNKNOWN: Final = "unknown"
# road temperature [°C], with the limits of `fusion.weather`
BANDS: Final = (
    (f"below {FREEZING_C[0]:.0f}", -np.inf, FREEZING_C[0]),
    (f"{FREEZING_C[0]:.0f} to {FREEZING_C[1]:.0f}", *FREEZING_C),
    (f"{FREEZING_C[1]:.0f} to {STEADY_C:.0f}", FREEZING_C[1], STEADY_C),
    (f"above {STEADY_C:.0f}", STEADY_C, np.inf),
)


def expression(t: Table) -> Table:
    """Return counts of value pairs by temperature band, part of the day (`hours`), day, and bin of
    elapsed time (`octave`). A pair consists of two successive friction values of one map cell and
    heading sector, from different vehicles.

    The counts are the number of `pairs`, the number of `unlike` pairs (one value slippery, the
    other not), and the number of `slippery` values in all pairs. `seconds` is the sum of the times
    between the two values.

    Args:
        t: observations with `temperature` of the air [°C], null if unknown.
    """
    t = t.filter(has_value(t))
    w = ibis.window(group_by=["cell", "sector"], order_by=["time", "vehicle", "boot", "seq", "row"])
    t = t.mutate(slippery=(t.mu < SLIPPERY_MU).cast("int64"))
    t = t.mutate(
        before=t.slippery.lag().over(w), since=t.time.lag().over(w), by=t.vehicle.lag().over(w)
    )
    t = t.mutate(elapsed_s=(t.time - t.since).cast("float64"))
    t = t.filter(
        t.before.notnull() & (t.by != t.vehicle) & (t.elapsed_s >= 1.0) & (t.elapsed_s <= LONGEST_S)
    )
    road = t.temperature - AIR_ABOVE_ROAD_C
    band = ibis.literal(UNKNOWN)
    for name, low, high in BANDS:
        inside = ibis.literal(True)
        if np.isfinite(low):
            inside &= road > low
        if np.isfinite(high):
            inside &= road <= high
        band = ibis.ifelse(inside, name, band)
    t = t.mutate(
        band=ibis.ifelse(t.temperature.isnull(), UNKNOWN, band),
        hours=((t.time / 3600).floor() % 24 / HOURS).floor().cast("int64"),
        octave=(t.elapsed_s.log2() * BINS_PER_OCTAVE).floor().cast("int64"),
    )
    return t.group_by("band", "hours", "day", "octave").aggregate(
        pairs=t.count(),
        unlike=(t.slippery != t.before).cast("int64").sum(),
        slippery=(t.slippery + t.before).sum(),
        seconds=t.elapsed_s.sum(),
    )


def ask(engine: QueryEngine, options: Options) -> pa.Table:
    """Return a table with one row per band of road temperature (estimated from the air temperature)
    and one per part of the day: how often per hour the road becomes slippery or recovers, the 90 %
    interval of this rate, and the numbers of data on which the rate is based.

    If `stations` is given, temperatures are those of the nearest station, else those that vehicles
    reported.

    Raises:
        InputError: the table of stations cannot be used.
    """
    t = engine.observations()
    if options.stations is None:
        t = t.mutate(temperature=t.air_temperature.cast("float64"))
    else:
        t = nearest_readings(t, options.stations)
    counted = engine.answer(expression(t))
    rows: list[dict[str, object]] = []
    for by, column, names in (
        ("road temperature", "band", [*(band[0] for band in BANDS), UNKNOWN]),
        ("hour of the day (UTC)", "hours", list(range(24 // HOURS))),
    ):
        for one in names:
            part = counted.filter(pc.equal(counted[column], pa.scalar(one)))
            if (pc.sum(part["pairs"]).as_py() or 0) >= LEAST_PAIRS:
                rows.append({"by": by, "class": _band_name(one), **_fit_class(part)})
    return pa.Table.from_pylist(rows, schema=SCHEMA)


_FIELDS: Final[list[tuple[str, pa.DataType]]] = [
    ("by", pa.string()),
    ("class", pa.string()),
    ("pairs", pa.int64()),
    ("days", pa.int64()),
    ("hours_between", pa.float64()),
    ("unlike", pa.int64()),
    ("share_slippery", pa.float64()),
    ("rate_per_hour", pa.float64()),
    ("rate_lower", pa.float64()),
    ("rate_upper", pa.float64()),
    ("misread", pa.float64()),
    ("assumed_per_hour", pa.float64()),
]
SCHEMA: Final = pa.schema(_FIELDS)


def _band_name(one: str | int) -> str:
    return one if isinstance(one, str) else f"{one * HOURS:02}-{(one + 1) * HOURS:02}"


def _fit_class(counted: pa.Table) -> dict[str, float | int | None]:
    """Return the rate at which roads become slippery or recover, for one class of values (a
    temperature band or a part of the day), with an interval computed from days drawn with
    replacement.
    """
    columns = {
        name: counted[name].to_numpy().astype(float)
        for name in ("pairs", "unlike", "slippery", "seconds")
    }
    days, day = np.unique(counted["day"].to_numpy(zero_copy_only=False), return_inverse=True)
    octaves, octave = np.unique(counted["octave"].to_numpy(), return_inverse=True)
    cube = np.zeros((len(days), len(octaves), len(columns)))  # axes: day, bin of time, count
    for k, column in enumerate(columns.values()):
        np.add.at(cube[..., k], (day, octave), column)
    pairs, unlike, slippery, seconds = cube.sum(axis=(0, 1)) if cube.size else np.zeros(4)
    rate, misread = fit(cube.sum(axis=0)) if cube.size else (np.nan, np.nan)
    lower = np.nan
    upper = np.nan
    if len(days) >= LEAST_DAYS and np.isfinite(rate):
        rng = np.random.default_rng(0)
        samples = rng.integers(len(days), size=(DRAWS, len(days)))
        drawn = [fit(cube[sample].sum(axis=0), ((rate, misread),))[0] for sample in samples]
        lower, upper = (
            np.nanpercentile(drawn, ENDS) if np.isfinite(drawn).any() else (np.nan, np.nan)
        )
    return {
        "pairs": int(pairs),
        "days": len(days),
        "hours_between": seconds / 3600,
        "unlike": int(unlike),
        "share_slippery": slippery / max(2.0 * pairs, 1.0),
        "rate_per_hour": _finite_or_none(3600 * rate),
        "rate_lower": _finite_or_none(3600 * lower),
        "rate_upper": _finite_or_none(3600 * upper),
        "misread": _finite_or_none(misread),
        "assumed_per_hour": 3600 / CHANGE_S,
    }


BEGINS: Final = tuple(
    (1.0 / seconds, misread) for seconds in (600.0, 10_800.0, 100_000.0) for misread in (0.01, 0.2)
)


def fit(counts: FloatArray, begins: Sequence[tuple[float, float]] = BEGINS) -> tuple[float, float]:
    """Return the maximum-likelihood estimates of λ, the rate at which roads change [1/s], and e,
    the probability that two values of the same road are unlike because of errors. Two values are
    unlike if one is slippery and the other is not. Return NaN if no pair is unlike, or if all
    values are on one side of the slippery limit.

    Args:
        counts: (bins, 4): number of pairs, number of unlike pairs (one slippery, one not), number
            of slippery values, and sum of elapsed seconds.
        begins: pairs (λ, e) from which the search begins; the best result is taken.
    """
    counts = counts[counts[:, 0] > 0]
    pairs, unlike, slippery, seconds = counts.T
    share = slippery.sum() / (2.0 * pairs.sum()) if len(counts) else 0.0
    chance_unlike = 2.0 * share * (1.0 - share)
    if unlike.sum() == 0 or chance_unlike <= 0.0:
        return np.nan, np.nan
    elapsed_s = seconds / pairs

    def loss(x: FloatArray) -> float:
        rate = np.exp(x[0])
        misread = chance_unlike / (1.0 + np.exp(-x[1]))
        p = np.clip(
            misread + (chance_unlike - misread) * -np.expm1(-rate * elapsed_s), 1e-9, 1.0 - 1e-9
        )
        return -float(unlike @ np.log(p) + (pairs - unlike) @ np.log1p(-p))

    starts = [np.array([np.log(rate), _logit(misread / chance_unlike)]) for rate, misread in begins]
    best = min(
        (minimize(loss, x, method="Nelder-Mead") for x in starts),
        key=lambda result: float(result.fun),
    )
    return float(np.exp(np.clip(best.x[0], -30.0, 5.0))), float(
        chance_unlike / (1.0 + np.exp(-best.x[1]))
    )


def _logit(share: float) -> float:
    share = float(np.clip(share, 1e-4, 1.0 - 1e-4))
    return float(np.log(share / (1.0 - share)))


def _finite_or_none(number: float) -> float | None:
    return float(number) if np.isfinite(number) else None
