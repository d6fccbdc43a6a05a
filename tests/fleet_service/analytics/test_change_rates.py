"""Tests of the question (predefined query) `change-rates`, which estimates how often and how fast
road friction changes. It must find the rates of a simulated process. Its 90 % interval must contain
the true rate as often as stated. It must count pairs of successive values of a cell correctly.
"""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pandas as pd
import pyarrow as pa
import pytest

from fleet_service.analytics.questions.change_rates import LEAST_DAYS, LONGEST_S, _fit_class, fit
from schemas.numeric import FloatArray
from schemas.thresholds import SLIPPERY_MU

Ask = Callable[..., pa.Table]
RATE = 1.0 / 1800.0
MISREAD = 0.05  # probability that a single reading is wrong
PI = 0.3  # share of slippery roads


def pairs_of_a_day(rng: np.random.Generator, rate: float, count: int) -> FloatArray:
    """Return statistics (bins, 4) of simulated pairs of readings of one road's state, slippery or
    not. The road changes at the rate `rate` [1/s]. A bin contains pairs with a similar time between
    the readings. Columns: number of pairs, pairs that differ, slippery readings, sum of times [s].
    """
    apart = np.exp(rng.uniform(0.0, np.log(LONGEST_S), count))
    first = rng.random(count) < PI
    second = np.where(rng.random(count) < -np.expm1(-rate * apart), rng.random(count) < PI, first)
    first, second = (road ^ (rng.random(count) < MISREAD) for road in (first, second))
    octave = np.log2(apart).astype(int)
    columns = (np.ones(count), first != second, first.astype(float) + second, apart)
    return np.stack([np.bincount(octave, column, minlength=14) for column in columns], axis=1)


def test_the_fit_finds_the_rate_and_the_misreadings_of_a_known_process() -> None:
    rate, misread = fit(pairs_of_a_day(np.random.default_rng(1), RATE, 200_000))
    assert rate == pytest.approx(RATE, rel=0.1)
    assert misread == pytest.approx(2 * MISREAD * (1 - MISREAD), abs=0.01)


def make_counts(days: list[FloatArray]) -> pa.Table:
    rows = [
        {
            "day": f"2026-01-{day + 1:02}",
            "octave": octave,
            **dict(zip(NAMES, counts.tolist(), strict=True)),
        }
        for day, one in enumerate(days)
        for octave, counts in enumerate(one)
        if counts[0] > 0
    ]
    return pa.Table.from_pylist(rows)


NAMES = ("pairs", "unlike", "slippery", "seconds")


@pytest.mark.campaign
def test_interval_coverage_is_right_when_days_differ() -> None:
    """The 90 % interval of the rate must contain the true rate RATE in most trials. The rates of
    single days differ widely, so that pairs of the same day are not independent.
    """
    held = 0
    trials = 20
    for trial in range(trials):
        rng = np.random.default_rng([7, trial])
        days = [pairs_of_a_day(rng, RATE * rng.uniform(0.4, 1.6), 800) for _ in range(12)]
        found = _fit_class(make_counts(days))
        assert found["rate_lower"] is not None
        assert found["rate_upper"] is not None
        held += found["rate_lower"] <= 3600 * RATE <= found["rate_upper"]
    assert held >= 14  # 18 are expected; fewer than 14 occur by chance once in 40 runs


def test_few_days_have_no_interval() -> None:
    rng = np.random.default_rng(2)
    found = _fit_class(make_counts([pairs_of_a_day(rng, RATE, 500) for _ in range(LEAST_DAYS - 1)]))
    assert found["rate_per_hour"] is not None
    assert found["rate_lower"] is None
    assert found["rate_upper"] is None


def test_pairs_are_values_in_a_row_by_different_vehicles(asked: Ask, rows: pd.DataFrame) -> None:
    found = asked("change-rates").to_pandas()
    measured = rows[rows["value"]].sort_values(
        ["cell", "sector", "time", "vehicle", "boot", "seq", "row"]
    )
    before = measured.groupby(["cell", "sector"])[["time", "vehicle", "mu"]].shift()
    apart = measured["time"] - before["time"]
    pair = (before["vehicle"] != measured["vehicle"]) & (apart >= 1) & (apart <= LONGEST_S)
    unlike = pair & ((before["mu"] < SLIPPERY_MU) != (measured["mu"] < SLIPPERY_MU))
    hours = found[found["by"] == "hour of the day (UTC)"]
    assert hours["pairs"].sum() == pair.sum() > 500
    assert hours["unlike"].sum() == unlike.sum() > 0
    assert hours["hours_between"].sum() == pytest.approx(apart[pair].sum() / 3600)


def test_roads_change_faster_where_ice_comes_and_goes(asked: Ask, stations: Path) -> None:
    """The synthetic roads freeze at four o'clock and thaw at eight. The answer must contain changes
    and their rate for the hours 6 to 12, and neither for the hours 12 to 18.
    """
    for options in ({}, {"stations": stations}):
        found = asked("change-rates", **options).to_pandas().set_index(["by", "class"])
        assert found.loc[("hour of the day (UTC)", "06-12"), "unlike"] > 5
        assert found.loc[("hour of the day (UTC)", "12-18"), "unlike"] == 0
        assert found.loc[("hour of the day (UTC)", "12-18"), "rate_per_hour"] is None or np.isnan(
            found.loc[("hour of the day (UTC)", "12-18"), "rate_per_hour"]
        )
        assert found["pairs"].sum() > 1000
