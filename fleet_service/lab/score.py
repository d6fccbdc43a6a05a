"""How good an answer was: coverage, error, interval score, by the number of excited vehicles. Pure."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

import numpy as np

from fleet_service.lab.bars import COUNTS
from fleet_service.lab.town import CELLS, Town, Visits
from schemas import mugrid
from schemas.numeric import BoolArray, FloatArray, IntArray

ALPHA: Final = 0.10
ENOUGH: Final = 3  # excited vehicles, for an error to count
LEVELS: Final = np.linspace(0.05, 0.95, 19)


@dataclass(frozen=True)
class Scores:
    """Answers beside the truth, (k,); `vehicles` are the distinct excited ones that had been there."""

    vehicles: IntArray
    error: FloatArray
    covered: BoolArray
    interval: FloatArray
    rank: FloatArray
    truth: FloatArray

    def taken(self, rows: BoolArray) -> Scores:
        """Some of the answers."""
        return Scores(*(column[rows] for column in vars(self).values()))


def joined(scores: list[Scores]) -> Scores:
    """All answers of several runs."""
    return Scores(*(np.concatenate(columns) for columns in zip(*(vars(s).values() for s in scores), strict=True)))


def excited_vehicles(v: Visits, town: Town, minute: int, vehicles: int) -> IntArray:
    """Distinct excited vehicles that reported each cell until then, and since its surface changed, (CELLS,)."""
    since = np.where(town.changed <= minute, town.changed, 0.0) * 60.0
    rows = v.excited & (v.seconds < 60.0 * minute) & (v.seconds >= since[v.place])
    there = np.zeros((CELLS, vehicles), bool)
    there[v.place[rows], v.vehicle[rows]] = True
    return np.asarray(there.sum(axis=1))


def earlier_visits(v: Visits, until_s: float, vehicles: int) -> IntArray:
    """Visits of each vehicle until then, (vehicles,)."""
    return np.bincount(v.vehicle[v.seconds < until_s], minlength=vehicles)


def of_intervals(
    lower: FloatArray, mid: FloatArray, upper: FloatArray, truth: FloatArray, vehicles: IntArray, rank: FloatArray
) -> Scores:
    """Scores of 90 % intervals, all (k,). Interval score: width, and 2/α for each unit by which the truth is missed."""
    missed = np.maximum(lower - truth, 0.0) + np.maximum(truth - upper, 0.0)
    interval = upper - lower + 2.0 / ALPHA * missed
    return Scores(vehicles, mid - truth, missed == 0.0, interval, rank, truth)


def of_beliefs(belief: FloatArray, truth: FloatArray, vehicles: IntArray) -> Scores:
    """Scores of beliefs (k, 32); `rank` is P(μ ≤ truth), uniform where the beliefs are right."""
    lower, mid, upper = (mugrid.quantiles(belief, q) for q in (0.05, 0.5, 0.95))
    place = np.clip((truth - mugrid.LOWER) / (mugrid.UPPER - mugrid.LOWER) * mugrid.BINS, 0.0, mugrid.BINS - 1e-9)
    cdf = np.cumsum(belief, axis=1)
    bin_ = place.astype(np.int64)
    mass = np.take_along_axis(belief, bin_[:, None], axis=1)[:, 0]
    rank = np.take_along_axis(cdf, bin_[:, None], axis=1)[:, 0] - mass * (1.0 - (place - bin_))
    return of_intervals(lower, mid, upper, truth, vehicles, rank)


def snapshots(beliefs: list[FloatArray], town: Town, v: Visits, at: tuple[int, ...], vehicles: int) -> Scores:
    """Scores of the cells with an excited vehicle at some minutes."""
    out = []
    for minute in at:
        n = excited_vehicles(v, town, minute, vehicles)
        truth = town.mu[minute]
        out.append(of_beliefs(beliefs[minute - 1], truth, n).taken(n >= 1))
    return joined(out)


def rmse(s: Scores) -> float:
    """Root mean square error where ENOUGH excited vehicles were."""
    error = s.error[s.vehicles >= ENOUGH]
    return float(np.sqrt(np.mean(error**2))) if len(error) else float("nan")


def coverage(s: Scores) -> float:
    """Share of the truths inside the interval."""
    return float(s.covered.mean()) if len(s.covered) else float("nan")


def safe(s: Scores) -> float:
    """Share of the truths above the lower end, on which the deceleration that is called safe at 95 % rests."""
    return float((s.rank >= ALPHA / 2.0).mean()) if len(s.rank) else float("nan")


def coverage_by_count(s: Scores) -> dict[int, float]:
    """Coverage per class of vehicle counts."""
    edges = (*COUNTS[1:], np.iinfo(np.int64).max)
    return {
        n: coverage(s.taken((s.vehicles >= n) & (s.vehicles < end))) for n, end in zip(COUNTS, edges, strict=True)
    }  # fmt: skip


def reliability(s: Scores) -> FloatArray:
    """Share of truths below each of LEVELS, which the levels themselves would be if the beliefs were right."""
    return np.asarray((s.rank[:, None] <= LEVELS).mean(axis=0))
