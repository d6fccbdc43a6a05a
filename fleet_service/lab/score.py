"""Scores of map answers against the true friction: coverage, error, interval score and calibration.
Pure (no I/O).
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Final

import numpy as np

from fleet_service.lab.bars import COUNTS
from fleet_service.lab.town import CELLS, Town, Visits
from schemas import mugrid
from schemas.numeric import BoolArray, FloatArray, IntArray
from schemas.thresholds import SLIPPERY_MU, SURFACES

ALPHA: Final = 0.10
ENOUGH: Final = 3  # smallest number of excited vehicles of a cell whose error counts
# P(slippery) below which slippery road counts as missed, and above which road with grip counts as
# reported slippery
MISSED = 0.3
RAISED = 0.5
SURE_GRIP: Final = 0.45  # μ of snow and ice is below this, of wet and dry road above
BINS: Final = 10  # number of bins of P(slippery)
LEVELS: Final = np.linspace(0.05, 0.95, 19)


@dataclass(frozen=True)
class Scores:
    """Scores of k answers of the map, each attribute a column (k,). An answer is the belief about
    one cell at one time.

    `vehicles` is the number of distinct excited vehicles that had visited the cell, that is,
    vehicles that used enough grip to measure the friction. `interval` is the interval score, and
    `rank` is P(μ ≤ true value). `slippery` is P(slippery), and `crps` the continuous ranked
    probability score; both are NaN if an answer is an interval and not a distribution.
    """

    vehicles: IntArray
    error: FloatArray
    covered: BoolArray
    interval: FloatArray
    rank: FloatArray
    truth: FloatArray
    width: FloatArray
    slippery: FloatArray
    crps: FloatArray

    def taken(self, rows: BoolArray) -> Scores:
        """Return the scores of those answers (beliefs about one cell at one time) that `rows`
        selects.
        """
        return Scores(*(column[rows] for column in vars(self).values()))


def join_scores(scores: list[Scores]) -> Scores:
    """Return the scores of several runs as one object, which contains the answers of all runs."""
    return Scores(
        *(
            np.concatenate(columns)
            for columns in zip(*(vars(s).values() for s in scores), strict=True)
        )
    )


def excited_vehicles(visits: Visits, town: Town, minute: int, vehicles: int) -> IntArray:
    """Return the number of distinct excited vehicles that reported each cell before `minute` and
    after the last change of its surface, (CELLS,). An excited vehicle used enough grip to measure
    the friction.
    """
    since = np.where(town.changed <= minute, town.changed, 0.0) * 60.0
    rows = (
        visits.excited & (visits.seconds < 60.0 * minute) & (visits.seconds >= since[visits.place])
    )
    has_reported = np.zeros((CELLS, vehicles), bool)
    has_reported[visits.place[rows], visits.vehicle[rows]] = True
    return np.asarray(has_reported.sum(axis=1))


def earlier_visits(visits: Visits, until_s: float, vehicles: int) -> IntArray:
    """Return the number of visits (passages of cells) that each vehicle made before the time
    `until_s` [s], (vehicles,).
    """
    return np.bincount(visits.vehicle[visits.seconds < until_s], minlength=vehicles)


def of_intervals(
    quantiles: tuple[FloatArray, FloatArray, FloatArray],
    truth: FloatArray,
    vehicles: IntArray,
    rank: FloatArray,
    slippery: FloatArray,
) -> Scores:
    """Return the scores of 90 % intervals of friction for k answers of the map; each argument is an
    array (k,).

    `quantiles` are the 5 %, 50 % and 95 % quantiles. The interval score is the width plus 20 times
    the distance by which the interval misses the true value.
    """
    lower, mid, upper = quantiles
    missed = np.maximum(lower - truth, 0.0) + np.maximum(truth - upper, 0.0)
    interval = upper - lower + 2.0 / ALPHA * missed
    nothing: FloatArray = np.full(len(truth), np.nan)
    return Scores(
        vehicles,
        mid - truth,
        missed == 0.0,
        interval,
        rank,
        truth,
        upper - lower,
        slippery,
        nothing,
    )


def of_beliefs(belief: FloatArray, truth: FloatArray, vehicles: IntArray) -> Scores:
    """Return the scores of beliefs (k, 32) against the true friction (k,), such as errors and
    widths of their intervals. `rank` is P(μ ≤ true value), which is uniformly distributed for
    calibrated beliefs.
    """
    quantiles = (
        mugrid.quantiles(belief, 0.05),
        mugrid.quantiles(belief, 0.5),
        mugrid.quantiles(belief, 0.95),
    )
    place = np.clip(
        (truth - mugrid.LOWER) / (mugrid.UPPER - mugrid.LOWER) * mugrid.BINS,
        0.0,
        mugrid.BINS - 1e-9,
    )
    cdf = np.cumsum(belief, axis=1)
    bin_ = place.astype(np.int64)
    mass = np.take_along_axis(belief, bin_[:, None], axis=1)[:, 0]
    rank = np.take_along_axis(cdf, bin_[:, None], axis=1)[:, 0] - mass * (1.0 - (place - bin_))
    scores = of_intervals(quantiles, truth, vehicles, rank, belief @ mugrid.SLIPPERY_SHARE)
    return replace(scores, crps=crps_of(belief, truth))


def crps_of(belief: FloatArray, truth: FloatArray) -> FloatArray:
    """Return the continuous ranked probability score of beliefs (k, 32) that are flat within each
    bin, (k,).

    CRPS = ∫ (F(x) - 1[x ≥ truth])² dx; Gneiting and Raftery (2007), eq. 21. The integral is by the
    trapezoidal rule on a grid of eight points per bin.
    """
    fine = np.linspace(mugrid.LOWER, mugrid.UPPER, 8 * mugrid.BINS + 1)
    cdf = np.concatenate([np.zeros((len(belief), 1)), np.cumsum(belief, axis=1)], axis=1)
    part = np.arange(8) / 8.0
    inside = cdf[:, :-1, None] + belief[:, :, None] * part
    below = np.concatenate([inside.reshape(len(belief), -1), cdf[:, -1:]], axis=1)
    gap = np.square(below - (fine[None, :] >= truth[:, None]))
    return np.asarray(np.trapezoid(gap, fine, axis=1))


def score_snapshots(
    beliefs: Mapping[int, FloatArray],
    town: Town,
    visits: Visits,
    at: tuple[int, ...],
    vehicles: int,
    where: BoolArray | bool = True,
) -> Scores:
    """Return the scores of the map at the minutes `at`. Cells outside the mask `where` are left
    out, and so are cells in which no vehicle used enough grip to measure the friction.
    """
    out = []
    for minute in at:
        n = excited_vehicles(visits, town, minute, vehicles)
        truth = town.mu[minute]
        out.append(of_beliefs(beliefs[minute], truth, n).taken((n >= 1) & where))
    return join_scores(out)


def rmse(s: Scores) -> float:
    """Return the root mean square error of the map's friction values [1] over the cells in which at
    least ENOUGH vehicles used enough grip to measure the friction.
    """
    error = s.error[s.vehicles >= ENOUGH]
    return float(np.sqrt(np.mean(error**2))) if len(error) else float("nan")


def coverage(s: Scores) -> float:
    """Return the share of the map's answers whose 90 % interval contains the true friction."""
    return float(s.covered.mean()) if len(s.covered) else float("nan")


