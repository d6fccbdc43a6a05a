"""The cubature filter with its points side by side, for kernels that step millions of times a second.

Legend
    m, L        state's mean (n,), and its lower-triangular square root of the covariance, P = L*L'     (n, n)
    x           points in columns                                                                      (n, 2n)
    q           standard deviations of the process noise, independent                                  (n,)
    f, a        row i of L, and the innovation variance f*f' + r of a measurement of state i

The same filter as `sigma.cubature` with `squareroot`, for two cases that allow less work: all weights are 1/(2n), and
what is measured is a state itself. Points lie along the fast axis, so that the model moves several at once.
"""

from __future__ import annotations

import math

from schemas.numeric import FloatArray
from schemas.runtime.jit import inlined


@inlined
def spread(mean: FloatArray, sqrt_cov: FloatArray, points: FloatArray) -> None:
    """points (n, 2n): column j is m + sqrt(n)*L[:, j], column n + j is m - sqrt(n)*L[:, j]."""
    n = mean.shape[0]
    size = math.sqrt(n)
    for i in range(n):
        for j in range(n):
            step = size * sqrt_cov[i, j]
            points[i, j], points[i, n + j] = mean[i] + step, mean[i] - step


@inlined
def gather(points: FloatArray, noise_std: FloatArray, pace: float, mean: FloatArray, sqrt_cov: FloatArray) -> None:
    """Mean and sqrt_cov of moved points (n, 2n), which become deviations, with process noise pace*q.

    The mean is the first point and deviations from it, so that large offsets lose no digits. The covariance is summed
    and factorized, at half the cost of an orthogonal transformation; a pivot cannot be less than its own noise, for
    what has been taken from it is what others explain of the deviations alone.
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
        total = sqrt_cov[j, j] + own
        for k in range(j):
            total -= sqrt_cov[j, k] * sqrt_cov[j, k]
        pivot = math.sqrt(max(total, own))
        sqrt_cov[j, j] = pivot
        per = 1.0 / pivot
        for i in range(j + 1, n):
            total = sqrt_cov[i, j]
            for k in range(j):
                total -= sqrt_cov[i, k] * sqrt_cov[j, k]
            sqrt_cov[i, j] = total * per
            sqrt_cov[j, i] = 0.0


@inlined
def look(
    mean: FloatArray, sqrt_cov: FloatArray, i: int, reading: float, variance: float, gain: FloatArray
) -> tuple[float, float]:
    """Take in a `reading` of state i with noise `variance` > 0; (innovation squared over a, a). gain (n,) is scratch.

    Carlson (1973): as Potter's update, but L stays triangular. The rows of the factor are turned by 2 x 2 rotations
    whose cosines come from sums of squares alone; nothing is subtracted from a covariance.
    """
    n = mean.shape[0]
    for k in range(n):
        gain[k] = 0.0
    after = variance
    for j in range(i, -1, -1):
        part, before = sqrt_cov[i, j], after
        after = before + part * part
        per = 1.0 / math.sqrt(before * after)
        keep, lose = before * per, part * per
        for k in range(j, n):
            held = sqrt_cov[k, j]
            sqrt_cov[k, j] = keep * held - lose * gain[k]
            gain[k] += part * held
    innovation = reading - mean[i]
    share = innovation / after
    for k in range(n):
        mean[k] += gain[k] * share
    return innovation * share, after
