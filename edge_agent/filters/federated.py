"""The two operations of a federated filter: the master (main filter) shares its information with
the sub-filters, and fuses their results.
"""

from __future__ import annotations

import math

from edge_agent.filters.householder import triangularize
from schemas.numeric import FloatArray
from schemas.runtime.jit import compiled


@compiled
def share_information(sqrt_cov: FloatArray, beta: float, out: FloatArray) -> None:
    """Compute `out` (n, n), the square root of a sub-filter's covariance, if the sub-filter gets
    the share `beta` of the master's information, 0 < beta <= 1. `sqrt_cov` is the root of the
    master's covariance.
    """
    gain = 1.0 / math.sqrt(beta)
    for i in range(sqrt_cov.shape[0]):
        for j in range(sqrt_cov.shape[1]):
            out[i, j] = gain * sqrt_cov[i, j]


@compiled
def fuse_estimates(
    mean: FloatArray,
    sqrt_cov: FloatArray,
    other: FloatArray,
    other_root: FloatArray,
    work: FloatArray,
) -> None:
    """Fuse an independent estimate into another, in place. Each estimate is a mean (n,) and a
    square root of its covariance (n, n): `other` and `other_root` are fused into `mean` and
    `sqrt_cov`.

    `work` is scratch memory, (2n, 2n) or larger.
    """
    n = mean.shape[0]
    for i in range(n):
        for j in range(n):
            work[i, j] = sqrt_cov[i, j]
            work[i, n + j] = other_root[i, j]
            work[n + i, j] = sqrt_cov[i, j]
            work[n + i, n + j] = 0.0
    triangularize(work, 2 * n, 2 * n)
    for k in range(n):
        white = other[k] - mean[k]
        for j in range(k):
            white -= work[k, j] * work[j, 2 * n - 1]
        # The part right of the diagonal is zero now, so it can store the whitened difference.
        work[k, 2 * n - 1] = white / work[k, k]
    for i in range(n):
        for k in range(n):
            mean[i] += work[n + i, k] * work[k, 2 * n - 1]
        for j in range(n):
            sqrt_cov[i, j] = work[n + i, n + j] if j <= i else 0.0
