"""A simulated town: roads as rows of cells, their friction over time, and the drives of a fleet.
Pure (no I/O).

Every road has stretches of one surface each. Most passes use little grip. Where drivers brake or
steer depends on the place: a few cells get many excited visits (with much grip used), most get
hardly any. Vehicles that do the same manoeuvre in the same place share an error. Positions are
noisy, so a visit is sometimes reported for the previous or the next cell.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Final

import numpy as np
from numpy.random import Generator

from fleet_service.fusion.store.records import MANOEUVRES
from fleet_service.lab import agent
from fleet_service.lab.agent import CLEAN, ErrorModel, Errors, Passes, SimulatedReports
from schemas import grid
from schemas.numeric import BoolArray, FloatArray, IntArray
from schemas.thresholds import NS

START: Final = 1_800_000_000 * NS
# number of roads, and of cells per road
ROADS = 10
LENGTH = 12
CELLS: Final = ROADS * LENGTH
STRETCH: Final = 4  # length of a stretch with one surface, in cells
# surface: mean of μ, its spread, share of the roads
SURFACES: Final = {
    "dry": (0.85, 0.08, 0.45),
    "wet": (0.55, 0.07, 0.25),
    "snow": (0.30, 0.04, 0.15),
    "ice": (0.15, 0.03, 0.15),
}
# limits of the friction of any road
LEAST = 0.08
MOST = 1.10
DRIFT: Final = 0.03  # standard deviation of μ after one hour
ZONE: Final = 6  # cells with equal excitement: some 60 m, for braking from 50 km/h or a bend
# probability that a pass is excited, and share of the cells that have it
EXCITEMENT: Final = ((0.40, 0.2), (0.08, 0.4), (0.02, 0.4))
CELL_M = 10.0
FIX_STD_M = 1.5
_NORTH = 57.70
_WEST = 11.90


def cell_numbers(cells: int = CELLS) -> IntArray:
    """Return the grid number (quadint) of each cell of the simulated town, (cells,). The cells of a
    road lie in a row from west to east, and the roads are a few cells apart.
    """
    x, y = grid.deinterleave(grid.cell_of(_NORTH, _WEST))
    k = np.arange(cells)
    return grid.interleave(x + k % LENGTH, y + 3 * (k // LENGTH))


@dataclass(frozen=True)
class Town:
    """Simulated town with its roads and their friction over time.

    Attributes:
        mu: friction at the beginning of each minute, (minutes + 1, cells).
        excitement: probability that a pass uses enough grip to measure the friction, (cells,).
        changed: minute in which the surface of a cell changes, (cells,), infinite for never.
        common: error that the vehicles share, by manoeuvre, (cells, 4).
        usual: most frequent manoeuvre, (cells,).
    """

    mu: FloatArray
    excitement: FloatArray
    changed: FloatArray
    common: FloatArray
    usual: IntArray

    def at(self, seconds: FloatArray, place: IntArray) -> FloatArray:
        """Return the true friction (n,) of the town's cells at the times `seconds` (n,) and places
        `place` (n,).
        """
        return np.asarray(
            self.mu[np.minimum((seconds // 60.0).astype(np.int64), len(self.mu) - 1), place]
        )


def draw_town(rng: Generator, minutes: int, changing: float, model: ErrorModel = CLEAN) -> Town:
    """Return a random town. `changing` is the share of roads whose surface changes at some minute
    of the simulated drive.
    """
    names = list(SURFACES.values())
    share = [s[2] for s in SURFACES.values()]
    stretches = CELLS // STRETCH

    def draw_surface() -> FloatArray:
        drawn = rng.choice(len(names), stretches, p=share)
        mean = np.array([n[0] for n in names])[drawn]
        spread = np.array([n[1] for n in names])[drawn]
        return np.repeat(mean + spread * rng.normal(size=stretches), STRETCH)

    steps = (
        DRIFT
        * np.sqrt(1 / 60)
        * np.vstack([np.zeros(stretches), rng.normal(size=(minutes, stretches))])
    )
    before = draw_surface()
    after = draw_surface()
    change = np.where(
        rng.random(ROADS) < changing, rng.uniform(0.2, 0.8, ROADS) * minutes, np.inf
    ).repeat(LENGTH)
    now = np.where(np.arange(minutes + 1)[:, None] < change, before, after)
    classes, weights = zip(*EXCITEMENT, strict=True)
    excitement = np.repeat(rng.choice(classes, CELLS // ZONE, p=weights), ZONE)
    mu = np.clip(now + np.repeat(steps.cumsum(axis=0), STRETCH, axis=1), LEAST, MOST)
    own = rng.spawn(1)[0]  # a generator for errors only, so that each error model gets this town
    zones = CELLS // ZONE
    common = model.common * own.normal(size=(zones, 1)) + model.by_manoeuvre * own.normal(
        size=(zones, MANOEUVRES)
    )
    usual = np.repeat(own.integers(0, MANOEUVRES, zones), ZONE)
    return Town(mu, excitement, np.ceil(change), np.repeat(common, ZONE, axis=0), usual)


@dataclass(frozen=True)
class Visits:
    """Visits (passages of cells) in order of time, (n,): seconds since the start, vehicle, reported
    place, true μ, mask of excited visits (which used enough grip to measure μ), and reports.
    """

    seconds: FloatArray
    vehicle: IntArray
    place: IntArray
    mu: FloatArray
    excited: BoolArray
    reports: SimulatedReports

    def __len__(self) -> int:
        return len(self.seconds)

    def take(self, rows: IntArray | BoolArray) -> Visits:
        """Return the visits that `rows` (numbers or a mask) selects."""
        return Visits(
            self.seconds[rows],
            self.vehicle[rows],
            self.place[rows],
            self.mu[rows],
            self.excited[rows],
            SimulatedReports(*(column[rows] for column in vars(self.reports).values())),
        )


def drive_fleet(
    rng: Generator, town: Town, errors: Errors, minutes: float, acquainted: float = 0.0
) -> Visits:
    """Simulate the drives of a fleet through a town: each vehicle passes a whole road every minute
    on average, at random times. Return the visits.

    Args:
        rng: random generator.
        town: the town.
        errors: errors of the vehicles; their number is the size of the fleet.
        minutes: length of the simulation [min].
        acquainted: minute at which the fleet changes to other roads. Before it, vehicles drive only
            on the first half of the roads; afterwards, only on the other half. The service then
            knows the vehicles, but not the roads. If it is 0, all roads are used all the time.
    """
    vehicles = len(errors.slope)
    model = errors.model
    passes = rng.poisson(vehicles * minutes)
    begin = rng.random(passes) * minutes * 60.0
    who = rng.integers(0, vehicles, passes)
    along = np.tile(np.arange(LENGTH), passes)
    seconds = np.repeat(begin, LENGTH) + along
    roads = rng.integers(0, ROADS, passes)
    if acquainted:
        roads = roads // 2 + np.where(begin < 60.0 * acquainted, 0, ROADS // 2)
    vehicle = np.repeat(who, LENGTH)
    place = np.repeat(roads * LENGTH, LENGTH) + along
    excited = rng.random(len(place)) < town.excitement[place]
    mu = town.at(seconds, place)
    manoeuvre = np.where(
        rng.random(len(place)) < model.usual_share,
        town.usual[place],
        rng.integers(0, MANOEUVRES, len(place)),
    )
    shares = agent.used_shares(rng, excited, model)
    noise = agent.reading_noise(rng, along, model.tails)
    common = town.common[place, manoeuvre]
    reports = agent.draw_reports(
        rng, errors, Passes(vehicle, mu, common, shares, noise, manoeuvre, excited)
    )
    offset = rng.uniform(0.0, CELL_M, len(place)) + FIX_STD_M * rng.normal(size=len(place))
    reported_at = place + np.clip(np.floor(offset / CELL_M).astype(np.int64), -1, 1)
    reported_place = np.where(reported_at // LENGTH == place // LENGTH, reported_at, place)
    order = np.argsort(seconds, kind="stable")
    visits = Visits(seconds, vehicle, reported_place, mu, excited, reports)
    return visits.take(order)


def claim_falsely(visits: Visits, liars: BoolArray, claim: float) -> Visits:
    """Return the visits with false reports: the vehicles that the mask `liars` (V,) selects report
    the friction `claim` with high confidence, instead of their own values.
    """
    lying = liars[visits.vehicle]
    claimed = with_claims(visits, lying, claim)
    reports = replace(
        claimed.reports,
        reading=np.where(lying, claim, visits.reports.reading),
        std=np.where(lying, agent.OVERCONFIDENT_STD, visits.reports.std),
    )
    return replace(claimed, reports=reports)


def with_claims(visits: Visits, lying: BoolArray, claim: FloatArray | float) -> Visits:
    """Return the visits with the likelihood and the grip used of a claimed friction `claim` (n,) in
    the visits that the mask `lying` (n,) selects. These visits do not count as excited. Readings
    and their standard deviations stay.
    """
    reports = visits.reports
    likelihood = agent.overconfident_likelihood(claim)
    claims = replace(
        reports,
        used=np.where(lying, claim, reports.used),
        log_likelihood=np.where(lying[:, None], likelihood, reports.log_likelihood),
    )
    return replace(visits, excited=visits.excited & ~lying, reports=claims)