def safe_share(s: Scores) -> float:
    """Return the share of the map's answers that are safe: the true friction is not below the lower
    end of the 90 % interval, from which readers compute a safe deceleration.
    """
    return float((s.rank >= ALPHA / 2.0).mean()) if len(s.rank) else float("nan")


def of_class(s: Scores, n: int) -> Scores:
    """Return the scores of answers about one class of cells: those in which at least `n` vehicles,
    but fewer than the next larger number in COUNTS, used enough grip to measure the friction.
    """
    edges = (*COUNTS[1:], np.iinfo(np.int64).max)
    return s.taken((s.vehicles >= n) & (s.vehicles < edges[COUNTS.index(n)]))


def by_surface(s: Scores) -> dict[str, float]:
    """Return the share of true frictions inside the map's 90 % interval, for each kind of road in
    SURFACES separately.
    """
    return {
        name: coverage(s.taken((s.truth > above) & (s.truth <= to)))
        for name, (above, to) in SURFACES.items()
    }


def calibration(scores: Sequence[Scores]) -> FloatArray:
    """Return the calibration table of P(slippery), (BINS, 3).

    Columns: number of the map's answers, mean of their P(slippery), and share of them that were
    truly slippery.
    """
    given = np.concatenate([s.slippery for s in scores])
    truth = np.concatenate([s.truth for s in scores]) < SLIPPERY_MU
    place = np.clip((given * BINS).astype(np.int64), 0, BINS - 1)
    count = np.bincount(place, minlength=BINS)
    sums = [np.bincount(place, weights=of, minlength=BINS) for of in (given, truth.astype(float))]
    return np.stack([count, *(total / np.maximum(count, 1) for total in sums)], axis=1)


