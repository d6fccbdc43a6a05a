"""Rank-one downdate (subtraction of column*column') of a covariance factor. The downdate is refused
if the result would not be a covariance.
"""

from __future__ import annotations

import math

import numpy as np

from edge_agent.filters.householder import LOG_TWO_PI, Measurement, triangularize, update
from schemas.numeric import FloatArray
from schemas.runtime.jit import compiled

# [1] smallest remaining share of the variance in the direction of the column. Below it, rounding
# errors decide the sign.
LEAST_LEFT = 1e-12


@compiled
def downdate(sqrt_cov: FloatArray, column: FloatArray, white: FloatArray) -> bool:
    """Change a lower-triangular factor L (`sqrt_cov`, (n, n)) of a covariance to that of the
    smaller covariance L*L' - column*column', with column (n,). Return True.

    If the result would not be a covariance, return False and leave L unchanged. `white` (n,) is
    scratch memory.
    """
    n = column.shape[0]
    square = 0.0
    for i in range(n):
        total = column[i]
        for j in range(i):
            total -= sqrt_cov[i, j] * white[j]
        white[i] = total / sqrt_cov[i, i]
        square += white[i] * white[i]
    if not 1.0 - square > LEAST_LEFT:
        return False
    # Givens rotations, from the last coordinate to the first, turn (white, rest) into (0, 1).
    rest = math.sqrt(1.0 - square)
    carried = white.copy()
    for i in range(n):
        white[i] = 0.0
    for j in range(n - 1, -1, -1):
        norm = math.hypot(rest, carried[j])
        cos = rest / norm
        sin = carried[j] / norm
        rest = norm
        for i in range(j, n):
            spare = white[i]
            white[i] = cos * spare + sin * sqrt_cov[i, j]
            sqrt_cov[i, j] = cos * sqrt_cov[i, j] - sin * spare
    return True


@compiled
def update_by_downdate(
    mean: FloatArray,
    sqrt_cov: FloatArray,
    state_deviations: FloatArray,
    measurement: Measurement,
    work: FloatArray,
) -> tuple[int, float, float, bool]:
    """Run the measurement update in place as in paper 003: the covariance factor is downdated (its
    covariance is reduced) by one column per measurement.

    The arguments are as in `householder.update`. Return the number of measurements used, the
    log-likelihood [nat], the squared innovation over its covariance, and a flag that is True if a
    downdate was refused because the result would not be a covariance. In that case
    `householder.update`, which cannot fail, performs the step instead.
    """
    present = np.flatnonzero(~np.isnan(measurement.innovation))
    used = len(present)
    if used == 0:
        return 0, 0.0, 0.0, False
    innovation = measurement.innovation[present]
    deviations = measurement.deviations[present]
    points = deviations.shape[1]
    for a in range(used):
        work[a, :points] = deviations[a]
        work[a, points : points + used] = 0.0
        work[a, points + a] = measurement.noise_std[present[a]]
    triangularize(work, used, points + used)
    saved = sqrt_cov.copy()
    start = mean.copy()
    spare = np.empty_like(mean)
    gain = _cross_covariance(deviations, state_deviations)
    log_likelihood = -0.5 * used * LOG_TWO_PI
    square = 0.0
    white = innovation
    for a in range(used):
        for b in range(a):
            white[a] -= work[a, b] * white[b]
            gain[a] -= work[a, b] * gain[b]
        white[a] /= work[a, a]
        gain[a] /= work[a, a]
        log_likelihood -= math.log(work[a, a])
        square += white[a] ** 2
        mean += gain[a] * white[a]
        if not downdate(sqrt_cov, gain[a], spare):
            sqrt_cov[:, :] = saved
            mean[:] = start
            used, log_likelihood, square = update(
                mean, sqrt_cov, state_deviations, measurement, work
            )
            return used, log_likelihood, square, True
    return used, log_likelihood - 0.5 * square, square, False


@compiled
def _cross_covariance(deviations: FloatArray, state_deviations: FloatArray) -> FloatArray:
    """Return the covariance of each measurement with each state, (k, n), from the deviations of the
    measurements (k, points) and of the state (n, points).
    """
    count, points = deviations.shape
    n = state_deviations.shape[0]
    out = np.zeros((count, n))
    for a in range(count):
        for i in range(n):
            for p in range(points):
                out[a, i] += state_deviations[i, p] * deviations[a, p]
    return out
