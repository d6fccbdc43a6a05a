"""Evaluation with simulated fleets of another maker. Their vehicles do not run GripMap's agent:
they follow only the public contract (`schemas/README.md`), and have an error model of their own.
Pure (no I/O).

Each vehicle has a gain error (constant relative error), which affects both its value of μ and the
grip that it reports as used. Therefore the two are related in a way that is not a property of the
road, and a map that learned a correction from this relation would be wrong. The values have noise,
whose size the vehicles state correctly. Vehicles send complete log-likelihoods and none of the
optional columns.

There are two drives:

    honest fleet   300 cells in stretches of three; 15 visits per cell in 40 minutes, half of them
                   excited (with enough grip used to measure μ)
    change         30 cells change from μ = .85 to .15 and back, each phase 40 minutes; the fleet
                   also visits 300 cells as above

Legend
    g    gain error of a vehicle, relative, the same in value and grip used  (V,)
    s    share of the grip used in a visit                                   (n,)
    z    value, μ·(1 + g)·(1 + NOISE·e), e standard normal                   (n,)
    u    grip reported as used, s·μ·(1 + g)                                  (n,)
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Final, NamedTuple

import numpy as np
from numpy.random import Generator

from fleet_service.fusion import Fusion, Observations, observations_of
from fleet_service.fusion.normal import log_distribution
from fleet_service.fusion.store.records import MANOEUVRES
from fleet_service.lab import agent
from fleet_service.lab.agent import SimulatedReports
from fleet_service.lab.bars import EXCITED as CHANGE_EXCITED
from fleet_service.lab.drive import LATENESS_S, rows_of
from fleet_service.lab.score import Scores, coverage, join_scores, of_beliefs
from fleet_service.lab.town import CELL_M, FIX_STD_M, LENGTH, START, Visits, cell_numbers
from fleet_service.serve.alerts import Alerts
from schemas import mugrid
from schemas.numeric import BoolArray, FloatArray, IntArray
from schemas.thresholds import NS

VEHICLES: Final = 60
CELLS: Final = 300
STRETCH: Final = 3
FRICTIONS: Final = (0.1, 0.2, 0.35, 0.5, 0.7, 0.9, 1.0)
ICE: Final = 0.25  # true friction below this counts as ice
MINUTES: Final = 40
VISITS: Final = 15  # visits per cell
HARD_VISITS: Final = 0.5  # share of visits that are excited
SHARE: Final = (0.75, 0.97)  # share of the grip used in an excited visit
GENTLE: Final = (0.03, 0.12)  # share of the grip used in any other visit
NOISE: Final = 0.08
# standard deviations of the gain error g
GAINS: Final = {"third_party": 0.05, "third_party.gain_common": 0.10}

CHANGE_CELLS: Final = 30
CHANGE_STRETCH: Final = 6  # distance of changing cells in cells, so that they are no neighbours
DRY = 0.85
WHITE = 0.15
CHANGE_VISITS: Final = 240  # visits per cell, before and after the change
STEP_S: Final = 10.0  # [s] period in which alerts are read
NEVER: Final = 999
CHANGE_SEEDS: Final = 3

COLD_SEEDS: Final = 30  # number of fleets that are unknown to a new service
COLD_GAP_S: Final = 5.0


class ForeignDrive(NamedTuple):
    """Simulated drive of another maker's fleet: its visits (passages of cells), and the grid number
    of each cell.
    """

    visits: Visits
    cells: IntArray


def make_reports(
    rng: Generator, gain: FloatArray, vehicle: IntArray, mu: FloatArray, excited: BoolArray
) -> SimulatedReports:
    """Return the reports about n visits by vehicles with gain errors `gain` (V,)."""
    n = len(mu)
    share = np.where(excited, rng.uniform(*SHARE, n), rng.uniform(*GENTLE, n))
    seen = mu * (1.0 + gain[vehicle])
    reading = seen * (1.0 + NOISE * rng.normal(size=n))
    used = share * seen
    bound = log_distribution((mugrid.CENTRES - used[:, None]) / agent.BOUND_STD)
    value = agent.reading_likelihood(np.maximum(reading, mugrid.LOWER), np.full(n, NOISE), 0.0)
    std = np.where(excited, NOISE * reading, np.nan)
    return SimulatedReports(
        np.where(excited, reading, np.nan),
        std,
        used,
        np.zeros(n, np.int64),
        np.where(excited[:, None], value, bound),
    )


def make_observations(drive: ForeignDrive) -> Observations:
    """Return the visits of a drive as observations that a `Fusion` (the map's beliefs) accepts;
    their optional columns are absent.
    """
    rows = rows_of(drive.visits, drive.cells)
    rows["used_longitudinal"] = np.full(len(drive.visits), np.nan, np.float32)
    rows["used_lateral"] = rows["used_longitudinal"]
    return observations_of(rows, drive.visits.vehicle)


def place_fixes(rng: Generator, place: IntArray) -> IntArray:
    """Return the cells (n,) that vehicles report when they are in the middle of the cells `place`
    (n,); their position error has the standard deviation FIX_STD_M [m].
    """
    offset = 0.5 * CELL_M + FIX_STD_M * rng.normal(size=len(place))
    found = place + np.floor(offset / CELL_M).astype(np.int64)
    return np.where(found // LENGTH == place // LENGTH, found, place)


def drive_honest(rng: Generator, gain_std: float) -> tuple[ForeignDrive, FloatArray]:
    """Return a drive of the honest fleet of another maker, and the true friction of each cell
    (CELLS,).
    """
    mu = np.repeat(rng.choice(FRICTIONS, CELLS // STRETCH), STRETCH)
    n = CELLS * VISITS
    place = np.repeat(np.arange(CELLS), VISITS)
    seconds = rng.uniform(0.0, 60.0 * MINUTES, n)
    vehicle = rng.integers(0, VEHICLES, n)
    excited = rng.random(n) < HARD_VISITS
    reports = make_reports(rng, gain_std * rng.normal(size=VEHICLES), vehicle, mu[place], excited)
    order = np.argsort(seconds, kind="stable")
    visits = Visits(seconds, vehicle, place_fixes(rng, place), mu[place], excited, reports)
    return ForeignDrive(visits.take(order), cell_numbers(CELLS)), mu


def score_honest(rng: Generator, gain_std: float) -> tuple[Scores, BoolArray, IntArray]:
    """Return three results at the end of a drive of an honest fleet: the scores of the map, a mask
    of cells with an alert, and a number for each cell. This is the number of visits in which the
    vehicle used enough grip to measure the friction.
    """
    drive, mu = drive_honest(rng, gain_std)
    fusion = Fusion(LATENESS_S)
    alerts = Alerts(fusion)
    observations = make_observations(drive)
    for rows in split_by(drive.visits.seconds, STEP_S):
        alerts.update(fusion.update(observations.take(rows)).slots)
    now = START + 60 * MINUTES * NS
    alerts.expire(now)
    slots = fusion.slots_of(drive.cells, np.zeros(CELLS, np.int64))
    belief = fusion.beliefs(slots, now)
    excited_visits = np.bincount(drive.visits.place[drive.visits.excited], minlength=CELLS)
    return (
        of_beliefs(belief, mu, excited_visits),
        np.isin(slots, list(alerts.slots)),
        excited_visits,
    )


def split_by(seconds: FloatArray, step: float) -> list[IntArray]:
    """Return the row numbers of visits at the times `seconds` (n,), divided into one array for each
    period of `step` seconds. The times must be in ascending order.
    """
    borders = np.flatnonzero(np.diff(seconds // step)) + 1
    return np.split(np.arange(len(seconds)), borders)


def measure_honest(name: str, gain_std: float, seeds: range) -> dict[str, float]:
    """Simulate an honest fleet with each of the `seeds`, and return figures of the map: coverage
    and error of friction, share of false grip, false and missed alerts. `name` is the first part of
    the figures' names, `gain_std` the standard deviation of the vehicles' gain errors.
    """
    found = [score_honest(np.random.default_rng([seed, 23]), gain_std) for seed in seeds]
    scores = join_scores([one[0] for one in found])
    alerted = np.concatenate([one[1] for one in found])
    icy = scores.truth < ICE
    dry = scores.truth > 0.45
    return {
        f"{name}.coverage90": coverage(scores),
        f"{name}.false_grip": share_of(scores.rank < 0.05),
        f"{name}.rmse": float(np.sqrt(np.mean(scores.error**2))),
        f"{name}.width": float(scores.width.mean()),
        f"{name}.missed_ice": share_of(~alerted[icy]),
        f"{name}.false_ice": share_of(alerted[dry]),
        f"{name}.slippery.missed": share_of(scores.slippery[icy] < 0.3),
    }


def share_of(cells: BoolArray) -> float:
    """Return the share of cells for which the mask `cells` is True; NaN if there are no cells."""
    return float(cells.mean()) if len(cells) else float("nan")


def drive_change(rng: Generator, excitement: float) -> ForeignDrive:
    """Return a drive over cells that are dry (DRY), then icy (WHITE), then dry again. The same
    fleet also drives in a town.

    The first CHANGE_CELLS cells are the changing ones; the cells of the town follow. The vehicles
    drive in the town during all three phases.
    """
    town_mu = np.repeat(rng.choice(FRICTIONS, CELLS // STRETCH), STRETCH)
    changing = CHANGE_CELLS * CHANGE_VISITS * 3
    n = changing + CELLS * VISITS * 3
    seconds = np.sort(rng.uniform(0.0, 3 * 60.0 * MINUTES, n))
    road = (seconds // (60.0 * MINUTES)).astype(np.int64)
    here = rng.random(n) < changing / n
    place = np.where(
        here, rng.integers(0, CHANGE_CELLS, n), CHANGE_CELLS + rng.integers(0, CELLS, n)
    )
    mu = np.where(
        here, np.where(road == 1, WHITE, DRY), town_mu[np.maximum(place - CHANGE_CELLS, 0)]
    )
    vehicle = rng.integers(0, VEHICLES, n)
    excited = rng.random(n) < excitement
    reports = make_reports(
        rng, GAINS["third_party"] * rng.normal(size=VEHICLES), vehicle, mu, excited
    )
    roads = cell_numbers(CHANGE_CELLS * CHANGE_STRETCH + CELLS)
    cells = np.concatenate(
        [
            roads[: CHANGE_CELLS * CHANGE_STRETCH : CHANGE_STRETCH],
            roads[CHANGE_CELLS * CHANGE_STRETCH :],
        ]
    )
    return ForeignDrive(Visits(seconds, vehicle, place, mu, excited, reports), cells)


def count_passes(rng: Generator, excitement: float) -> tuple[IntArray, IntArray]:
    """Return two counts of excited passes (with enough grip used to measure the friction) over each
    changing cell: until the alert is raised, and until it is cleared.

    The first count begins at the change to WHITE, the second at the change back to DRY. Both are
    (CHANGE_CELLS,), with NEVER if the event did not occur.
    """
    drive = drive_change(rng, excitement)
    visits = drive.visits
    observations = make_observations(drive)
    fusion = Fusion(LATENESS_S)
    alerts = Alerts(fusion)
    raised = np.full(CHANGE_CELLS, NEVER)
    cleared = np.full(CHANGE_CELLS, NEVER)
    passes = np.zeros(CHANGE_CELLS, np.int64)
    phase = 0.0
    turned = 60.0 * MINUTES
    back = 2.0 * turned
    for rows in split_by(visits.seconds, STEP_S):
        alerts.update(fusion.update(observations.take(rows)).slots)
        last = visits.seconds[rows[-1]]
        if last // turned != phase:
            phase = last // turned
            passes[:] = 0
        excited = rows[visits.excited[rows] & (visits.place[rows] < CHANGE_CELLS)]
        passes += np.bincount(visits.place[excited], minlength=CHANGE_CELLS)
        slots = fusion.slots_of(drive.cells[:CHANGE_CELLS], np.zeros(CHANGE_CELLS, np.int64))
        under = np.isin(slots, list(alerts.slots))
        if turned <= last < back:
            raised[under & (raised == NEVER)] = passes[under & (raised == NEVER)]
        elif last >= back:
            ended = ~under & (raised != NEVER) & (cleared == NEVER)
            cleared[ended] = passes[ended]
    return raised, cleared


def measure_change(seeds: range) -> dict[str, float]:
    """Return medians and 95 % quantiles of the number of passes until an alert is raised and until
    it is cleared, and the number of cells in which the alert was not raised or not cleared. The
    figures are given for each share of visits with enough grip used to measure the friction.
    """
    out: dict[str, float] = {}
    for percent in CHANGE_EXCITED:
        found = [
            count_passes(np.random.default_rng([seed, 29]), percent / 100.0)
            for seed in seeds[:CHANGE_SEEDS]
        ]
        for name, which in (("raise", 0), ("clear", 1)):
            passes = np.concatenate([one[which] for one in found])
            label = f"third_party.{name}.excited_passes"
            out[f"{label}.median.e{percent}"] = float(np.median(passes))
            out[f"{label}.p95.e{percent}"] = float(np.quantile(passes, 0.95, method="higher"))
            out[f"third_party.{name}.never.e{percent}"] = float(np.sum(passes == NEVER))
    return out


def count_cold(rng: Generator) -> int:
    """Return the number of passes over ice until an alert is raised by a new service, which does
    not know the vehicles from earlier reports.

    The vehicles follow the error model of `agent`; each makes one pass.
    """
    n = VEHICLES
    who = np.arange(n)
    mu: FloatArray = np.full(n, WHITE)
    sure = np.ones(n, bool)
    along = np.zeros(n, np.int64)
    share = agent.used_shares(rng, sure)
    manoeuvre = rng.integers(0, MANOEUVRES, n)
    passes = agent.Passes(
        who, mu, agent.COMMON * rng.normal() + 0.0 * mu, share, rng.normal(size=n), manoeuvre, sure
    )
    reports = agent.draw_reports(rng, agent.Errors.draw(rng, n), passes)
    seconds = np.asarray(COLD_GAP_S * who, np.float64)
    observations = observations_of(rows_of(Visits(seconds, who, along, mu, sure, reports)), who)
    fusion = Fusion(LATENESS_S)
    alerts = Alerts(fusion)
    for k in range(n):
        if any(
            alert.raised
            for alert in alerts.update(fusion.update(observations.take(np.array([k]))).slots)
        ):
            return k + 1
    return NEVER


def measure_cold(seed: int) -> dict[str, float]:
    """Return quantiles, over COLD_SEEDS fleets, of the number of passes over ice until a new
    service raises an alert (`count_cold`).
    """
    found = np.array([count_cold(np.random.default_rng([seed, 31, k])) for k in range(COLD_SEEDS)])
    return {
        "cold.ice_passes.median": float(np.median(found)),
        "cold.ice_passes.p90": float(np.quantile(found, 0.9, method="higher")),
    }


def measure(seeds: range, log_line: Callable[[str], None]) -> dict[str, float]:
    """Run all simulations of this module, and return their figures by name.

    There are three: honest fleets, with each size of gain error in GAINS; a road whose friction
    changes; and a new service that has no earlier reports of the vehicles. `log_line` is called
    with a line about the progress after the honest fleets of each gain error.
    """
    out: dict[str, float] = {}
    for name, gain_std in GAINS.items():
        out |= measure_honest(name, gain_std, seeds)
        log_line(f"{name}: {len(seeds)} fleets")
    out |= measure_change(seeds)
    return {f"fusion.{name}": value for name, value in (out | measure_cold(seeds[0])).items()}
