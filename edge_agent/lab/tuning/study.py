"""Study of paper 004's tuning with the paper's filter and noise. It compares untuned fuzzy sets,
random search and ant colony, for correct and wrong measurement noise R of the filter.

The filter is `paper-aco-fckf` as in the paper's experiments: white noise only on a_x, a_y and r,
exact inputs, start at the true state. The true noise is therefore known, and the filter's R can be
exactly right, ten times too small or ten times too large. The objective is the mean log-likelihood
of the innovations over all conditions [nat/s]. Inflating R does not improve it, in contrast to the
paper's own objective (equation 33). Held-out drives share neither seed nor manoeuvre with the
drives of the search.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Final, NamedTuple

import numpy as np

from edge_agent.adaptation.memberships import CHANNELS, SETS, Memberships
from edge_agent.estimators.paper_aco_fckf import AT_THE_TRUTH, Setting, make_bank
from edge_agent.lab.simulation import PRESETS, DriveSetup, simulate_manoeuvre
from edge_agent.lab.simulation.manoeuvres import kmh
from edge_agent.lab.simulation.presets import matched_to_papers
from edge_agent.lab.simulation.white import add_white, scheduled_variance
from edge_agent.lab.tuning import colony, random_search
from edge_agent.lab.tuning.objectives import candidate_values, interval_score
from edge_agent.lab.tuning.search import Objective, Problem, Progress, Result
from schemas.numeric import FloatArray
from schemas.signals import CHANNELS as SIGNALS
from schemas.vehicle import Vehicle

VERTICES: Final = 2 * SETS
RATE_HZ: Final = 50.0  # sampling rate of the paper
FINE: Final = 10  # simulation steps per sample; the steering is constant during a step
DURATION_S: Final = 6.0  # period of the paper's noise schedule
MU: Final = AT_THE_TRUTH.mu
VARIANCE: Final = AT_THE_TRUTH.noise[0]  # variance of the noise of all three measurements [SI]
# [nat] lower limit of the log-likelihood of one sample, also used for NaN
WORST: Final = -1e3
WAYS: Final[dict[str, Callable[..., Result]]] = {
    "random": random_search.optimise,
    "colony": colony.optimise,
}


class Condition(NamedTuple):
    """Condition of a study: measurement noise that the filter assumes, and true noise of the
    simulation.

    The filter assumes the constant variance R = `scale` * VARIANCE. The true noise has the constant
    variance VARIANCE. If `schedule` is True, its variance changes over time by the paper's schedule
    instead.
    """

    scale: float
    schedule: bool = False


CONDITIONS: Final = {
    "right": Condition(1.0),
    "too-small": Condition(0.1),
    "too-large": Condition(10.0),
    "schedule": Condition(1.0, schedule=True),
}


class StudyDrive(NamedTuple):
    """One simulated drive of the study, given by manoeuvre, vehicle, speed and seed, on a road with
    friction MU.
    """

    manoeuvre: str
    vehicle: str
    speed: float  # [m/s]
    seed: int


TRAIN: Final = (
    StudyDrive("double-lane-change", "sedan", kmh(80), 301),
    StudyDrive("sine", "small", kmh(60), 302),
    StudyDrive("slalom", "sedan", kmh(35), 303),
    StudyDrive("pulses", "van", kmh(50), 304),
)
HELD_OUT: Final = (
    StudyDrive("two-lane-changes", "small", kmh(60), 951),
    StudyDrive("j-turn", "van", kmh(50), 952),
    StudyDrive("accelerating-sine", "sedan", kmh(70), 953),
    StudyDrive("brisk-acceleration", "small", kmh(30), 954),
    StudyDrive("low-turn", "sedan", kmh(60), 955),
    StudyDrive("moderate-braking", "van", kmh(80), 956),
)


@dataclass(frozen=True)
class StudySet:
    """N drives of equal length: t (T, N) [s], noisy readings `signals` (T, N, 18) by condition,
    true v_x, v_y and yaw rate (T, N, 3).
    """

    vehicles: tuple[Vehicle, ...]
    t: FloatArray
    signals: dict[str, FloatArray]
    truth: FloatArray


class StudyScores(NamedTuple):
    """Scores of memberships (fuzzy sets) under one condition of the measurement noise R, averaged
    over the drives.
    """

    log_likelihood: float  # log-likelihood of the innovations, more is better [nat/s]
    nis: float  # NIS per measurement, near 1 if the stated covariance is right [1]
    rmse_vx: float  # [m/s]
    rmse_vy: float  # [m/s]
    rmse_yaw_rate: float  # [rad/s]


def record_noisy_drives(drives: Sequence[StudyDrive], duration_s: float = DURATION_S) -> StudySet:
    """Simulate the drives, each `duration_s` [s] long. Return their readings once for each entry of
    CONDITIONS, with the measurement noise that the entry states.
    """
    exact = []
    truth = []
    vehicles = []
    for drive in drives:
        log, vehicle = simulate_manoeuvre(
            drive.manoeuvre,
            mu=MU,
            speed=drive.speed,
            duration_s=duration_s,
            setup=DriveSetup(
                rate_hz=FINE * RATE_HZ,
                vehicle=matched_to_papers(PRESETS[drive.vehicle]),
                sensors="ideal",
            ),
        )
        log = log.take(np.arange(0, len(log), FINE))
        exact.append(
            np.stack([log[name].to_numpy(zero_copy_only=False) for name in SIGNALS], axis=-1)
        )
        truth.append(
            np.stack([log[f"true_{name}"].to_numpy() for name in ("vx", "vy", "yaw_rate")], axis=-1)
        )
        vehicles.append(vehicle)
    signals = np.stack(exact, axis=1).astype(float)
    seeds = [drive.seed for drive in drives]
    t = np.arange(len(signals))[:, None] / RATE_HZ + np.zeros(len(drives))
    noisy = {
        name: _noisy(signals, t[:, 0], seeds, condition) for name, condition in CONDITIONS.items()
    }
    return StudySet(tuple(vehicles), t, noisy, np.stack(truth, axis=1))


def _noisy(
    exact: FloatArray, t: FloatArray, seeds: Sequence[int], condition: Condition
) -> FloatArray:
    """Return a copy of the signals `exact` (T, N, 18) with white noise added to a_x, a_y and yaw
    rate: the noise of the given condition, with one seed per drive.
    """
    variance = scheduled_variance(t) if condition.schedule else np.full(len(t), VARIANCE)
    noisy = exact.copy()
    for n, seed in enumerate(seeds):
        add_white(noisy[:, n], variance, np.random.default_rng([seed, 5]))
    return noisy


def filter_setting(condition: Condition) -> Setting:
    """Return the setting of paper 004's filter for a condition: its noise R is VARIANCE times the
    condition's `scale`.
    """
    return AT_THE_TRUTH._replace(noise=(condition.scale * VARIANCE,) * 3)


def scores_of(memberships: Memberships, drives: StudySet, name: str) -> StudyScores:
    """Return the scores of memberships on the drives under the condition of the measurement noise R
    called `name`.
    """
    filters = make_bank(drives.vehicles, memberships, filter_setting(CONDITIONS[name]))
    reported = filters.advance(drives.t, drives.signals[name])
    log_likelihoods = np.nan_to_num(
        reported.innovation_log_likelihood[1:], nan=WORST, neginf=WORST, posinf=WORST
    )
    motion = np.stack([reported.vx, reported.vy, reported.yaw_rate], axis=-1)
    rmse = np.sqrt(((motion - drives.truth) ** 2).mean(axis=0)).mean(axis=0)
    return StudyScores(
        float(np.maximum(log_likelihoods, WORST).mean()) * RATE_HZ,
        float(reported.innovation_nis[1:].mean()),
        *map(float, rmse),
    )


def score_interval(memberships: Memberships, drives: StudySet, name: str) -> tuple[float, float]:
    """Return (interval score, coverage) of the 90 % friction interval under the condition of the
    measurement noise called `name`.
    """
    reported = make_bank(drives.vehicles, memberships, filter_setting(CONDITIONS[name])).advance(
        drives.t, drives.signals[name]
    )
    truth = np.full(reported.mu.shape, MU)
    inside = (reported.mu_lower <= truth) & (truth <= reported.mu_upper)
    return float(interval_score(reported.mu_lower, reported.mu_upper, truth).mean()), float(
        inside.mean()
    )


def mean_log_likelihood(memberships: Memberships, drives: StudySet) -> float:
    """Return the objective of the search: the mean log-likelihood of the innovations (measurement
    minus prediction) over all conditions of the measurement noise R [nat/s].
    """
    return float(
        np.mean([scores_of(memberships, drives, name).log_likelihood for name in CONDITIONS])
    )


def memberships_of(vector: FloatArray) -> Memberships:
    """Return the memberships with the ten vertices (corners) in `vector`. All other parameters keep
    their untuned values. Noise scales are not tuned either, because each condition of the study
    fixes the measurement noise R.
    """
    return Memberships.from_vector(np.append(vector, np.zeros(CHANNELS)))


def objective_on(drives: StudySet) -> Objective:
    """Return the objective of the search on the given drives, as a function of a vector of ten
    vertices (corners of fuzzy sets).
    """
    return lambda vector: mean_log_likelihood(memberships_of(vector), drives)


def problem_on(drives: StudySet, positions: int) -> Problem:
    """Return the problem of the search on the given drives, with the number of positions (possible
    values) per vertex. Every search starts at the untuned vertices (corners of the fuzzy sets).
    """
    return Problem(
        objective_on(drives),
        candidate_values(positions)[:VERTICES],
        Memberships().to_vector()[:VERTICES],
    )


def run_search(
    way: str,
    problem: Problem,
    *,
    ants: int,
    iterations: int,
    seed: int,
    progress: Progress | None = None,
) -> Result:
    """Search for the best vertices by the method `way`, "random" or "colony", and return the
    result. `seed` is the seed of the search.
    """
    return WAYS[way](
        problem,
        ants=ants,
        iterations=iterations,
        rng=np.random.default_rng([seed, list(WAYS).index(way)]),
        progress=progress,
    )
