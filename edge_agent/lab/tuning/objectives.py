"""Scores of a set of memberships (parameters of the fuzzy sets) on simulated drives.

Legend
    l, u, mu    stated 5 % and 95 % quantiles of friction, and the true mean of the four wheels [1]
    IS          (u - l) + 20*max(l - mu, 0) + 20*max(mu - u, 0), mean over samples and drives [1]
    v, S        innovation of an update, and its covariance as the filter predicts it, with the
                adapted R
    l_v         -1/2 (v' S^-1 v + ln det 2 pi S), summed over updates, per second of driving [nat/s]
    NIS         v' S^-1 v over its expectation [1]

IS and l_v are proper scores: on average, a filter has the best score if it states the true
distribution. Therefore inflating R does not improve them. Paper 004's objective (equation 33,
variance mismatch) is not a proper score, and neither is the error of an estimate. IS is the score
of Gneiting and Raftery (JASA 2007).

l_v does not need the true friction, but it judges only the prediction of the next update.
Persistent errors hardly change it. A tuning on l_v alone therefore chooses R as small as the white
noise, and friction intervals become too narrow. The objective `predictive` corrects this: it is l_v
minus a cost for the deviation of NIS from 1. README.md, section "Choices", explains the default
objective.

The simulated cars have sensor errors like real cars: misaligned sensors and delayed clocks. They
drive on slopes. In towns, half of the cars have no torque signal. The drives of a search and the
held-out drives share no seed, no vehicle file and no pair of manoeuvre and vehicle.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np

from edge_agent.adaptation.memberships import Memberships
from edge_agent.estimators import create
from edge_agent.lab.simulation import DriveSetup, SimulatedFleet, simulate_manoeuvre
from edge_agent.lab.simulation.scenarios import drawn_town
from edge_agent.lab.tuning.search import Objective
from schemas.errors import InputError
from schemas.numeric import BoolArray, FloatArray
from schemas.signals import CHANNELS, per_wheel
from schemas.thresholds import SLIPPERY_MU, SURFACES
from schemas.vehicle import Vehicle

RATE_HZ: Final = 100.0
# [s] scores begin at this time; before, they depend on the initial covariance
SETTLED_S: Final = 1.0
# [nat] lower limit of the log-likelihood of one update, also used for NaN, so that one bad update
# does not determine the score.
WORST: Final = -1e3
# [nat/s] cost per squared logarithm of NIS over its expected value: 24 nat/s for a variance that is
# wrong by a factor of two.
CALIBRATION: Final = 50.0
LEAST_NIS: Final = 1e-3
MISS: Final = 20.0  # 2/α of a 90 % interval

# [s] time in a town before the recording begins, because its cars start at walking pace
WARM_S: Final = 15.0


@dataclass(frozen=True)
class TuningDrive:
    """One simulated drive of a set for tuning: manoeuvre, vehicle, friction and seed."""

    manoeuvre: str
    vehicle: str
    mu: float
    seed: int
    road: str = "hilly"
    sensors: str = "rough"


TRAIN: Final = (
    TuningDrive("double-lane-change", "sedan", 0.85, 101, "hilly"),
    TuningDrive("slalom", "small", 0.30, 103, "stepped"),
    TuningDrive("sine", "van", 0.50, 104, "banked"),
    TuningDrive("acceleration", "sedan", 0.40, 106, "rolling"),
    TuningDrive("braking", "van", 0.70, 107, "hilly"),
    TuningDrive("constant-radius", "small", 0.35, 109, "rolling"),
    TuningDrive("pulses", "sedan", 0.80, 110, "hilly"),
    TuningDrive("j-turn", "van", 0.95, 122, "stepped"),
)
HELD_OUT: Final = (
    TuningDrive("double-lane-change", "van", 0.70, 901, "stepped"),
    TuningDrive("slalom", "sedan", 0.25, 902, "hilly"),
    TuningDrive("sine", "sedan", 0.55, 903, "rolling"),
    TuningDrive("acceleration", "small", 0.70, 904, "hilly"),
    TuningDrive("braking", "sedan", 0.85, 906, "banked"),
    TuningDrive("gentle-braking", "small", 0.60, 907, "rolling"),
    TuningDrive("constant-radius", "sedan", 0.40, 908, "hilly"),
    TuningDrive("constant-radius", "van", 0.30, 909, "stepped"),
    TuningDrive("j-turn", "sedan", 0.90, 910, "hilly"),
    TuningDrive("pulses", "van", 0.50, 911, "rolling"),
)
# Seeds of the towns, and number of cars in each.
TOWNS: Final = {
    "train": ((61, 62), 8),
    "held_out": ((901, 902), 8),
}
ROUGH_SHARE: Final = 0.5  # share of inaccurate cars in a town
# Share of the samples on wet and dry road that may be false ice at no cost.
MOST_FALSE_ICE: Final = 0.0012
# increase of the interval score per share of false ice above the limit
FALSE_ICE_PRICE: Final = 60.0
MISSED_ICE_PRICE: Final = 0.5  # increase of the interval score per share of missed ice
# Distance of friction below SLIPPERY_MU within which slippery and other roads cannot be
# distinguished.
SURE_MARGIN: Final = 0.04
FELT_SHARE: Final = 0.9  # used share of the friction from which a slippery road can be noticed


@dataclass(frozen=True)
class TuningSet:
    """Drives of equal length, as arrays in the form that an estimator bank (filters advanced
    together) requires.
    """

    vehicles: tuple[Vehicle, ...]
    t: FloatArray  # (T, N) [s]
    signals: FloatArray  # (T, N, channels)
    mu: FloatArray  # (T, N) true friction, mean of the wheels; NaN where unknown
    used: FloatArray  # (T, N) largest share of its friction that a wheel uses; NaN where unknown


@dataclass(frozen=True)
class TuningScores:
    """Scores of memberships on simulated drives. Interval score and coverage are NaN if the true
    friction is unknown.
    """

    interval_score: float  # less is better [1]
    coverage: float  # share of samples whose truth lies in the 90 % interval [1]
    log_likelihood: float  # log-likelihood of the innovations; more is better [nat/s]
    nis_ratio: float  # NIS over its expectation; near 1 where the stated covariance is right [1]
    # interval score, mean over the kinds of surface; less is better [1]
    surface_score: float = math.nan
    # share of the samples on wet and dry road whose interval lies below SLIPPERY_MU [1]
    false_ice: float = math.nan
    # share of the samples on noticeable ice and snow whose interval does not lie below SLIPPERY_MU
    # [1]
    missed_ice: float = math.nan


def detection_cost(scores: TuningScores) -> float:
    """Return the interval score plus a cost for false ice and a cost for missed ice. Because both
    have a cost, a search gains nothing if it reduces one error by increasing the other.
    """
    false_ice = max(scores.false_ice - MOST_FALSE_ICE, 0.0)
    return scores.surface_score + FALSE_ICE_PRICE * false_ice + MISSED_ICE_PRICE * scores.missed_ice


# Objectives by name; each returns the number to maximise.
OBJECTIVES: Final[dict[str, Callable[[TuningScores], float]]] = {
    "interval": lambda scores: -detection_cost(scores),
    "innovation": lambda scores: scores.log_likelihood,
    "predictive": lambda scores: (
        scores.log_likelihood - CALIBRATION * math.log(max(scores.nis_ratio, LEAST_NIS)) ** 2
    ),
}


def record_drives(drives: Sequence[TuningDrive], duration_s: float) -> TuningSet:
    """Simulate the drives, each `duration_s` [s] long, and return them as one set for tuning."""
    signals = []
    truth = []
    used = []
    vehicles = []
    for drive in drives:
        log, vehicle = simulate_manoeuvre(
            drive.manoeuvre,
            mu=drive.mu,
            seed=drive.seed,
            duration_s=duration_s,
            setup=DriveSetup(
                rate_hz=RATE_HZ, vehicle=drive.vehicle, sensors=drive.sensors, road=drive.road
            ),
        )
        signals.append(
            np.stack([log[name].to_numpy() for name in CHANNELS], axis=-1).astype(np.float64)
        )
        truth.append(np.mean([log[name].to_numpy() for name in per_wheel("true_mu")], axis=0))
        used.append(
            np.max([log[name].to_numpy() for name in per_wheel("true_utilisation")], axis=0)
        )
        vehicles.append(vehicle)
    t = np.arange(len(signals[0]))[:, None] / RATE_HZ + np.zeros(len(drives))
    return TuningSet(
        tuple(vehicles),
        t,
        np.stack(signals, axis=1),
        np.stack(truth, axis=1),
        np.stack(used, axis=1),
    )


def record_all(name: str, duration_s: float) -> TuningSet:
    """Simulate all drives and towns of the set called `name`, "train" (for the search) or
    "held_out", each `duration_s` [s] long. Return them as one set for tuning.
    """
    sets = [record_drives(TRAIN if name == "train" else HELD_OUT, duration_s)]
    seeds, cars = TOWNS[name]
    sets += [record_town(seed, cars, duration_s) for seed in seeds]
    vehicles = tuple(vehicle for one in sets for vehicle in one.vehicles)
    t = np.repeat(sets[0].t[:, :1], len(vehicles), axis=1)
    return TuningSet(
        vehicles,
        t,
        np.concatenate([one.signals for one in sets], axis=1),
        np.concatenate([one.mu for one in sets], axis=1),
        np.concatenate([one.used for one in sets], axis=1),
    )


def record_town(seed: int, cars: int, duration_s: float) -> TuningSet:
    """Simulate cars in a town that is drawn randomly by the seed, and return their drives. The
    first WARM_S seconds of each drive are left out. The share ROUGH_SHARE of the cars has large
    sensor errors, as real cars have.
    """
    fleet = SimulatedFleet(drawn_town(seed), cars, seed, RATE_HZ, rough=ROUGH_SHARE)
    fleet.step(round(WARM_S * RATE_HZ))
    t, signals = fleet.step(round(duration_s * RATE_HZ))
    truth = fleet.truth
    return TuningSet(
        tuple(fleet.vehicles),
        t - t[0],
        signals,
        truth.mu_wheel.mean(axis=-1),
        truth.utilisation.max(axis=-1),
    )


def interval_score(lower: FloatArray, upper: FloatArray, truth: FloatArray) -> FloatArray:
    """Return the interval score of each 90 % interval, in the shape and unit of `truth`."""
    score: FloatArray = (
        upper - lower + MISS * (np.maximum(lower - truth, 0.0) + np.maximum(truth - upper, 0.0))
    )
    return score


def scores_of(memberships: Memberships, drives: TuningSet, estimator: str) -> TuningScores:
    """Run the estimator on the drives, and return the scores (such as interval score and missed
    ice) of the estimates after the first second.
    """
    estimates = create(estimator, drives.vehicles, memberships=memberships).advance(
        drives.t, drives.signals, threads=2
    )
    settled = drives.t.min(axis=1) >= SETTLED_S
    rate_hz = (len(drives.t) - 1) / float(np.mean(drives.t[-1] - drives.t[0]))
    lower = estimates.mu_lower[settled]
    upper = estimates.mu_upper[settled]
    truth = drives.mu[settled]
    log_likelihoods = np.nan_to_num(
        estimates.innovation_log_likelihood[settled], nan=WORST, neginf=WORST, posinf=WORST
    )
    return TuningScores(
        interval_score=float(interval_score(lower, upper, truth).mean()),
        coverage=float(
            np.where(np.isnan(truth), np.nan, (lower <= truth) & (truth <= upper)).mean()
        ),
        log_likelihood=float(np.maximum(log_likelihoods, WORST).mean()) * rate_hz,
        nis_ratio=float(np.nanmean(estimates.innovation_nis[settled])),
        **detection_scores(lower, upper, truth, drives.used[settled]),
    )


def detection_scores(
    lower: FloatArray, upper: FloatArray, truth: FloatArray, used: FloatArray
) -> dict[str, float]:
    """Return three scores of 90 % friction intervals (T, N).

    `surface_score` is the interval score, averaged over the kinds of surface; NaN if no kind
    occurs. `false_ice` is the share of samples on wet and dry road whose interval lies below
    SLIPPERY_MU. `missed_ice` is the share of samples whose interval does not lie below SLIPPERY_MU,
    among those on clearly slippery road with enough grip in use.
    """
    score = interval_score(lower, upper, truth)
    surfaces = [(truth > above) & (truth <= most) for above, most in SURFACES.values()]
    called = upper < SLIPPERY_MU
    is_noticeable = (truth < SLIPPERY_MU - SURE_MARGIN) & (used >= FELT_SHARE)
    means = [score[on_surface].mean() for on_surface in surfaces if on_surface.any()]
    return {
        "surface_score": float(np.mean(means or [np.nan])),
        "false_ice": _share(called, truth > SURFACES["wet"][0]),
        "missed_ice": _share(~called, is_noticeable),
    }


def _share(of: BoolArray, among: BoolArray) -> float:
    return float(of[among].mean()) if among.any() else 0.0


def objective_on(drives: TuningSet, estimator: str, name: str) -> Objective:
    """Return the objective called `name` as a function. The function takes a vector of memberships,
    and returns their score with `estimator` on `drives`. For an invalid vector it returns the worst
    value, -infinity.

    Raises:
        InputError: there is no objective with that name.
    """
    if name not in OBJECTIVES:
        raise InputError(
            "objective", f"{name!r} is unknown", f"choose one of {', '.join(OBJECTIVES)}"
        )

    def objective(vector: FloatArray) -> float:
        try:
            memberships = Memberships.from_vector(vector)
        except InputError:
            return -np.inf
        return OBJECTIVES[name](scores_of(memberships, drives, estimator))

    return objective


def candidate_values(positions: int) -> tuple[FloatArray, ...]:
    """Return an array of `positions` candidate values for every parameter of the memberships, such
    as a corner of a fuzzy set ("vertex") or a noise scale. The candidates are evenly spaced within
    the parameter's bounds; the one nearest to the default value is replaced by the default.
    """
    default = Memberships().to_vector()
    found = []
    for value, lower, upper in zip(default, *Memberships.bounds(), strict=True):
        spaced = np.linspace(lower, upper, positions)
        spaced[np.argmin(np.abs(spaced - value))] = value
        found.append(spaced)
    return tuple(found)
