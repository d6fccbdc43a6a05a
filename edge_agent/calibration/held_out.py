"""Validation of a calibration on drives from which it was not learned.

A calibration has several groups of quantities (radii, steering, inertial unit, clocks, torque). A
group is kept only if the vehicle with this group predicts held-out drives at least as well as
without it. Two conditions decide: the predictive log-likelihood of the estimator's own innovations
does not decrease, and the time with the health flag CONTRADICTION (measurements contradict the
model) does not increase.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Final, NamedTuple, TypeAlias

import numpy as np

from edge_agent.calibration.learn import learn_calibration
from schemas.errors import InputError
from schemas.numeric import FloatArray
from schemas.vehicle import Calibration, Vehicle

GROUPS: Final = {
    "inertial unit": ("ax", "ay", "yaw_rate"),
    "radii": ("radius_fl", "radius_fr", "radius_rl", "radius_rr"),
    "steering": ("steer_offset", "steer_gain", "understeer"),
    "clocks": ("wheel_lag", "steer_lag"),
    "torque": ("force_gain",),
}
MOST_FOLDS: Final = 3  # maximum number of drives that are held out, one at a time
LEAST_PART_S: Final = 20.0  # [s] minimum length of each half of a single drive
WORSE: Final = 0.02  # [nat/s] a smaller difference between predictions is rounding
LONGER: Final = 0.005  # a smaller difference between times in contradiction is rounding

Drive: TypeAlias = tuple[FloatArray, FloatArray]
"""A drive: times (T,) [s] and signals (T, 18)."""


class Prediction(NamedTuple):
    """Score of a calibration on one drive: how well an estimator with this calibration predicts the
    drive's measurements.
    """

    log_likelihood: float  # log-likelihood of the innovations [nat/s]
    contradicted: float  # share of the time with the health flag CONTRADICTION


class HeldOut(NamedTuple):
    """Result of a validated calibration: the calibration to write, the groups of quantities left
    out of it, and the mean prediction scores on held-out drives. `score_without` is the score
    without the calibration, `score_with` the score with it.
    """

    calibration: Calibration
    refused: list[str]
    score_without: Prediction
    score_with: Prediction
    folds: int


DriveScorer: TypeAlias = Callable[[Vehicle, Drive], Prediction]
"""Function that replays a drive with a vehicle and returns the predictive score."""


def learn_validated(drives: Sequence[Drive], vehicle: Vehicle, score_drive: DriveScorer) -> HeldOut:
    """Learn a calibration from all drives. Keep only those groups of quantities with which an
    estimator predicts held-out drives at least as well as without them. `score_drive` replays a
    drive with a vehicle and returns the prediction score.

    Raises:
        InputError: no drive has enough excitation, or there is only one drive and it is too short
            to be cut in two.
    """
    whole = learn_calibration(drives, vehicle)
    folds = split_folds(drives)
    candidates = []
    held_out_drives = []
    for taught, held_out in folds:
        try:
            candidates.append(learn_calibration(taught, vehicle))
        except InputError:
            continue
        held_out_drives.append(held_out)
    if not held_out_drives:
        raise InputError(
            "log",
            "the logs are too short to hold out a part for validation",
            "give two drives or a longer one",
        )
    before = [score_drive(vehicle, held_out) for held_out in held_out_drives]
    best = before
    accepted = list[str]()
    refused = list[str]()
    for group, names in GROUPS.items():
        if not any(getattr(whole, name) is not None for name in names):
            continue
        tried = [
            score_drive(
                vehicle.model_copy(
                    update={"calibration": restrict_groups(candidate, [*accepted, group])}
                ),
                held_out,
            )
            for candidate, held_out in zip(candidates, held_out_drives, strict=True)
        ]
        if is_worse(tried, best):
            refused.append(group)
        else:
            best = tried
            accepted.append(group)
    return HeldOut(
        restrict_groups(whole, accepted),
        refused,
        _mean_prediction(before),
        _mean_prediction(best),
        len(held_out_drives),
    )


def split_folds(drives: Sequence[Drive]) -> list[tuple[list[Drive], Drive]]:
    """Return pairs (drives to learn from, drive to validate on). In each pair, one drive serves for
    validation and all others for learning; there are at most MOST_FOLDS pairs. A single drive is
    cut into two halves, which serve in turn; a drive that is too short gives no pair.
    """
    if len(drives) == 1:
        t, signals = drives[0]
        if t[-1] - t[0] < 2.0 * LEAST_PART_S:
            return []
        middle = int(np.searchsorted(t, 0.5 * (t[0] + t[-1])))
        parts = [(t[:middle], signals[:middle]), (t[middle:], signals[middle:])]
        return [([parts[0]], parts[1]), ([parts[1]], parts[0])]
    chosen = np.unique(
        np.linspace(0, len(drives) - 1, min(MOST_FOLDS, len(drives))).round().astype(int)
    )
    return [
        ([drive for k, drive in enumerate(drives) if k != held_out], drives[held_out])
        for held_out in chosen.tolist()
    ]


def restrict_groups(calibration: Calibration, groups: Sequence[str]) -> Calibration:
    """Return the calibration with only the quantities of the given groups (such as "steering" or
    "clocks").
    """
    names = {name for group in groups for name in GROUPS[group]}
    update = {name: None for every in GROUPS.values() for name in every if name not in names}
    return calibration.model_copy(update=update)


def is_worse(tried: Sequence[Prediction], best: Sequence[Prediction]) -> bool:
    """Return True if the predictions `tried` are worse than the predictions `best` on the same
    drives, or if they cannot be compared because a score is NaN.

    Either of two reasons suffices. The mean log-likelihood is lower by more than WORSE. Or, on at
    least one drive, the share of time with the flag CONTRADICTION is larger by more than LONGER.
    """
    lost_likelihood = _mean_prediction(best).log_likelihood - _mean_prediction(tried).log_likelihood
    longer = np.max(
        [new.contradicted - old.contradicted for new, old in zip(tried, best, strict=True)]
    )
    return not (lost_likelihood <= WORSE and bool(longer <= LONGER))


def _mean_prediction(predictions: Sequence[Prediction]) -> Prediction:
    likelihood = float(np.mean([prediction.log_likelihood for prediction in predictions]))
    return Prediction(
        likelihood, float(np.mean([prediction.contradicted for prediction in predictions]))
    )
