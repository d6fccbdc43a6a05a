"""Simple rules that combine the reports of vehicles into a map, for comparison with the service's
map. Each rule stores a mean and a variance of the friction per cell. Pure (no I/O), compiled.

Each simulated vehicle has a Kalman filter of its own (`vehicle_posteriors`). After each passage of
a cell, the vehicle sends the filter's *posterior* (m, P), which also contains information from the
previous cell. Between reports, the variance of each rule grows with time. "Added" below means that
the rule adds 1/P to its own inverse variance.

    newest report         the last posterior
    inverse variance      each pass sends SAMPLES equal posteriors, and all of them are added
    one per pass          each pass sends one posterior, and it is added
    covariance inters.    one per pass; map and posterior are averaged with weights in proportion
                          to their inverse variances (W. Niehsen, FUSION 2002)
    federated reset       the vehicle's filter starts each pass from the map's estimate, so that
                          only the new reading is added (N. A. Carlson, IEEE Trans. Aerospace and
                          Electronic Systems 26(3), 1990)
    median                median of the vehicles' last readings of an hour; the assumed standard
                          deviations are 6 % (shared by all vehicles) and 12 % (per vehicle)
"""

from __future__ import annotations

from typing import Final

import numpy as np

from fleet_service.lab.score import Scores, excited_vehicles, join_scores, of_intervals
from fleet_service.lab.town import CELLS, Town, Visits
from schemas import mugrid
from schemas.numeric import BoolArray, FloatArray, IntArray
from schemas.runtime.jit import compiled
from schemas.thresholds import Z_95

RULES: Final = (
    "newest report",
    "inverse variance",
    "one per pass",
    "covariance intersection",
    "federated reset",
    "median",
)
MEDIAN_MIN: Final = 60  # [min] time before the reading from which the median takes values
# relative standard deviations of the median: shared by all vehicles, and of a single vehicle
MEDIAN_COMMON = 0.06
MEDIAN_OWN = 0.12
SAMPLES: Final = 10  # number of posteriors that an agent at 10 Hz sends from one cell
PRIOR_MEAN: Final = 0.5 * (mugrid.LOWER + mugrid.UPPER)
PRIOR_VAR: Final = (mugrid.UPPER - mugrid.LOWER) ** 2 / 12.0
ROAD_VAR: Final = 0.05**2  # per cell, because the surface changes every few cells
DRIFT_VAR: Final = 0.04**2 / 3600.0  # per second
_KALMAN: Final = 5  # number of rules that store a mean and a variance
_NEWEST, _ALL, _ONE, _INTERSECTION, _FEDERATED = range(_KALMAN)


@compiled
def vehicle_posteriors(
    vehicle: IntArray, reading: FloatArray, std: FloatArray, vehicles: int
) -> FloatArray:
    """Return the posterior (mean m, variance P) that each vehicle's own Kalman filter has after
    each visit (passage of a cell), (n, 2). Before each visit the filter's variance grows, at most
    to that of the prior (belief before any measurement).

    Args:
        vehicle: number of the vehicle in each visit, (n,).
        reading: friction that the vehicle measured in the visit, (n,); NaN without a measurement.
        std: standard deviation of the reading, (n,).
        vehicles: number of vehicles.
    """
    mean = np.full(vehicles, PRIOR_MEAN)
    variance = np.full(vehicles, PRIOR_VAR)
    out = np.empty((len(vehicle), 2))
    for k in range(len(vehicle)):
        who = vehicle[k]
        p = min(variance[who] + ROAD_VAR, PRIOR_VAR)
        m = mean[who]
        if np.isfinite(reading[k]):
            gain = p / (p + std[k] ** 2)
            m += gain * (reading[k] - m)
            p *= 1.0 - gain
        mean[who] = m
        variance[who] = p
        out[k, 0] = m
        out[k, 1] = p
    return out


