"""Measurement update of a square-root filter with a scalar measurement of one state.

Legend
    m, L     state's mean (n,), and square root of its covariance, P = L*L' (n, n)
    a        variance of the innovation (measurement minus prediction)

No variance is ever subtracted from another, so variances cannot become negative.
"""

from __future__ import annotations

import math

from schemas.numeric import FloatArray
from schemas.runtime.jit import inlined


@inlined
def carlson_update(
    mean: FloatArray,
    sqrt_cov: FloatArray,
    i: int,
    reading: float,
    variance: float,
    gain: FloatArray,
) -> tuple[float, float]:
    """Update the filter in place with a `reading`: a direct measurement of state i whose noise has
    the `variance` > 0.

    Return (squared innovation divided by a, a), where a is the variance of the innovation. L stays
    triangular (Carlson 1973): its rows are rotated by 2 x 2 rotations whose cosines come from sums
    of squares only. gain (n,) is scratch memory.
    """
    n = mean.shape[0]
    for k in range(n):
        gain[k] = 0.0
    after = variance
    for j in range(i, -1, -1):
        part = sqrt_cov[i, j]
        before = after
        after = before + part * part
        per = 1.0 / math.sqrt(before * after)
        keep = before * per
        lose = part * per
        for k in range(j, n):
            old = sqrt_cov[k, j]
            sqrt_cov[k, j] = keep * old - lose * gain[k]
            gain[k] += part * old
    innovation = reading - mean[i]
    share = innovation / after
    for k in range(n):
        mean[k] += gain[k] * share
    return innovation * share, after
