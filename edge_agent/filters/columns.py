"""Cubature Kalman filter whose points lie in adjacent columns, for compiled functions that run
millions of steps per second.

Legend
    m, L     state's mean (n,), and lower-triangular square root of its covariance, P = L*L' (n, n)
    x        points in columns (n, 2n)
    q        standard deviations of the process noise, independent (n,)

Points and prediction equal those of `points` and `householder` with `sigma.cubature_rule`, but need
less work, because all weights are 1/(2n). Points lie along the contiguous axis, so that the
compiler can vectorise the model over points.
"""

from __future__ import annotations

import math

from edge_agent.filters.cholesky import factorize_column
from schemas.numeric import FloatArray
from schemas.runtime.jit import inlined


@inlined
def spread_points(mean: FloatArray, sqrt_cov: FloatArray, points: FloatArray) -> None:
    """Compute the cubature points (n, 2n) of a mean m (n,) and a square root L (n, n) of the
    covariance. Column j is m + sqrt(n)*L[:, j], and column n + j is m - sqrt(n)*L[:, j].
    """
    n = mean.shape[0]
    size = math.sqrt(n)
    for i in range(n):
        for j in range(n):
            step = size * sqrt_cov[i, j]
            points[i, j] = mean[i] + step
            points[i, n + j] = mean[i] - step


@inlined
def gather_points(
    points: FloatArray, noise_std: FloatArray, pace: float, mean: FloatArray, sqrt_cov: FloatArray
) -> None:
    """Compute mean (n,) and sqrt_cov (n, n), the root of the covariance, from propagated points (n,
    2n), and add process noise with the standard deviations pace*noise_std, where `pace` is a
    factor. Afterwards `points` contains the deviations from the mean.

    The mean is the first point plus the mean deviation from it, so that large offsets lose no
    digits. The covariance is summed and factorised, at half the cost of an orthogonal
    transformation. A pivot of the factorisation (variance of a state given the states before it) is
    never less than the state's own process noise variance. If rounding makes it smaller, it is set
    to that variance.
    """
    n, count = points.shape
    weight = 1.0 / count
    for i in range(n):
        total = 0.0
        for p in range(1, count):
            total += points[i, p] - points[i, 0]
        mean[i] = points[i, 0] + weight * total
        for p in range(count):
            points[i, p] -= mean[i]
    for i in range(n):
        for j in range(i + 1):
            total = 0.0
            for p in range(count):
                total += points[i, p] * points[j, p]
            sqrt_cov[i, j] = weight * total
    for j in range(n):
        own = (pace * noise_std[j]) ** 2
        sqrt_cov[j, j] += own
        factorize_column(sqrt_cov, j, own)
