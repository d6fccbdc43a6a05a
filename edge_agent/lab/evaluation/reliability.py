"""Reliability of quantiles: how often the true friction lies below each of the quantiles LEVELS of
an estimator's posterior. For a reliable estimator, the share equals the level of the quantile.

Estimates contain only the quantiles 5, 50 and 95 %. The posterior at other levels is found as
follows.

- The default estimator gives its posterior on the bins of the friction grid
  (`EstimatorBank.beliefs`).
- For other estimators, the posterior is assumed to be Gaussian, or uniform if the interval is as
  wide as the prior's (see `between_quantiles`).
"""

from __future__ import annotations

from itertools import pairwise
from typing import Final

import numpy as np

from edge_agent.estimators import Estimates, EstimatorBank
from edge_agent.lab.evaluation.batch import DriveSet
from schemas.mugrid import BINS, LOWER, UPPER
from schemas.numeric import FloatArray

LEVELS: Final = tuple(round(0.05 * k, 2) for k in range(1, 20))
EVERY_S: Final = 1.0
PRIOR_WIDTH: Final = 0.9 * (UPPER - LOWER)  # width of the prior's 90 % interval
EDGES: Final = np.linspace(LOWER, UPPER, BINS + 1)


def estimate_with_ranks(bank: EstimatorBank, batch: DriveSet) -> tuple[Estimates, FloatArray]:
    """Return the estimates of the drives, and an array (K, N) with the rank of the true friction at
    K times, EVERY_S apart, in N drives. The rank is the probability that the estimator's posterior
    gives to frictions below the true one.
    """
    samples = len(batch.t)
    step = max(1, round(EVERY_S / float(batch.t[1, 0] - batch.t[0, 0])))
    parts = []
    ranks = []
    for first, end in pairwise([*range(0, samples, step), samples]):
        parts.append(bank.advance(batch.t[first:end], batch.signals[first:end]))
        if end < samples:
            ranks.append(_rank_of_truth(bank, batch.mu[end - 1], parts[-1]))
    return join_estimates(parts), np.array(ranks).reshape(-1, batch.t.shape[1])


def join_estimates(parts: list[Estimates]) -> Estimates:
    """Join the estimates of successive parts of the same drives into one object, and return it. The
    joined object has no evidence (likelihoods of friction).
    """
    return Estimates(np.concatenate([part.values for part in parts]))


def _rank_of_truth(bank: EstimatorBank, truth: FloatArray, reported: Estimates) -> FloatArray:
    """Return, for each of N drives, the rank of the true friction `truth` (N,) now. The rank is the
    probability, according to the estimator's posterior, that the friction is smaller than the true
    one. `reported` contains the estimates up to now.
    """
    beliefs = bank.beliefs()
    if beliefs is None:
        return between_quantiles(
            truth, reported.mu_lower[-1], reported.mu[-1], reported.mu_upper[-1]
        )
    return on_the_grid(truth, beliefs[0])


def on_the_grid(truth: FloatArray, log_density: FloatArray) -> FloatArray:
    """Return the probability (N,) of friction below the true value `truth` (N,), according to
    posteriors on the friction grid, given as log(posterior/uniform) (N, 32).
    """
    weight = np.exp(log_density)
    below = np.cumsum(weight / weight.sum(axis=1, keepdims=True), axis=1)
    return np.array(
        [np.interp(mu, EDGES, [0.0, *row]) for mu, row in zip(truth, below, strict=True)]
    )


def between_quantiles(
    truth: FloatArray, lower: FloatArray, mu: FloatArray, upper: FloatArray
) -> FloatArray:
    """Return the probability (N,) of friction below the true value `truth`, for Gaussian
    distributions whose 5, 50 and 95 % quantiles are `lower`, `mu` and `upper` (N,).

    One of the outer quantiles may be clipped to the friction range. Therefore the standard
    deviation is computed from the outer quantile that is farther from the median. If the interval
    is as wide as the prior's, the distribution is assumed to be uniform.
    """
    from scipy.stats import norm

    std = np.maximum(np.maximum(mu - lower, upper - mu), 1e-9) / norm.ppf(0.95)
    uniform = (truth - LOWER) / (UPPER - LOWER)
    return np.where(upper - lower > PRIOR_WIDTH - 1e-6, uniform, norm.cdf((truth - mu) / std))


def rank_shares(ranks: FloatArray) -> FloatArray:
    """Return, for each of LEVELS, the share of drives and times at which the rank of the true
    friction (posterior probability of a smaller friction) is at most this level, (L,).
    """
    return np.asarray((ranks.ravel()[:, None] <= np.array(LEVELS)).mean(axis=0))
