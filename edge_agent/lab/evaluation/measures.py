"""Measures of estimates against the true values; every measure is one number per drive, (N,).

NEES is the squared error of (v_x, v_y) over its stated variance, per component [1]. It is 1 on
average if the stated standard deviation is right. NIS is the squared innovation (measurement minus
prediction) over its stated variance, per measurement [1]. If the filter is consistent, the mean
over N drives at one instant lies within chi-squared bounds in 95 % of all cases (Bar-Shalom, Li,
Kirubarajan 2001, 5.4).
"""

from __future__ import annotations

import numpy as np

from edge_agent.estimators import Estimates
from edge_agent.lab.evaluation.batch import DriveSet
from schemas.numeric import BoolArray, FloatArray
from schemas.thresholds import CALLED_SHARE

LAST_S = 1.0  # [s] length of "the last second"
# Difference in friction. A smaller error counts as converged; the bounds of an interval that misses
# the truth by more are wrong.
NEAR = 0.1
HOLD_S = 0.2  # [s] a wrong interval that lasts this long is a false change
SLOWEST_M_S = 1.0
# Number of independent squares in each measure. Every estimator uses at least three measurements.
COMPONENTS = {
    "nees": 2,
    "nis": 3,
}


def motion_errors(batch: DriveSet, reported: Estimates) -> dict[str, FloatArray]:
    """Return the errors (T, N) of the estimated motion: vx, vy [m/s], yaw_rate [rad/s], beta
    (sideslip) [rad].
    """
    truth = batch.truth
    beta = np.arctan2(truth["true_vy"], np.maximum(truth["true_vx"], SLOWEST_M_S))
    return {
        "vx": reported.vx - truth["true_vx"],
        "vy": reported.vy - truth["true_vy"],
        "yaw_rate": reported.yaw_rate - truth["true_yaw_rate"],
        "beta": reported.sideslip - beta,
    }


def is_covered(batch: DriveSet, reported: Estimates) -> BoolArray:
    """Return an array (T, N) that is True where the reported 90 % interval contains the true mean
    friction of the wheels.
    """
    return np.asarray((reported.mu_lower <= batch.mu) & (batch.mu <= reported.mu_upper))


def common_measures(batch: DriveSet, reported: Estimates) -> dict[str, FloatArray]:
    """Return the measures that every kind of drive has, by name, (N,) each: errors, coverage and
    width of the friction interval, share of the time reported as slippery, NIS, NEES.
    """
    end = batch.last(LAST_S)
    found: dict[str, FloatArray] = {}
    for name, error in motion_errors(batch, reported).items():
        found[f"mae_{name}"] = np.abs(error).mean(axis=0)
        found[f"rmse_{name}"] = np.sqrt((error**2).mean(axis=0))
    found["rmse_mu"] = np.sqrt(((reported.mu - batch.mu) ** 2).mean(axis=0))
    found["mae_mu"] = np.abs(reported.mu - batch.mu).mean(axis=0)
    found["mu_error"] = np.abs(reported.mu - batch.mu)[end].mean(axis=0)
    found["coverage90"] = is_covered(batch, reported).mean(axis=0)
    found["end_coverage90"] = is_covered(batch, reported)[end].mean(axis=0)
    found["slippery"] = (reported.p_slippery > CALLED_SHARE).mean(axis=0)
    found["width"] = (reported.mu_upper - reported.mu_lower).mean(axis=0)
    found["nis"] = reported.innovation_nis.mean(axis=0)
    found["nees"] = nees(batch, reported).mean(axis=0)
    return found


def nees(batch: DriveSet, reported: Estimates) -> FloatArray:
    """Return the NEES (normalised estimation error squared): the squared error of (v_x, v_y) over
    its stated variance, as the mean over the two components, (T, N).
    """
    off = motion_errors(batch, reported)
    return np.asarray(
        0.5 * ((off["vx"] / reported.vx_std) ** 2 + (off["vy"] / reported.vy_std) ** 2)
    )


def mean_bounds(measure: str, drives: int) -> tuple[float, float]:
    """Return the lower and upper 95 % bounds for the mean of `measure` ("nees" or "nis") over
    `drives` drives at one instant. They hold for a filter whose stated variances are right.
    """
    from scipy.stats import chi2

    count = COMPONENTS[measure] * drives
    return float(chi2.ppf(0.025, count)) / count, float(chi2.ppf(0.975, count)) / count


def consistency_shares(batch: DriveSet, reported: Estimates) -> dict[str, FloatArray]:
    """Return the share of instants at which the mean NEES and the mean NIS (normalised squared
    errors and innovations) over all drives lie within their bounds, (1,) each.
    """
    found = {}
    for name, value in (("nees", nees(batch, reported)), ("nis", reported.innovation_nis)):
        low, high = mean_bounds(name, value.shape[1])
        mean = value.mean(axis=1)
        found[f"{name}_within"] = np.array([((low <= mean) & (mean <= high)).mean()])
    return found


def side_measures(batch: DriveSet, reported: Estimates) -> dict[str, FloatArray]:
    """Return two measures for drives on a road with different friction left and right: the friction
    error on the slippery side, and the coverage of the friction interval on the other side. Both
    are computed over the last LAST_S [s] of each drive, one value per drive.
    """
    end = batch.last(LAST_S)
    truth = batch.mu_wheel
    wheels = reported.mu_wheel
    if wheels is None:
        whole = np.stack([reported.mu, reported.mu_lower, reported.mu_upper], axis=-1)
        wheels = np.repeat(whole[:, :, None, :], 4, axis=2)
    low = truth <= truth.min(axis=-1, keepdims=True)
    middle = np.abs(wheels[..., 0] - truth)
    inside = (wheels[..., 1] <= truth) & (truth <= wheels[..., 2])
    return {
        "low_error": np.asarray(np.nanmean(np.where(low, middle, np.nan)[end], axis=(0, 2))),
        "high_coverage90": np.asarray(np.nanmean(np.where(low, np.nan, inside)[end], axis=(0, 2))),
    }


def arrival_time(batch: DriveSet, reported: Estimates) -> FloatArray:
    """Return, per drive, the time [s] from the change of friction until the friction estimate is
    within NEAR of the new value. If this never happens, return the time from the change to the end
    of the drive.
    """
    changed = batch.mu == batch.mu[-1]
    seconds = np.empty(batch.t.shape[1])
    for n in range(len(seconds)):
        first = int(np.argmax(changed[:, n]))
        near = np.abs(reported.mu[first:, n] - batch.mu[first:, n]) <= NEAR
        last = int(np.argmax(near)) if near.any() else len(near) - 1
        seconds[n] = batch.t[first + last, n] - batch.t[first, n]
    return seconds


def false_changes(batch: DriveSet, reported: Estimates) -> FloatArray:
    """Return, for each of N drives with constant friction, the number of false reports of a change.
    A false report is a stretch of at least HOLD_S [s] in which the friction interval lies more than
    NEAR away from the true friction.
    """
    wrong = (reported.mu_upper < batch.mu - NEAR) | (reported.mu_lower > batch.mu + NEAR)
    hold = max(1, round(HOLD_S / float(batch.t[1, 0] - batch.t[0, 0])))
    count = np.zeros(wrong.shape[1])
    run = np.zeros(wrong.shape[1], dtype=np.int64)
    for row in wrong:
        run = np.where(row, run + 1, 0)
        count += run == hold
    return count
