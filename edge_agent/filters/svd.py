"""A square root of a covariance by singular values, and its points (papers 000 and 001, equations 21 and 22).

Legend: L sqrt_cov, lower triangular (n, n); L = A*S*V' gives P = A*S^2*A', so A*S is another square root of P. Its
points lie on the axes of the covariance's ellipsoid.
"""

from __future__ import annotations

import numpy as np

from schemas.numeric import FloatArray
from schemas.runtime.jit import compiled


@compiled
def axis_points(mean: FloatArray, sqrt_cov: FloatArray, xi: FloatArray, points: FloatArray) -> None:
    """points[p] = mean + A*S*xi[p]; mean (n,), sqrt_cov (n, n) finite, xi and points (points, n)."""
    axes, size, _ = np.linalg.svd(sqrt_cov)
    count, n = xi.shape
    for p in range(count):
        for i in range(n):
            total = mean[i]
            for j in range(n):
                total += axes[i, j] * size[j] * xi[p, j]
            points[p, i] = total
