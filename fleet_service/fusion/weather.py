"""Influence of the weather on forgetting: how fast a region's roads age, and the prior belief about
an unmeasured road.

Roads of a region without weather reports age in real time. A report applies from its time on, until
the next report or for VALID_S. Pure; the ageing is compiled.

Legend
    τ_d, τ_c   weather-scaled age ("road time") of drift and change: ∫ rate dt     [s]
    T_a, T_r   temperature of the air, of the road                             [°C]
    R          precipitation, as water                                         [mm/h]
"""

from __future__ import annotations

from dataclasses import dataclass, fields
from typing import Final, NamedTuple

import numpy as np

from schemas import grid, mugrid
from schemas.numeric import BoolArray, Float32Array, FloatArray, IntArray
from schemas.runtime.jit import refcount_free
from schemas.thresholds import NS

# [ns] Time for which a report is valid. Weather services and stations report hourly, so two reports
# may fail.
VALID_NS: Final = 3 * 3600 * NS
WET_MM_H: Final = 0.1  # [mm/h] least precipitation that a gauge measures

# Factors on the rates of change and of drift, for weather as reported.

# Precipitation: roads become wet or dry, and showers pass, in less than an hour. With this factor,
# the mean time between changes is 45 minutes.
WET_CHANGE: Final = 4.0
WET_DRIFT: Final = 2.0
# [°C] Range of road temperature around freezing. Below it, snow stays dry and roads change less.
FREEZING_C: Final = (-4.0, 1.0)
# [K] Assumed difference if only the air temperature is known: on a clear night radiation cools the
# road by this much.
AIR_ABOVE_ROAD_C: Final = 2.0
# Around freezing: within minutes the road may have ice, slush, water or salt. Dew and meltwater
# freeze as fast as precipitation, and no gauge reports them. The mean time between changes is then
# 22 minutes. With a smaller factor, a dry road was still called safe half an hour after black ice
# formed, if drivers used a fifth of the grip.
FREEZING_CHANGE: Final = 8.0
# Warm and dry: only dirt changes a road, so beliefs last twice as long. A smaller factor would
# trust the gauge too much, because it is not at this road.
STEADY_CHANGE: Final = 0.5
STEADY_C: Final = 5.0  # [°C] least road temperature for this
# Weight of the uniform prior in the prior that a report gives. Such a prior is a guess about a
# region, not about one road. With this weight, two vehicles outvote a wrong one.
UNIFORM_SHARE: Final = 0.5


@dataclass(frozen=True)
class Reports:
    """Weather reports, arrays of shape (n,).

    `time` is the time [ns] from which a report applies to its `region`. Air and road temperature
    are in °C and precipitation in mm/h, each NaN where unknown. `prior` (n, 32) is the belief about
    an unmeasured road, NaN for none.
    """

    region: IntArray
    time: IntArray
    air_temperature: FloatArray
    road_temperature: FloatArray
    precipitation: FloatArray
    prior: FloatArray

    def take(self, rows: IntArray | BoolArray) -> Reports:
        """Return the weather reports that the indices or mask `rows` selects."""
        return Reports(*(getattr(self, f.name)[rows] for f in fields(self)))


class Weather(NamedTuple):
    """Road time of regions: time that runs faster when weather changes a road faster. Rows
    `start[k]` to `start[k + 1]` belong to `region[k]`, in order of time; row 0 is for regions
    without reports.

    Attributes:
        region: (r,) numbers of the regions, ascending.
        start: (r + 1,) first row of each region.
        time: (m,) time from which a row applies [ns].
        clock: (m, 2) road time of drift τ_d and of change τ_c at that time [s].
        rate: (m, 2) rates of τ_d and τ_c from that time on, 1 without weather.
        prior: (m, 32) belief about an unmeasured road; uniform in row 0.
    """

    region: IntArray
    start: IntArray
    time: IntArray
    clock: FloatArray
    rate: FloatArray
    prior: Float32Array


def report_rates(reports: Reports) -> FloatArray:
    """Return, for each weather report, factors on the rates at which friction drifts and at which
    roads change suddenly, (n, 2); 1 where the weather is unknown.
    """
    road = np.where(
        np.isnan(reports.road_temperature),
        reports.air_temperature - AIR_ABOVE_ROAD_C,
        reports.road_temperature,
    )
    # Both are False if the precipitation is unknown.
    wet = reports.precipitation >= WET_MM_H
    dry = reports.precipitation < WET_MM_H
    freezing = (road >= FREEZING_C[0]) & (road <= FREEZING_C[1])
    change = np.select(
        [freezing, wet, dry & (road >= STEADY_C)],
        [FREEZING_CHANGE, WET_CHANGE, STEADY_CHANGE],
        1.0,
    )
    return np.stack([np.where(wet, WET_DRIFT, 1.0), change], axis=1)


