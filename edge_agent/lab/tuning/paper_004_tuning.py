"""The tuning of paper 004 as printed: sixteen lower vertices (feet of the fuzzy sets), three noise
levels, and a choice of objectives.

The drive is the double lane change at 80 km/h on the printed tyre, with initial covariance P_0 =
.2*I and process noise Q = .1*T^2 for the sampling interval T. The noise variance and the filter's R
both are .1, .05 and .01 in turn (section IV.A). Objectives, larger is better:

    mismatch     1/(1 + |e|), e the mean difference between actual and theoretical innovation
                 variance (33)
    likelihood   mean log-likelihood of the innovations [nat per sample]; inflating R does not
                 increase it
    error        minus the mean over v_x, v_y, yaw rate and mu of the RMSE divided by the printed
                 RMSE; it requires the true values
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np

from edge_agent.adaptation.lower_vertices import LowerVertices
from edge_agent.adaptation.memberships import Memberships
from edge_agent.estimators import Estimates
from edge_agent.estimators.paper_aco_fckf import AS_PRINTED, Setting, make_bank
from edge_agent.lab.evaluation.batch import DriveSet, DriveSpec, repeat_drive, simulate_ideal
from edge_agent.lab.simulation.white import add_white
from edge_agent.lab.tuning.colony import Habits, optimise
from edge_agent.lab.tuning.search import Problem, Result
from schemas.numeric import FloatArray

LEVELS: Final = (0.1, 0.05, 0.01)  # variances of the noise, and of R
# Positions of a lower vertex; 1 is the peak of the neighbouring set.
POSITIONS: Final = np.array([0.3, 0.55, 0.8, 1.0, 1.25, 1.5, 1.8])
PREFERENCE: Final = 0.6  # spread of the visibility around the untuned position
CHUNK: Final = 25  # samples between two readings of the variance windows: 0.5 s
# [nat] lower limit of the log-likelihood of one sample, also used for NaN
WORST: Final = -1e3
# RMSE printed in the paper
SCALES: Final = {"vx": 0.0813, "vy": 0.0212, "yaw_rate": 0.0063, "mu": 0.0259}

Sets = Memberships | LowerVertices


@dataclass(frozen=True)
class LevelDrive:
    """Simulated drive at one level of measurement noise, and the setting of the filter that the
    tuning runs on this drive.

    `batch` contains several copies of the drive that differ only in the random noise. In `setting`,
    the noise variance R that the filter assumes equals the true noise variance of the drive.
    """

    batch: DriveSet
    setting: Setting


def record_levels(
    spec: DriveSpec, seeds: Sequence[int], setting: Setting = AS_PRINTED
) -> list[LevelDrive]:
    """Simulate a drive without errors. Return, for each noise level, a set of copies of the drive,
    one per seed, to which white noise of this level is added.
    """
    exact = simulate_ideal(spec)
    levels = []
    for level in LEVELS:
        batch = repeat_drive(exact, len(seeds))
        variance = np.full(len(batch.t), level)
        for n, seed in enumerate(seeds):
            add_white(batch.signals[:, n], variance, np.random.default_rng([seed, 6]))
        levels.append(LevelDrive(batch, setting._replace(noise=(level,) * 3)))
    return levels


def likelihood(sets: Sets, drive: LevelDrive) -> float:
    """Run paper 004's filter with the given fuzzy sets on a drive; return the mean log-likelihood
    of its innovations (measurement minus prediction) [nat per sample].
    """
    reported = _run_filter(sets, drive)
    value = np.nan_to_num(
        reported.innovation_log_likelihood[1:], nan=WORST, neginf=WORST, posinf=WORST
    )
    return float(np.maximum(value, WORST).mean())


def mismatch(sets: Sets, drive: LevelDrive) -> float:
    """Run paper 004's filter with the given fuzzy sets on a drive. Return the tuning objective of
    the paper's equation (33): 1/(1 + |e|), where |e| is the mean absolute difference between actual
    and theoretical variance of the innovations.
    """
    batch = drive.batch
    filters = make_bank(batch.vehicles, sets, drive.setting)
    differences = []
    for first in range(0, len(batch.t), CHUNK):
        part = slice(first, first + CHUNK)
        filters.advance(batch.t[part], batch.signals[part])
        differences.append(np.abs(filters.memory("actual") - filters.memory("theoretical")).mean())
    return float(1.0 / (1.0 + np.mean(differences)))


def accuracy(sets: Sets, drive: LevelDrive) -> float:
    """Run paper 004's filter with the given fuzzy sets on a drive; return the objective "error". It
    is minus the mean, over the estimated quantities (v_x, v_y, yaw rate, friction), of the RMSE
    divided by the RMSE printed in the paper.
    """
    reported = _run_filter(sets, drive)
    batch = drive.batch
    truth = {name: batch.truth[f"true_{name}"] for name in ("vx", "vy", "yaw_rate")} | {
        "mu": batch.mu
    }
    ratios = [
        np.sqrt(np.mean((getattr(reported, name) - truth[name]) ** 2)) / scale
        for name, scale in SCALES.items()
    ]
    return -float(np.mean(ratios))


OBJECTIVES: Final[dict[str, Callable[[Sets, LevelDrive], float]]] = {
    "likelihood": likelihood,
    "mismatch": mismatch,
    "error": accuracy,
}


def _run_filter(sets: Sets, drive: LevelDrive) -> Estimates:
    return make_bank(drive.batch.vehicles, sets, drive.setting).advance(
        drive.batch.t, drive.batch.signals
    )


def visibility() -> list[FloatArray]:
    """Return the visibility eta of the ant colony (equation (31) of paper 004), one array for each
    tuned number ("vertex"). Each array contains the prior preference for every possible value
    ("position"), which is larger for values near the untuned one.
    """
    preferred = np.exp(-0.5 * ((POSITIONS - 1.0) / PREFERENCE) ** 2)
    return [preferred] * len(LowerVertices().to_vector())


@dataclass(frozen=True)
class PaperTuning:
    """Result of the tuning: the tuned fuzzy sets, the objective's values over the iterations, and
    the final pheromone of the ant colony.

    The colony tunes 16 numbers ("vertices", the feet of the fuzzy sets). For each number it can
    choose among 7 values ("positions"). Therefore the shape of `pheromone` is (16, 7).
    """

    sets: LowerVertices
    result: Result
    pheromone: FloatArray


def tune(
    drives: Sequence[LevelDrive],
    objective: str,
    *,
    ants: int,
    iterations: int,
    seed: int,
) -> PaperTuning:
    """Tune the lower vertices with the ant colony; the objective is averaged over all noise
    levels.
    """
    score = OBJECTIVES[objective]
    laid: list[FloatArray] = []

    def value(vector: FloatArray) -> float:
        sets = LowerVertices.from_vector(vector)
        return float(np.mean([score(sets, drive) for drive in drives]))

    start = LowerVertices().to_vector()
    result = optimise(
        Problem(value, [POSITIONS] * len(start), start, visibility=visibility()),
        ants=ants,
        iterations=iterations,
        rng=np.random.default_rng([seed, 7]),
        habits=Habits(trace=laid.append),
    )
    return PaperTuning(LowerVertices.from_vector(result.best), result, laid[-1])
