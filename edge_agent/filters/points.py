"""Conversion between a mean with a square root of the covariance and the points of a sigma rule, in
both directions.

Legend
    m, L        mean (n,) and sqrt_cov, lower triangular, covariance P = L*L'            (n, n)
    xi          points of the rule for a standard normal variable                       (points, n)
    A, S        axes and sizes of the covariance's ellipsoid: L = A*S*V' by singular values gives P
                = A*S^2*A', so A*S is another square root of P (papers 000 and 001, equations 21 and
                22)
"""

from __future__ import annotations

import math

import numpy as np

from schemas.numeric import FloatArray
from schemas.runtime.jit import compiled


@compiled
def sigma_points(
    mean: FloatArray, sqrt_cov: FloatArray, xi: FloatArray, points: FloatArray
) -> None:
    """Compute the points of a sigma rule with offsets `xi`: points[j] = mean + sqrt_cov @ xi[j].
    Shapes: mean (n,), sqrt_cov (n, n), xi and points (points, n).
    """
    count, n = xi.shape
    for p in range(count):
        for i in range(n):
            total = mean[i]
            for j in range(i + 1):
                total += sqrt_cov[i, j] * xi[p, j]
            points[p, i] = total


@compiled
def axis_points(mean: FloatArray, sqrt_cov: FloatArray, xi: FloatArray, points: FloatArray) -> None:
    """Compute the points of a rule with offsets `xi`: points[p] = mean + A·S·xi[p]. A (singular
    vectors) and S (singular values) come from the decomposition A·S·Vᵀ of `sqrt_cov`, a square root
    of the covariance.

    Shapes: mean (n,), sqrt_cov (n, n), finite; xi and points (points, n).
    """
    axes, size, _ = np.linalg.svd(sqrt_cov)
    count, n = xi.shape
    for p in range(count):
        for i in range(n):
            total = mean[i]
            for j in range(n):
                total += axes[i, j] * size[j] * xi[p, j]
            points[p, i] = total


@compiled
def weighted_mean(points: FloatArray, w_mean: FloatArray, mean: FloatArray) -> None:
    """Compute the mean (n,) of points (points, n): the sum of w_mean[j]*points[j].

    It is computed as the first point plus weighted deviations, so that large offsets lose no
    digits.
    """
    count, n = points.shape
    for i in range(n):
        total = 0.0
        for p in range(count):
            total += w_mean[p] * (points[p, i] - points[0, i])
        mean[i] = points[0, i] + total


@compiled
def centred_deviations(
    points: FloatArray, mean: FloatArray, w_cov: FloatArray, out: FloatArray, row: int
) -> None:
    """Write the weighted deviations of points (points, n) from their mean (n,) into `out`: out[row
    + i, j] = sqrt(w_cov[j])*(points[j, i] - mean[i]).

    These deviations are a factor of the covariance: their product with their transpose is the
    covariance.
    """
    count, n = points.shape
    for p in range(count):
        root = math.sqrt(w_cov[p])
        for i in range(n):
            out[row + i, p] = root * (points[p, i] - mean[i])
