"""What a set of memberships is worth on simulated drives.

Legend
    l, u, mu    stated 5 % and 95 % quantiles of friction, and the true mean of the four wheels [1]
    IS          (u - l) + 20*max(l - mu, 0) + 20*max(mu - u, 0), mean over samples and drives [1]
    v, S        innovation of an update and its covariance as stated before it, with the adapted R
    l_v         -1/2 (v' S^-1 v + ln det 2 pi S), summed over updates, per second of driving [nat/s]
    NIS         v' S^-1 v over its expectation [1]

Both objectives are proper scores: in expectation nothing beats stating the truth, so none is won by inflating R, as
paper 004's equation 33 (variance mismatch) and errors against truth are. IS is the score of Gneiting and Raftery
(JASA 2007). The innovations need no truth, but they look one update ahead and are blind to errors that last: R shrinks
to white noise, and friction intervals become too narrow. README has the figures of both.
Drives that a search sees and drives that judge it share no seed, no vehicle file and no pair of manoeuvre and vehicle.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Final

import numpy as np

from edge_agent.adaptation.memberships import Memberships
from edge_agent.estimators import create
from edge_agent.lab.simulation import simulate_manoeuvre
from edge_agent.lab.simulation.sensors import SENSORS, Sensors
from edge_agent.lab.tuning.search import Objective
from schemas.errors import InputError
from schemas.numeric import FloatArray
from schemas.signals import CHANNELS, per_wheel
from schemas.vehicle import Vehicle

RATE_HZ: Final = 100.0
SETTLED_S: Final = 1.0  # scored from here on; before, the score is that of the initial covariance
WORST: Final = -1e3  # [nat] of an update whose log-likelihood is lower or no number: one broken one is not the score
MISS: Final = 20.0  # 2/alpha of a 90 % interval

# Sensor sets: as good as the estimator takes them to be, and with white noise that it does not know of.
USUAL: Final = SENSORS["mems-leak"]
NOISY: Final = replace(USUAL, acceleration=(0.25, 0.03), yaw_rate=(0.01, 0.001), wheel_speed=0.12)


@dataclass(frozen=True)
class TuningDrive:
    """One simulated drive of a set."""

    manoeuvre: str
    vehicle: str
    mu: float
    seed: int
    sensors: Sensors = USUAL


TRAIN: Final = (
    TuningDrive("double-lane-change", "sedan", 0.85, 101),
    TuningDrive("double-lane-change", "small", 0.60, 102),
    TuningDrive("slalom", "small", 0.30, 103),
    TuningDrive("sine", "van", 0.50, 104),
    TuningDrive("sine", "small", 0.75, 105, NOISY),
    TuningDrive("acceleration", "sedan", 0.40, 106),
    TuningDrive("braking", "van", 0.70, 107),
    TuningDrive("gentle-braking", "sedan", 0.30, 108, NOISY),
    TuningDrive("constant-radius", "small", 0.35, 109),
    TuningDrive("pulses", "sedan", 0.35, 110),
    TuningDrive("pulses", "small", 0.80, 111, NOISY),
    TuningDrive("straight", "van", 0.85, 112),
    TuningDrive("double-lane-change", "sedan", 0.45, 113),
    TuningDrive("slalom", "van", 0.60, 114),
    TuningDrive("slalom", "small", 0.80, 115, NOISY),
    TuningDrive("sine", "van", 0.90, 116),
    TuningDrive("acceleration", "sedan", 0.85, 117),
    TuningDrive("braking", "small", 0.35, 118),
    TuningDrive("braking", "van", 0.25, 119, NOISY),
    TuningDrive("gentle-braking", "van", 0.80, 120),
    TuningDrive("constant-radius", "small", 0.70, 121),
    TuningDrive("j-turn", "van", 0.50, 122),
    TuningDrive("j-turn", "small", 0.30, 123, NOISY),
    TuningDrive("pulses", "sedan", 0.60, 124),
)
HELD_OUT: Final = (
    TuningDrive("double-lane-change", "van", 0.70, 901),
    TuningDrive("slalom", "sedan", 0.25, 902),
    TuningDrive("sine", "sedan", 0.55, 903, NOISY),
    TuningDrive("acceleration", "small", 0.70, 904),
    TuningDrive("acceleration", "van", 0.20, 905),
    TuningDrive("braking", "sedan", 0.85, 906),
    TuningDrive("gentle-braking", "small", 0.60, 907),
    TuningDrive("constant-radius", "sedan", 0.40, 908),
    TuningDrive("constant-radius", "van", 0.30, 909),
    TuningDrive("j-turn", "sedan", 0.90, 910),
    TuningDrive("pulses", "van", 0.50, 911, NOISY),
    TuningDrive("straight", "small", 0.30, 912),
)


@dataclass(frozen=True)
class TuningSet:
    """Drives of equal length side by side, as one bank takes them."""

    vehicles: tuple[Vehicle, ...]
    t: FloatArray  # (T, N) [s]
    signals: FloatArray  # (T, N, channels)
    mu: FloatArray  # (T, N) true friction, mean of the wheels


@dataclass(frozen=True)
class TuningScores:
    """Scores of memberships on recorded drives."""

    interval_score: float  # less is better [1]
    coverage: float  # share of samples whose truth lies in the 90 % interval [1]
    log_likelihood: float  # more is better [nat/s]
    nis_ratio: float  # near 1 where the stated covariance is right [1]


# objective by name -> the number to maximise
OBJECTIVES: Final[dict[str, Callable[[TuningScores], float]]] = {
    "interval": lambda scores: -scores.interval_score,
    "innovation": lambda scores: scores.log_likelihood,
}


def record(drives: Sequence[TuningDrive], duration_s: float) -> TuningSet:
    """Simulate the drives, each `duration_s` [s] long."""
    signals, truth, vehicles = [], [], []
    for drive in drives:
        log, vehicle = simulate_manoeuvre(
            drive.manoeuvre, mu=drive.mu, seed=drive.seed, rate_hz=RATE_HZ, duration_s=duration_s,
            vehicle=drive.vehicle, sensors=drive.sensors,
        )  # fmt: skip
        signals.append(np.stack([log[name].to_numpy() for name in CHANNELS], axis=-1).astype(np.float64))
        truth.append(np.mean([log[name].to_numpy() for name in per_wheel("true_mu")], axis=0))
        vehicles.append(vehicle)
    t = np.arange(len(signals[0]))[:, None] / RATE_HZ + np.zeros(len(drives))
    return TuningSet(tuple(vehicles), t, np.stack(signals, axis=1), np.stack(truth, axis=1))


def interval_score(lower: FloatArray, upper: FloatArray, truth: FloatArray) -> FloatArray:
    """IS of 90 % intervals, elementwise [unit of the truth]."""
    score: FloatArray = upper - lower + MISS * (np.maximum(lower - truth, 0.0) + np.maximum(truth - upper, 0.0))
    return score


def scores_of(memberships: Memberships, drives: TuningSet, estimator: str) -> TuningScores:
    """Run the estimator over the drives and score what it says after the first second."""
    estimates = create(estimator, drives.vehicles, memberships=memberships).advance(drives.t, drives.signals)
    settled = drives.t[:, 0] >= SETTLED_S
    lower, upper, truth = estimates.mu_lower[settled], estimates.mu_upper[settled], drives.mu[settled]
    log_likelihoods = np.nan_to_num(estimates.innovation_log_likelihood[settled], nan=WORST, neginf=WORST, posinf=WORST)
    return TuningScores(
        interval_score=float(interval_score(lower, upper, truth).mean()),
        coverage=float(((lower <= truth) & (truth <= upper)).mean()),
        log_likelihood=float(np.maximum(log_likelihoods, WORST).mean()) * RATE_HZ,
        nis_ratio=float(np.nanmean(estimates.innovation_nis[settled])),
    )


def objective_on(drives: TuningSet, estimator: str, name: str) -> Objective:
    """An objective over membership vectors; a vector that is no membership counts as the worst.

    Raises:
        InputError: there is no objective of that name.
    """
    if name not in OBJECTIVES:
        raise InputError("objective", f"{name!r} is unknown", f"choose one of {', '.join(OBJECTIVES)}")

    def objective(vector: FloatArray) -> float:
        try:
            memberships = Memberships.from_vector(vector)
        except InputError:
            return -np.inf
        return OBJECTIVES[name](scores_of(memberships, drives, estimator))

    return objective


def choices(positions: int) -> tuple[FloatArray, ...]:
    """Candidate positions of every vertex and noise scale: evenly over the bounds, the default among them."""
    default = Memberships().to_vector()
    found = []
    for value, lower, upper in zip(default, *Memberships.bounds(), strict=True):
        spaced = np.linspace(lower, upper, positions)
        spaced[np.argmin(np.abs(spaced - value))] = value
        found.append(spaced)
    return tuple(found)
