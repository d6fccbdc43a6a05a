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
    n, points = state_deviations.shape
    measured_deviations, innovation, noise_std = measurement
    rows = innovation.shape[0]
    place = np.empty(rows, np.int64)
    used = 0
    for k in range(rows):
        if not math.isnan(innovation[k]):
            place[used] = k
            used += 1
    if used == 0:
        return 0, 0.0, 0.0, False
    size = points + used
    for a in range(used):
        for p in range(size):
            work[a, p] = measured_deviations[place[a], p] if p < points else 0.0
        work[a, points + a] = noise_std[place[a]]
    triangularize(work, used, size)
    kept = sqrt_cov.copy()
    start = mean.copy()
    white = np.empty(n)
    gain = np.zeros((used, n))
    log_likelihood = -0.5 * used * LOG_TWO_PI
    square = 0.0
    whitened = np.empty(used)
    for a in range(used):
        whitened[a] = innovation[place[a]]
        for i in range(n):
            for p in range(points):
                gain[a, i] += state_deviations[i, p] * measured_deviations[place[a], p]
        for b in range(a):
            whitened[a] -= work[a, b] * whitened[b]
            gain[a] -= work[a, b] * gain[b]
        whitened[a] /= work[a, a]
        gain[a] /= work[a, a]
        log_likelihood -= math.log(work[a, a])
        square += whitened[a] ** 2
        mean += gain[a] * whitened[a]
        if not downdate(sqrt_cov, gain[a], white):
            sqrt_cov[:, :], mean[:] = kept, start
            used, log_likelihood, square = update(
                mean, sqrt_cov, state_deviations, measurement, work
            )
            return used, log_likelihood, square, True
    return used, log_likelihood - 0.5 * square, square, False