def report_priors(reports: Reports) -> Float32Array:
    """Return the belief about an unmeasured road that each weather report gives, (n, 32), mixed
    with a share of the uniform prior.
    """
    given = np.where(np.isnan(reports.prior), mugrid.PRIOR, reports.prior)
    given = given / given.sum(axis=1, keepdims=True)
    mixed: FloatArray = UNIFORM_SHARE * mugrid.PRIOR + (1.0 - UNIFORM_SHARE) * given
    return mixed.astype(np.float32)


def weather_of(reports: Reports) -> Weather:
    """Return the `Weather` of all regions in `reports`: for each report, the rates at which roads
    age from its time on, and the prior belief about an unmeasured road.

    After VALID_NS without a new report, the rates are 1 and the prior is uniform. If several
    reports have the same region and time, the last one counts.
    """
    last = np.lexsort((np.arange(len(reports.time)), reports.time, reports.region))
    keep = np.append(np.diff(reports.region[last]) != 0, True) | np.append(
        np.diff(reports.time[last]) != 0, True
    )
    reports = reports.take(last[keep[: len(last)]])
    rate = report_rates(reports)
    prior = report_priors(reports)
    rows: list[tuple[int, float, float, Float32Array]] = [
        (0, 1.0, 1.0, mugrid.PRIOR.astype(np.float32))
    ]
    region, begin = np.unique(reports.region, return_index=True)
    starts = [1]
    for first, end in zip(
        begin.tolist(), np.append(begin, len(reports.time))[1:].tolist(), strict=True
    ):
        for k in range(first, end):
            rows.append((int(reports.time[k]), rate[k, 0], rate[k, 1], prior[k]))
            until = int(reports.time[k]) + VALID_NS
            if k + 1 == end or reports.time[k + 1] > until:
                rows.append((until, 1.0, 1.0, rows[0][3]))
        starts.append(len(rows))
    time = np.array([row[0] for row in rows])
    return _accumulate_clock(
        region,
        np.array(starts),
        time,
        np.array([row[1:3] for row in rows]),
        [row[3] for row in rows],
    )


def _accumulate_clock(
    region: IntArray, start: IntArray, time: IntArray, rate: FloatArray, prior: list[Float32Array]
) -> Weather:
    clock = np.zeros_like(rate)
    for first, end in zip(start[:-1].tolist(), start[1:].tolist(), strict=True):
        passed = np.diff(time[first:end])[:, None] * 1e-9 * rate[first : end - 1]
        clock[first + 1 : end] = np.cumsum(passed, axis=0)
    return Weather(region, start, time, clock, rate, np.array(prior))


def no_reports() -> Reports:
    """Return an empty set of weather reports (arrays with zero rows)."""
    nothing = np.zeros(0, np.int64)
    never = np.zeros(0)
    return Reports(nothing, nothing, never, never, never, np.zeros((0, mugrid.BINS)))


_SHIFT: Final = 2 * (grid.CELL_ZOOM - grid.REGION_ZOOM) + 2  # bits from a slot's key to its region


@refcount_free
def road_time(weather: Weather, key: int, begin: int, end: int) -> tuple[float, float, int]:
    """Return three values for the slot `key` and the interval from `begin` to `end` [ns].

    The first two are road times [s]: integrals over the interval of a rate that depends on the
    weather and is 1 without a report. The first uses the rate at which friction drifts, and the
    second uses the rate at which roads change suddenly. The third value is the row of
    `weather.prior` that applies at the end; it is 0 if no weather report applies.
    """
    seconds = (end - begin) * 1e-9
    if len(weather.region) == 0:
        return seconds, seconds, 0
    region = key >> _SHIFT
    k = np.searchsorted(weather.region, region)
    if k == len(weather.region) or weather.region[k] != region:
        return seconds, seconds, 0
    first = weather.start[k]
    last = weather.start[k + 1]
    drift = 0.0
    change = 0.0
    row = 0
    for time, sign in ((begin, -1.0), (end, 1.0)):
        place = first + np.searchsorted(weather.time[first:last], time, side="right") - 1
        row = place if place >= first else 0
        at = max(place, first)
        passed = (time - weather.time[at]) * 1e-9
        drift += sign * (weather.clock[at, 0] + passed * (weather.rate[at, 0] if row else 1.0))
        change += sign * (weather.clock[at, 1] + passed * (weather.rate[at, 1] if row else 1.0))
    return drift, change, row
