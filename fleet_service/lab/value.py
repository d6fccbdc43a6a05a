"""Evaluation of the map's usefulness: share of the road whose friction is known, quality of alerts
compared with two simpler rules, and minutes until the map shows new ice. Pure (no I/O).

Drivers use the grip that a place demands. On a slippery road this is a large share of the available
grip, so every vehicle measures the friction; on a dry road hardly any vehicle does. All vehicles
are enrolled. The service runs for an hour and a half before the measurement begins. The surface of
half of the roads changes once.

    d      demand of a pass [g]: log-normal around DEMAND, with standard deviation DEMAND_SPREAD
    s      share of the grip used, min(d/μ, 1); a slip controller intervenes if s = 1
    known  share of cells and times with a 90 % interval narrower than NARROW

The alerts are compared with two simple rules on the visits (passages of cells) of the last hour.
The first warns after two visits in which a slip controller intervened while less grip than the
slippery limit was used. The second warns if there are at least two values and their median is
slippery.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Final, NamedTuple

import numpy as np
from numpy.random import Generator

from fleet_service.fusion import Fusion, Observations, observations_of
from fleet_service.lab import agent, town
from fleet_service.lab.agent import Errors, Passes
from fleet_service.lab.drive import CELL, LATENESS_S, rows_of
from fleet_service.lab.score import RAISED, SURE_GRIP
from fleet_service.lab.town import CELLS, LENGTH, ROADS, START, Town, Visits
from fleet_service.serve.alerts import Alerts
from schemas import mugrid
from schemas.numeric import BoolArray, FloatArray
from schemas.thresholds import EXCITED_SHARE, NS, SLIPPERY_MU, SURFACES

VEHICLES: Final = 60
MINUTES: Final = 360
BEGIN: Final = 90  # [min] from which results count
STEP: Final = 2  # [min] between two readings
CHANGING: Final = 0.5  # share of roads whose surface changes
# [g] demand for grip, by the excitement of the place in the town
DEMAND: Final = {0.40: 0.25, 0.08: 0.15, 0.02: 0.10}
DEMAND_SPREAD: Final = 0.5  # standard deviation of the demand's logarithm
GENTLE: Final = 0.6  # factor of the demand on gentle roads
NARROW: Final = 0.3
UNNOTICED_MOST: Final = 90.0  # [min] limit, which also stands for no warning
HOUR_S: Final = 3600.0
ICE_MOST = SURFACES["ice"][1]  # largest friction of ice; snow is slippery too
CARS: Final = (5, 20)  # vehicles per hour and road
SEEDS: Final = 3


class TownTraffic(NamedTuple):
    """Visits in a town, and a mask of visits in which a slip controller intervened, (n,)."""

    visits: Visits
    limited: BoolArray


class Readings(NamedTuple):
    """Values at each time at which the map is read, arrays of shape (times, CELLS): true friction;
    width of the interval, P(slippery) and alerts of the map; warnings of the two simple rules.
    """

    truth: FloatArray
    width: FloatArray
    slippery: FloatArray
    alerted: BoolArray
    two_events: BoolArray
    median: BoolArray


def drive_cars(rng: Generator, place: Town, cars: float, demand: float) -> TownTraffic:
    """Simulate traffic of `cars` per hour on each road. Drivers use `demand` times the grip that
    the place demands.
    """
    passes = rng.poisson(cars * ROADS * MINUTES / 60.0)
    along = np.tile(np.arange(LENGTH), passes)
    seconds = np.repeat(60.0 * MINUTES * rng.random(passes), LENGTH) + along
    vehicle = np.repeat(rng.integers(0, VEHICLES, passes), LENGTH)
    cell = np.repeat(rng.integers(0, ROADS, passes) * LENGTH, LENGTH) + along
    mu = place.at(seconds, cell)
    demanded_grip = (
        demand
        * np.vectorize(DEMAND.get)(place.excitement[cell])
        * np.exp(DEMAND_SPREAD * rng.normal(size=len(mu)))
    )
    share = np.minimum(demanded_grip / mu, 1.0)
    excited = share >= EXCITED_SHARE
    manoeuvre = np.where(
        rng.random(len(mu)) < agent.CLEAN.usual_share,
        place.usual[cell],
        rng.integers(0, 4, len(mu)),
    )
    common = place.common[cell, manoeuvre]
    reports = agent.draw_reports(
        rng,
        Errors.draw(rng, VEHICLES),
        Passes(vehicle, mu, common, share, agent.reading_noise(rng, along), manoeuvre, excited),
    )
    order = np.argsort(seconds, kind="stable")
    return TownTraffic(
        Visits(seconds, vehicle, cell, mu, excited, reports).take(order),
        (share >= 1.0)[order],
    )


def make_observations(traffic: TownTraffic) -> Observations:
    """Return the visits as observations that a `Fusion` (the map's beliefs) accepts, with the flags
    of the slip controllers.
    """
    rows = rows_of(traffic.visits)
    rows["abs_active"] = traffic.limited.astype(np.int8)
    return observations_of(rows, traffic.visits.vehicle)


def two_events(traffic: TownTraffic, seconds: float) -> BoolArray:
    """Return a mask of cells, (CELLS,): True if, within the last hour, slip controllers intervened
    twice while less grip than the slippery limit was used.
    """
    visits = traffic.visits
    recent = (visits.seconds > seconds - HOUR_S) & (visits.seconds <= seconds)
    rows = recent & traffic.limited & (visits.reports.used < SLIPPERY_MU)
    return np.asarray(np.bincount(visits.place[rows], minlength=CELLS) >= 2)


def slippery_median(traffic: TownTraffic, seconds: float) -> BoolArray:
    """Return a mask of cells, (CELLS,): True if vehicles reported at least two friction values
    within the last hour, and their median is slippery.
    """
    visits = traffic.visits
    rows = np.flatnonzero(
        (visits.seconds > seconds - HOUR_S) & (visits.seconds <= seconds) & visits.excited
    )
    out = np.zeros(CELLS, np.bool_)
    for cell in np.unique(visits.place[rows]).tolist():
        values = visits.reports.reading[rows[visits.place[rows] == cell]]
        out[cell] = len(values) >= 2 and np.median(values) < SLIPPERY_MU
    return out


def read_map(place: Town, traffic: TownTraffic) -> Readings:
    """Compute the map from the visits minute by minute, and read the map every STEP minutes from
    minute BEGIN on.
    """
    observations = make_observations(traffic)
    fusion = Fusion(LATENESS_S, enrolled=True)
    alerts = Alerts(fusion)
    read: list[tuple[FloatArray | BoolArray, ...]] = []
    ends = np.searchsorted(traffic.visits.seconds, 60.0 * np.arange(MINUTES + 1))
    for minute in range(1, MINUTES + 1):
        rows = np.arange(ends[minute - 1], ends[minute])
        if len(rows):
            alerts.update(fusion.update(observations.take(rows)).slots)
        if minute < BEGIN or minute % STEP:
            continue
        now = START + minute * 60 * NS
        alerts.expire(now)
        slots = fusion.slots_of(CELL, np.zeros(CELLS, np.int64))
        known = slots >= 0
        belief = np.tile(mugrid.PRIOR, (CELLS, 1))
        belief[known] = fusion.beliefs(slots[known], now)
        width = mugrid.quantiles(belief, 0.95) - mugrid.quantiles(belief, 0.05)
        under = np.isin(slots, list(alerts.slots)) & known
        rules = (two_events(traffic, 60.0 * minute), slippery_median(traffic, 60.0 * minute))
        read.append((place.mu[minute], width, belief @ mugrid.SLIPPERY_SHARE, under, *rules))
    return Readings(*(np.array(column) for column in zip(*read, strict=True)))


def count_unnoticed(place: Town, warned: BoolArray, below: float = SLIPPERY_MU) -> FloatArray:
    """Return, for each cell whose friction fell below `below`, the minutes until the first warning;
    at most UNNOTICED_MOST, which also stands for no warning. `warned` is the mask of warned cells
    each time the map is read.
    """
    moments = np.arange(-(-BEGIN // STEP) * STEP, MINUTES + 1, STEP)
    out = []
    for cell in np.flatnonzero(
        (place.changed >= BEGIN) & (place.changed <= MINUTES - UNNOTICED_MOST)
    ).tolist():
        change = int(place.changed[cell])
        turned = place.mu[change - 1, cell] >= SURE_GRIP and place.mu[change, cell] < below
        if turned:
            found = moments[(moments >= change) & warned[:, cell]]
            out.append(
                min(float(found[0] - change), UNNOTICED_MOST) if len(found) else UNNOTICED_MOST
            )
    return np.array(out)


def precision(truth: FloatArray, warned: BoolArray) -> float:
    """Return the precision of warnings: the share of warned cells and times that were truly
    slippery.
    """
    return float((truth[warned] < SLIPPERY_MU).mean()) if warned.any() else float("nan")


def recall(truth: FloatArray, warned: BoolArray, below: float = SLIPPERY_MU) -> float:
    """Return the recall of warnings: the share of the cells and times with a true friction less
    than `below` that had a warning.
    """
    return float(warned[truth < below].mean())


def measure_rate(cars: int, seeds: range, demand: float = 1.0) -> dict[str, float]:
    """Simulate towns with `cars` cars per hour and road, and return the figures of the map and of
    the two simple rules by name. `demand` multiplies the grip that drivers use.
    """
    towns = []
    for seed in seeds:
        rng = np.random.default_rng([seed, 37])
        place = town.draw_town(rng, MINUTES, CHANGING)
        towns.append((place, read_map(place, drive_cars(rng, place, cars, demand))))
    truth, width, slippery = (np.concatenate([of[k] for _, of in towns]) for k in range(3))
    out = {f"known.r{cars}": float((width < NARROW).mean())}
    out[f"slippery.grip_raised.r{cars}"] = float((slippery[truth > SURE_GRIP] > RAISED).mean())
    for label, field in (("alert", "alerted"), ("two_events", "two_events"), ("median", "median")):
        warned = np.concatenate([getattr(of, field) for _, of in towns])
        minutes = np.concatenate(
            [count_unnoticed(place, getattr(of, field)) for place, of in towns]
        )
        out[f"{label}.precision.r{cars}"] = precision(truth, warned)
        out[f"{label}.recall.r{cars}"] = recall(truth, warned)
        unnoticed = "unnoticed" if label == "alert" else f"{label}.unnoticed"
        out[f"{unnoticed}.r{cars}"] = median_of(minutes)
    alerted = np.concatenate([of.alerted for _, of in towns])
    minutes = np.concatenate([count_unnoticed(place, of.alerted, ICE_MOST) for place, of in towns])
    out[f"alert.recall.ice.r{cars}"] = recall(truth, alerted, ICE_MOST)
    out[f"unnoticed.ice.r{cars}"] = median_of(minutes)
    return out


def median_of(values: FloatArray) -> float:
    """Return the median of the values, or NaN if there are none."""
    return float(np.median(values)) if len(values) else float("nan")


def measure(seeds: range, log_line: Callable[[str], None]) -> dict[str, float]:
    """Simulate towns with different amounts of traffic, and return the figures of this module by
    name: known share of the road, precision and recall of warnings, minutes until ice is noticed.
    `log_line` is called with a line about the progress after each amount of traffic.
    """
    out: dict[str, float] = {}
    for cars in CARS:
        out |= {
            f"fusion.value.{name}": value
            for name, value in measure_rate(cars, seeds[:SEEDS]).items()
        }
        log_line(f"value at {cars} cars an hour: {len(seeds[:SEEDS])} towns")
    gentle = measure_rate(CARS[-1], seeds[:SEEDS], GENTLE)
    raised = gentle[f"slippery.grip_raised.r{CARS[-1]}"]
    return out | {"fusion.demand.slippery.grip_raised": raised}
