"""Square-root prediction and update of a sigma-point filter by orthogonal transformations, for use
inside larger compiled functions.

Legend
    x, m        state, its mean                                            (n,)
    L           sqrt_cov, lower triangular, covariance P = L*L'             (n, n)
    X           weighted centred deviations of state points                 (n, points)
    Z           weighted centred deviations of measurement points           (k, points)
    nu          innovation, measured minus predicted; NaN if missing         (k,)
    r           standard deviations of the measurement noise, independent    (k,)
    S           innovation covariance Z*Z' + diag(r^2)                       (k, k)

All operations are orthogonal (Householder) transformations of an array of factors. No covariance is
ever subtracted, so variances cannot become negative. The functions write into arrays of the caller
and allocate nothing.
"""

from __future__ import annotations

import math
from typing import NamedTuple

from edge_agent.filters.points import centred_deviations, weighted_mean
from schemas.numeric import FloatArray
from schemas.runtime.jit import compiled

LOG_TWO_PI = math.log(2.0 * math.pi)


@compiled
def triangularize(a: FloatArray, rows: int, columns: int) -> None:
    """Replace a[:rows, :columns] in place by its lower-triangular factor L with L*L' = a*a' and no
    negative element on the diagonal.

    The method is Householder reflections from the right; entries right of the diagonal become zero.
    Requires columns >= rows.
    """
    for i in range(rows):
        square = 0.0
        for j in range(i + 1, columns):
            square += a[i, j] * a[i, j]
        if square > 0.0:
            head = a[i, i]
            norm = math.sqrt(head * head + square)
            pivot = head - norm if head <= 0.0 else -square / (head + norm)
            gain = 2.0 / (square + pivot * pivot)
            for k in range(i + 1, rows):
                dot = a[k, i] * pivot
                for j in range(i + 1, columns):
                    dot += a[k, j] * a[i, j]
                dot *= gain
                a[k, i] -= dot * pivot
                for j in range(i + 1, columns):
                    a[k, j] -= dot * a[i, j]
            a[i, i] = norm
            for j in range(i + 1, columns):
                a[i, j] = 0.0
        elif a[i, i] < 0.0:
            for k in range(i, rows):
                a[k, i] = -a[k, i]


@compiled
def predict(
    points: FloatArray,
    weights: tuple[FloatArray, FloatArray],
    sqrt_noise: FloatArray,
    mean: FloatArray,
    sqrt_cov: FloatArray,
    work: FloatArray,
) -> None:
    """Compute mean (n,) and root of the covariance, sqrt_cov (n, n), of propagated points (points,
    n). Process noise with the covariance root `sqrt_noise` (n, n) is added.

    `weights` are two arrays (points,): weights of the points for the mean, and for the covariance.
    `work` is scratch memory, (n, points + n) or larger.
    """
    count, n = points.shape
    w_mean, w_cov = weights
    weighted_mean(points, w_mean, mean)
    centred_deviations(points, mean, w_cov, work, 0)
    for i in range(n):
        for j in range(n):
            work[i, count + j] = sqrt_noise[i, j]
    triangularize(work, n, count + n)
    for i in range(n):
        for j in range(n):
            sqrt_cov[i, j] = work[i, j] if j <= i else 0.0


class Measurement(NamedTuple):
    """Measurement of k quantities: deviations Z (k, points) of the predicted readings, innovation
    nu (k,), and standard deviations r (k,) of the noise.
    """

    deviations: FloatArray
    innovation: FloatArray
    noise_std: FloatArray


@compiled
def update(
    mean: FloatArray,
    sqrt_cov: FloatArray,
    state_deviations: FloatArray,
    measurement: Measurement,
    work: FloatArray,
) -> tuple[int, float, float]:
    """Run the measurement update of a square-root filter in place; measurements whose innovation
    (measured minus predicted) is NaN are skipped.

    Args:
        mean: mean m (n,) of the state, changed.
        sqrt_cov: root L (n, n) of the state's covariance, changed.
        state_deviations: deviations X (n, points) of the sigma points from the mean.
        measurement: deviations Z of the predicted readings, innovation nu, and noise r.
        work: scratch memory (k + n, points + k) or larger.

    Returns:
        number of measurements used, log-likelihood of the innovation [nat], and nu' S^-1 nu
        (normalised squared innovation).

    The array [[Z, diag(r)], [X, 0]] becomes [[S^1/2, 0], [P_xz*S^-T/2, L_new]].
    """
    n, points = state_deviations.shape
    used = _stack_factors(state_deviations, measurement, work)
    if used == 0:
        return 0, 0.0, 0.0
    triangularize(work, used + n, points + used)
    log_likelihood, square = _apply_innovation(
        mean, measurement.innovation, used, work, points + used - 1
    )
    for i in range(n):
        for j in range(n):
            sqrt_cov[i, j] = work[used + i, used + j] if j <= i else 0.0
    return used, log_likelihood, square


@compiled
def _stack_factors(state_deviations: FloatArray, measurement: Measurement, work: FloatArray) -> int:
    """Write the array [[Z, diag(r)], [X, 0]] of the measurements that are not missing to `work`.
    Return their number.
    """
    n, points = state_deviations.shape
    deviations, innovation, noise_std = measurement
    used = 0
    for k in range(innovation.shape[0]):
        if not math.isnan(innovation[k]):
            used += 1
    row = 0
    for k in range(innovation.shape[0]):
        if math.isnan(innovation[k]):
            continue
        for p in range(points):
            work[row, p] = deviations[k, p]
        for j in range(used):
            work[row, points + j] = 0.0
        work[row, points + row] = noise_std[k]
        row += 1
    for i in range(n):
        for p in range(points):
            work[used + i, p] = state_deviations[i, p]
        for j in range(used):
            work[used + i, points + j] = 0.0
    return used


@compiled
def _apply_innovation(
    mean: FloatArray, innovation: FloatArray, used: int, work: FloatArray, spare: int
) -> tuple[float, float]:
    """Add the gain times the innovation (k,) to the mean (n,). `work` contains the array
    [[S^1/2, 0], [P_xz*S^-T/2, L_new]] for the `used` measurements that are not missing.

    Column `spare` of `work` lies right of the diagonal, so it is zero, and the function stores the
    whitened innovation there. Return the log-likelihood [nat] and nu' S^-1 nu.
    """
    log_likelihood = -0.5 * used * LOG_TWO_PI
    square = 0.0
    row = 0
    for k in range(innovation.shape[0]):
        if math.isnan(innovation[k]):
            continue
        white = innovation[k]
        for j in range(row):
            white -= work[row, j] * work[j, spare]
        white /= work[row, row]
        log_likelihood -= math.log(work[row, row])
        square += white * white
        work[row, spare] = white
        for i in range(mean.shape[0]):
            mean[i] += work[used + i, row] * white
        row += 1
    return log_likelihood - 0.5 * square, square