def slippery_scores(scores: Sequence[Scores]) -> dict[str, float]:
    """Return scores of the map's P(slippery) against the true friction, over all answers; for each
    of them smaller is better.

    brier        mean of (P(slippery) - truth)², where the truth is 1 for slippery road, else 0
    log          mean of -ln P, where P is the map's probability of the true case [nat]
    ece          expected calibration error: answers are sorted into BINS bins by their P(slippery);
                 mean over all answers of |mean P(slippery) - share of slippery road| in their bin
                 (Naeini et al., 2015)
    missed       share of the truly slippery answers with a P(slippery) below MISSED
    grip_raised  share of the answers about roads with grip (μ > SURE_GRIP) with a P(slippery)
                 above RAISED

    The error of the worst bin is not used as a score. It is mostly chance, because all cells of one
    simulated drive share the same snow.
    """
    given = np.concatenate([s.slippery for s in scores])
    truth = np.concatenate([s.truth for s in scores])
    slippery = truth < SLIPPERY_MU
    certain = np.clip(np.where(slippery, given, 1.0 - given), 1e-6, 1.0)
    found = calibration(scores)
    return {
        "brier": mean_or_nan(np.square(given - slippery)),
        "log": mean_or_nan(-np.log(certain)),
        "ece": float(np.sum(found[:, 0] * np.abs(found[:, 1] - found[:, 2])) / max(len(given), 1)),
        "missed": mean_or_nan(given[slippery] < MISSED),
        "grip_raised": mean_or_nan(given[truth > SURE_GRIP] > RAISED),
    }


def false_grip(s: Scores) -> float:
    """Return the share of false grip: answers of the map whose whole 90 % interval lies above the
    true friction, so that the road is more slippery than the map states.
    """
    return mean_or_nan(s.rank < ALPHA / 2.0)


def false_ice(s: Scores) -> float:
    """Return the share of false ice: answers of the map whose whole 90 % interval lies below the
    true friction, so that the road has more grip than the map states.
    """
    return mean_or_nan(s.rank > 1.0 - ALPHA / 2.0)


def mean_or_nan(values: FloatArray | BoolArray) -> float:
    """Return the mean of the measured values, or NaN if there are none. A figure that is NaN misses
    its target.
    """
    return float(values.mean()) if len(values) else float("nan")


def reliability(s: Scores) -> FloatArray:
    """Return, as an array, for each quantile level in LEVELS the share of the map's answers in
    which the true friction is below this quantile of the belief. For calibrated beliefs the result
    equals LEVELS.
    """
    return np.asarray((s.rank[:, None] <= LEVELS).mean(axis=0))
