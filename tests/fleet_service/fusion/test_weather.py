"""Tests that weather changes how fast beliefs age, and that the order in which weather reports
arrive has no effect.
"""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest

from fleet_service.fusion import Fusion, weather
from schemas import grid, mugrid
from tests.fleet_service.examples import (
    CELL,
    REGION,
    START,
    belief,
    interval,
    observations,
    slippery,
    value,
)

HOUR = 3600 * 10**9
KEY = CELL * grid.SECTORS
RAIN = (8.0, 6.0, 2.0)
FREEZING = (np.nan, -1.0, 0.5)
STEADY = (15.0, np.nan, 0.0)


def reports(
    *rows: tuple[float, tuple[float, float, float]], region: int = REGION
) -> weather.Reports:
    """Return a table of weather reports.

    Args: rows: (hours after START, (air temperature [°C], road temperature [°C], precipitation
    [mm/h])) of each report. region: number of the region of the reports.
    """
    air, road, water = np.array([row[1] for row in rows]).T
    time = np.array([START + int(row[0] * HOUR) for row in rows])
    return weather.Reports(
        np.full(len(rows), region),
        time,
        air,
        road,
        water,
        np.full((len(rows), mugrid.BINS), np.nan),
    )


def compute_road_time(conditions: weather.Weather, begin: float, end: float) -> tuple[float, float]:
    """Return two road times [h] between `begin` and `end` [h after START]. A road time is the
    elapsed time multiplied by a rate that depends on the weather. The first road time uses the rate
    of slow drift of friction, the second the rate of sudden changes.
    """
    drift, change, _ = weather.road_time(
        conditions, KEY, START + int(begin * HOUR), START + int(end * HOUR)
    )
    return drift / 3600.0, change / 3600.0


def test_roads_without_weather_reports_age_by_the_clock() -> None:
    for conditions in (
        weather.weather_of(weather.no_reports()),
        weather.weather_of(reports((0.0, RAIN), region=REGION + 1)),
    ):
        assert compute_road_time(conditions, -5.0, 7.0) == pytest.approx((12.0, 12.0))


def test_road_time_integrates_the_weather_until_a_report_expires() -> None:
    conditions = weather.weather_of(reports((0.0, RAIN), (1.0, FREEZING), (2.0, STEADY)))
    assert compute_road_time(conditions, -1.0, 0.0) == pytest.approx((1.0, 1.0))
    assert compute_road_time(conditions, 0.0, 1.0) == pytest.approx(
        (weather.WET_DRIFT, weather.WET_CHANGE)
    )
    assert compute_road_time(conditions, 1.0, 2.0) == pytest.approx(
        (weather.WET_DRIFT, weather.FREEZING_CHANGE)
    )
    assert compute_road_time(conditions, 2.0, 5.0) == pytest.approx(
        (3.0, 3.0 * weather.STEADY_CHANGE)
    )
    assert compute_road_time(conditions, 5.0, 9.0) == pytest.approx((4.0, 4.0))
    whole = [compute_road_time(conditions, -1.0, t)[1] for t in (0.5, 1.5, 2.5, 9.0)]
    parts = [
        compute_road_time(conditions, -1.0, 0.3)[1] + compute_road_time(conditions, 0.3, t)[1]
        for t in (0.5, 1.5, 2.5, 9.0)
    ]
    assert whole == pytest.approx(parts)


def test_unknown_values_change_nothing() -> None:
    nothing = (np.nan, np.nan, np.nan)
    assert weather.report_rates(
        reports((0.0, nothing), (0.0, (20.0, np.nan, np.nan)))
    ).tolist() == [
        [1.0, 1.0],
        [1.0, 1.0],
    ]
    # The road may be colder than the air, so 1 °C counts as a change to frost.
    assert (
        weather.report_rates(reports((0.0, (1.0, np.nan, np.nan))))[0, 1] == weather.FREEZING_CHANGE
    )


def after_an_hour(conditions: weather.Reports | None) -> np.ndarray:
    fusion = Fusion(120.0)
    if conditions is not None:
        fusion.update_weather(conditions)
    fusion.update(observations(np.arange(8) * 10.0, np.arange(8), value(np.full(8, 0.8))))
    return belief(fusion, now=START + HOUR)


def test_dry_value_fades_faster_in_frost_and_slower_in_warmth() -> None:
    width = {
        name: np.subtract(*interval(after_an_hour(reports((0.0, rows)) if rows else None))[::-1])
        for name, rows in (
            ("steady", STEADY),
            ("unknown", None),
            ("rain", RAIN),
            ("freezing", FREEZING),
        )
    }
    assert list(width) == sorted(width, key=lambda name: width[name])
    assert slippery(after_an_hour(reports((0.0, FREEZING)))) > 2 * slippery(after_an_hour(None))


def test_unknown_road_fades_to_its_regions_prior_which_is_half_uniform() -> None:
    icy = np.where(mugrid.CENTRES < 0.4, 1.0, 0.0)
    forecast = dataclasses.replace(reports((0.0, STEADY)), prior=(icy / icy.sum())[None])
    fusion = Fusion(120.0)
    fusion.update_weather(forecast)
    fusion.update(observations([60.0], [1], value([0.5], std=30.0)))
    assert slippery(belief(fusion)) == pytest.approx(0.5 + 0.5 * 0.3, abs=0.02)
    assert belief(fusion).min() > 0.4 / mugrid.BINS


def test_weather_for_the_open_window_gives_the_map_of_known_weather() -> None:
    rng = np.random.default_rng(8)
    n = 300
    o = observations(
        np.sort(rng.uniform(0.0, 3 * 3600.0, n)),
        rng.integers(0, 9, n),
        value(rng.uniform(0.3, 0.9, n)),
    )
    known = Fusion(120.0)
    informed = Fusion(120.0)
    arriving = [reports((0.0, RAIN)), reports((0.0, FREEZING)), reports((0.0, STEADY))]
    used = []
    for part, rows in enumerate(np.array_split(np.arange(n), 3)):
        acting = dataclasses.replace(
            arriving[part], time=np.array([max(informed.next_epoch, START)])
        )
        informed.update_weather(acting)
        used.append(acting)
        informed.update(o.take(rows))
    for one in used:
        known.update_weather(one)
    known.update(o)
    now = START + 4 * HOUR
    np.testing.assert_allclose(belief(informed, now=now), belief(known, now=now), atol=1e-6)
    plain = Fusion(120.0)
    plain.update(o)
    assert np.abs(belief(plain, now=now) - belief(known, now=now)).max() > 1e-3
