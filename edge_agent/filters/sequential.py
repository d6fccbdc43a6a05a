"""Measurement updates of a square-root filter with one scalar measurement after the other.

Legend
    m, L     state's mean (n,), and square root of its covariance, P = L*L' (n, n)
    f        deviation of the measurement in the axes of L's columns (n,); h = L*f is its covariance
             with x
    r, a     variance of the noise, and of the innovation, a = f'*f + r
    nu       innovation, measured minus predicted

No variance is ever subtracted from another, so variances cannot become negative. Rows with
independent noise may be applied in any order. An update changes L, and with it the deviations f of
the rows that remain; `apply_projection` updates these deviations.
"""

from __future__ import annotations

import math

from schemas.numeric import FloatArray
from schemas.runtime.jit import inlined


@inlined
def potter_factors(f: FloatArray, noise: float) -> tuple[float, float]:
    """Return (a, g) for a scalar measurement with noise variance `noise` > 0, of which f (k,) is
    the measurement row times the covariance root L. a is the variance of the innovation nu
    (measurement minus prediction), g the factor of the covariance update. The update is then m <- m
    + L*f*nu/a and L <- L*(I - g*f*f') (Potter 1963).
    """
    a = noise
    for c in range(f.shape[0]):
        a += f[c] ** 2
    share = 1.0 / a
    return a, share / (1.0 + math.sqrt(noise * share))


@inlined
def apply_projection(
    mean: FloatArray, root: FloatArray, f: FloatArray, step: float, gain: float
) -> None:
    """Apply the update of one scalar measurement to the mean and to the covariance root L (n, k or
    more): mean (n,) += L*f*step and L <- L*(I - gain*f*f'), with f (k,), the measurement row times
    L. Columns of L beyond k are unchanged.
    """
    for i in range(mean.shape[0]):
        along = 0.0
        for c in range(f.shape[0]):
            along += root[i, c] * f[c]
        mean[i] += along * step
        along *= gain
        for c in range(f.shape[0]):
            root[i, c] -= along * f[c]


@inlined
def carlson_update(
    mean: FloatArray,
    sqrt_cov: FloatArray,
    i: int,
    reading: float,
    variance: float,
    gain: FloatArray,
) -> tuple[float, float]:
    """Update the filter with a `reading` of state i itself with noise `variance` > 0.

    Return (squared innovation divided by a, a), where a is the variance of the innovation
    (measurement minus prediction). L stays triangular (Carlson 1973): its rows are rotated by 2 x 2
    rotations whose cosines come from sums of squares only. gain (n,) is scratch memory.
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
