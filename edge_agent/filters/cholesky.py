"""Cholesky factor of a covariance.

Legend: P covariance, L its lower-triangular factor with P = L*L' (Cholesky), both (n, n). A pivot
(squared diagonal element of L) is the variance of a state given the states before it. With process
noise added to P, a pivot is at least the variance of the state's own noise. If rounding makes the
pivot smaller, the noise variance replaces it.
"""

from __future__ import annotations

import math

from schemas.numeric import FloatArray
from schemas.runtime.jit import compiled, inlined


@inlined
def factorize_column(a: FloatArray, j: int, least: float) -> None:
    """Compute column j of the Cholesky factor of the matrix `a` (n, n) in place; the columns before
    it must be complete. A pivot (a diagonal element before its root is taken) is raised to `least`
    > 0 if it is smaller.

    Only the lower half is read; entries right of the diagonal become zero.
    """
    total = a[j, j]
    for k in range(j):
        total -= a[j, k] * a[j, k]
    pivot = math.sqrt(max(total, least))
    a[j, j] = pivot
    per = 1.0 / pivot
    for i in range(j + 1, a.shape[0]):
        total = a[i, j]
        for k in range(j):
            total -= a[i, k] * a[j, k]
        a[i, j] = total * per
        a[j, i] = 0.0


@compiled
def variance(sqrt_cov: FloatArray, i: int) -> float:
    """Return the variance of state i: its diagonal element in the covariance whose lower-triangular
    factor is `sqrt_cov` (n, n).
    """
    total = 0.0
    for j in range(i + 1):
        total += sqrt_cov[i, j] * sqrt_cov[i, j]
    return total
