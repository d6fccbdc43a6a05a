"""Evaluation of ageing: how fast the map's knowledge about a dry road fades. The module measures
the lower end of the friction interval at some times after the last vehicle has passed. Pure (no
I/O).
"""

from __future__ import annotations

from typing import Final, NamedTuple

import numpy as np
from numpy.random import Generator

from fleet_service.fusion import Fusion, observations_of
from fleet_service.fusion.weather import Reports
from fleet_service.lab import agent
from fleet_service.lab.agent import Errors, Passes
from fleet_service.lab.drive import CELL, LATENESS_S, rows_of
from fleet_service.lab.town import START, Visits
from schemas import grid, mugrid
from schemas.numeric import FloatArray
from schemas.thresholds import NS

PREFIX: Final = "fusion.stays_dry"
DRY = 0.85
PASSES = 60
CARS = 40
HOUR_S = 3600.0
AFTER_MIN: Final = (0, 5, 15, 30, 60, 120, 180, 360)  # [min] after the hour of the passes


class WeatherSince(NamedTuple):
    """Weather after the last pass, reported each hour: temperature [°C] and precipitation
    [mm/h].
    """

    temperature: float
    precipitation: float


WEATHER: Final[dict[str, WeatherSince | None]] = {
    "unknown": None,
    "mild_dry": WeatherSince(8.0, 0.0),
    "mild_rain": WeatherSince(8.0, 1.0),
    "freezing": WeatherSince(-1.0, 0.0),
}
TITLES: Final = {
    "unknown": "unknown",
    "mild_dry": "8 °C, dry",
    "mild_rain": "8 °C, rain",
    "freezing": "−1 °C, dry or wet",
}


def measure(seeds: range) -> dict[str, float]:
    """Return the lower end of the map's friction interval, averaged over the seeds, by weather and
    minutes since the last pass.
    """
    figures = {}
    for name, known in WEATHER.items():
        ends = [lower_ends(np.random.default_rng([seed, 23]), known) for seed in seeds]
        for minutes, lower in zip(AFTER_MIN, np.mean(ends, axis=0), strict=True):
            figures[f"{PREFIX}.{name}.min{minutes}"] = float(lower)
    return figures


def lower_ends(rng: Generator, known: WeatherSince | None) -> FloatArray:
    """Return the lower end of the interval of friction at each time in AFTER_MIN after the last
    pass. Before that, vehicles drove over the dry road for an hour with enough grip used to measure
    the friction.
    """
    seconds = np.sort(rng.random(PASSES)) * HOUR_S
    who = rng.integers(0, CARS, PASSES)
    mu = np.full(PASSES, DRY)
    nothing = np.zeros(PASSES, np.int64)
    excited = np.ones(PASSES, bool)
    passes = Passes(
        who,
        mu,
        np.zeros(PASSES),
        rng.uniform(0.6, 1.0, PASSES),
        rng.normal(size=PASSES),
        nothing,
        excited,
    )
    reports = agent.draw_reports(rng, Errors.draw(rng, CARS), passes)
    fusion = Fusion(LATENESS_S)
    if known is not None:
        fusion.update_weather(_hourly_reports(known))
    fusion.update(
        observations_of(rows_of(Visits(seconds, who, nothing, mu, excited, reports)), who)
    )
    slot = fusion.slots_of(CELL[:1], np.zeros(1, np.int64))
    at = [START + int((HOUR_S + 60.0 * minutes) * NS) for minutes in AFTER_MIN]
    return np.array([mugrid.quantiles(fusion.beliefs(slot, moment), 0.05)[0] for moment in at])


def _hourly_reports(known: WeatherSince) -> Reports:
    hours = 1 + np.arange(1 + AFTER_MIN[-1] // 60)
    n = len(hours)
    temperature = np.full(n, known.temperature)
    return Reports(
        np.repeat(grid.region_of(CELL[:1]), n),
        START + hours * 3600 * NS,
        temperature,
        temperature,
        np.full(n, known.precipitation),
        np.full((n, mugrid.BINS), np.nan),
    )