@compiled
def fuse_by_rules(
    place: IntArray,
    seconds: FloatArray,
    sent: FloatArray,
    readings: tuple[FloatArray, FloatArray],
    read_times: FloatArray,
    cells: int,
) -> FloatArray:
    """Return mean and variance of μ in each cell at the times `read_times`, (times, 5, cells, 2),
    by five simple rules: the rules of RULES except the median, in the same order.

    Args:
        place: cell of each visit, (n,).
        seconds: time of each visit [s], (n,).
        sent: posterior (mean, variance) of the vehicle's own filter after each visit, (n, 2). All
            rules but "federated reset" use it.
        readings: friction measured in each visit alone, and its standard deviation, (n,) each. Only
            "federated reset" uses it.
        read_times: times [s] at which the maps are read, (times,).
        cells: number of cells.
    """
    reading, std = readings
    mean = np.full((_KALMAN, cells), PRIOR_MEAN)
    variance = np.full((_KALMAN, cells), PRIOR_VAR)
    last = np.zeros(cells)
    out = np.empty((len(read_times), _KALMAN, cells, 2))
    k = 0
    for t in range(len(read_times)):
        while k < len(place) and seconds[k] < read_times[t]:
            cell = place[k]
            passed = seconds[k] - last[cell]
            last[cell] = seconds[k]
            for rule in range(_KALMAN):
                aged = min(variance[rule, cell] + DRIFT_VAR * passed, PRIOR_VAR)
                if rule == _FEDERATED:
                    reports = np.isfinite(reading[k])
                    value = reading[k] if reports else mean[rule, cell]
                    information = 1.0 / std[k] ** 2 if reports else 0.0
                else:
                    value = sent[k, 0]
                    information = 1.0 / sent[k, 1]
                mean[rule, cell], variance[rule, cell] = _combine(
                    rule, mean[rule, cell], aged, value, information
                )
            k += 1
        out[t, :, :, 0] = mean
        out[t, :, :, 1] = variance
    return out


@compiled
def _combine(
    rule: int, mean: float, variance: float, value: float, information: float
) -> tuple[float, float]:
    """Return mean and variance of a cell after a rule has combined them with a reported value. The
    report's `information` is its inverse variance.
    """
    own = 1.0 / variance
    if rule == _NEWEST:
        own = 0.0
    elif rule == _ALL:
        information *= SAMPLES
    elif rule == _INTERSECTION:
        share = own / (own + information)
        own = share * own
        information = (1.0 - share) * information
    whole = own + information
    return (own * mean + information * value) / whole, 1.0 / whole


def recent_medians(visits: Visits, minute: int) -> tuple[FloatArray, FloatArray]:
    """Return, for each cell, the median of the last friction values that the vehicles reported
    within MEDIAN_MIN minutes before `minute`, and its standard deviation, (cells,) each.
    """
    recent = (visits.seconds < 60.0 * minute) & (visits.seconds >= 60.0 * (minute - MEDIAN_MIN))
    rows = np.flatnonzero(np.isfinite(visits.reports.reading) & recent)
    pair = visits.place[rows] * (int(visits.vehicle.max(initial=0)) + 1) + visits.vehicle[rows]
    # Visits are in order of time, so the first one in reverse order is the newest.
    _, last = np.unique(pair[::-1], return_index=True)
    rows = rows[::-1][last]
    mean = np.full(CELLS, PRIOR_MEAN)
    std = np.full(CELLS, PRIOR_VAR**0.5)
    for cell in np.unique(visits.place[rows]).tolist():
        readings = visits.reports.reading[rows[visits.place[rows] == cell]]
        mean[cell] = np.median(readings)
        std[cell] = mean[cell] * np.hypot(MEDIAN_COMMON, MEDIAN_OWN / np.sqrt(len(readings)))
    return mean, std


def score_rules(
    visits: Visits, town: Town, at: tuple[int, ...], vehicles: int, where: BoolArray | bool = True
) -> list[Scores]:
    """Return the scores of the maps that the simple rules RULES compute from `visits`,
    one item per rule, for the map at the minutes `at`. Cells outside the mask `where` are left out,
    and so are cells in which no vehicle used enough grip to measure the friction.
    """
    sent = vehicle_posteriors(visits.vehicle, visits.reports.reading, visits.reports.std, vehicles)
    read_times = 60.0 * np.array(at, float)
    readings = (visits.reports.reading, visits.reports.std)
    found = fuse_by_rules(visits.place, visits.seconds, sent, readings, read_times, CELLS)
    out: list[list[Scores]] = [[] for _ in RULES]
    for k, minute in enumerate(at):
        n = excited_vehicles(visits, town, minute, vehicles)
        of_rules = [
            (found[k, rule, :, 0], np.sqrt(found[k, rule, :, 1])) for rule in range(_KALMAN)
        ]
        for (mean, std), per_rule in zip(
            [*of_rules, recent_medians(visits, minute)], out, strict=True
        ):
            half = Z_95 * std
            lower, mid, upper = (
                np.clip(mean + sign * half, mugrid.LOWER, mugrid.UPPER) for sign in (-1.0, 0.0, 1.0)
            )
            nothing = np.full(CELLS, np.nan)
            answers = of_intervals((lower, mid, upper), town.mu[minute], n, nothing, nothing)
            per_rule.append(answers.taken((n >= 1) & where))
    return [join_scores(per_rule) for per_rule in out]
