"""The mixture of node filters: re-injection, update, prediction, and its overall moments.

Legend
    m_j, L_j, w_j   mean (n,), sqrt_cov (n, n) and probability of node j
    m, L            mean and sqrt_cov of the whole mixture
    zeta            share of a node's predicted mass that came from anywhere by a road change [1]

The state of a node after mixing is (1 - zeta)*N(m_j, P_j) + zeta*N(m, P), matched in its first two moments: an
improbable node keeps the state of the vehicle and is ready to explain the next sample (interacting multiple models,
Blom and Bar-Shalom 1988). Every covariance is a sum of factors, made triangular.
"""

from __future__ import annotations

import math

import numpy as np

from edge_agent.estimators.friction_mixture.block import F
from edge_agent.estimators.friction_mixture.constants import C, X
from edge_agent.estimators.friction_mixture.nodes import SMALLEST
from edge_agent.estimators.friction_mixture.residuals import ROWS, gained, residuals, slips_at_force
from edge_agent.filters.squareroot import deviations, sigma_points, triangularize, update
from schemas.numeric import FloatArray, compiled

LEAST_MIXING = 1e-3  # a smaller share of foreign mass changes no digit that is read


@compiled
def reinject(
    mean: FloatArray, root: FloatArray, zeta: float, all_mean: FloatArray, all_root: FloatArray, work: FloatArray
) -> None:
    """Mix one node (mean (n,), root (n, n), changed in place) with the whole; work is (n, 2n + 1) or larger."""
    if zeta < LEAST_MIXING:
        return
    n = mean.shape[0]
    own, foreign, spread = math.sqrt(1.0 - zeta), math.sqrt(zeta), math.sqrt(zeta * (1.0 - zeta))
    for i in range(n):
        difference = all_mean[i] - mean[i]
        for j in range(n):
            work[i, j] = own * root[i, j]
            work[i, n + j] = foreign * all_root[i, j]
        work[i, 2 * n] = spread * difference
        mean[i] += zeta * difference
    triangularize(work, n, 2 * n + 1)
    for i in range(n):
        for j in range(n):
            root[i, j] = work[i, j] if j <= i else 0.0


@compiled
def moments(
    mean: FloatArray, root: FloatArray, weight: FloatArray, all_mean: FloatArray, all_root: FloatArray, work: FloatArray
) -> None:
    """Mean and sqrt_cov of the mixture of K nodes; work is (n, n + K*(n + 1)) or larger."""
    count, n = mean.shape
    for i in range(n):
        total = 0.0
        for k in range(count):
            total += weight[k] * mean[k, i]
        all_mean[i] = total
    column = 0
    for k in range(count):
        share = math.sqrt(weight[k])
        for i in range(n):
            for j in range(n):
                work[i, column + j] = share * root[k, i, j]
            work[i, column + n] = share * (mean[k, i] - all_mean[i])
        column += n + 1
    triangularize(work, n, column)
    for i in range(n):
        for j in range(n):
            all_root[i, j] = work[i, j] if j <= i else 0.0


@compiled
def update_node(
    row: FloatArray,
    constants: FloatArray,
    mu: float,
    mean: FloatArray,
    root: FloatArray,
    features: FloatArray,
    inflation: float,
    xi: FloatArray,
    w_cov: FloatArray,
    scratch: FloatArray,
    slopes: FloatArray,
    points: FloatArray,
    outcomes: FloatArray,
    innovation: FloatArray,
    theoretical: FloatArray,
    noise: FloatArray,
    work: FloatArray,
) -> tuple[float, float, float, int]:
    """Cubature update of one node with R times `inflation`.

    Writes innovation (6,) and its theoretical variance without the inflation (6,).
    Returns the log-likelihood with the inflated R, the one with the plain R (rows taken as independent), the normalised
    innovation squared with the plain R, and the number of rows.
    """
    count, n = xi.shape
    slips_at_force(mu, constants[C.SHAPE], mean[X.LEAK_Y], features, scratch)
    sigma_points(mean, root, xi, points)
    for p in range(count):
        residuals(row, constants, mu, points[p], mean, features, scratch, outcomes[p], slopes)
    residuals(row, constants, mu, mean, mean, features, scratch, noise, slopes)
    plain = square = 0.0
    for r in range(ROWS):
        average = 0.0
        for p in range(count):
            average += outcomes[p, r] / count
        variance = 0.0
        for p in range(count):
            centred = outcomes[p, r] - average
            outcomes[p, r] = math.sqrt(w_cov[p]) * centred
            variance += outcomes[p, r] ** 2
        innovation[r] = -average
        own = features[F.NOISE + r]
        theoretical[r] = variance + own * own
        excess = average * average / constants[C.HUBER] ** 2 - variance
        noise[r] = math.sqrt(max(own * own * inflation, excess))
        if not math.isnan(average):
            ratio = average * average / theoretical[r]
            square += ratio
            plain -= 0.5 * (ratio + math.log(2.0 * math.pi * theoretical[r]))
    deviations(points, mean, w_cov, scratch_states(work, n, count), 0)
    used, _, whitened = update(mean, root, scratch_states(work, n, count), outcomes.T, innovation, noise, work[n:])
    keep_within(mean, constants)
    occam = 0.0
    line = n
    for r in range(ROWS):
        if math.isnan(innovation[r]):
            continue
        if r < 4:
            occam -= constants[C.SLIDING_PRICE] / inflation * min(math.log(slopes[r] / constants[C.FLAT]), 0.0)
        else:
            occam += constants[C.AXLE_PRICE] * math.log(work[line, line - n])
        line += 1
    return -0.5 * whitened - occam, plain, square, used


@compiled
def keep_within(mean: FloatArray, constants: FloatArray) -> None:
    """Keep stiffness, leaks and offsets of a node (n,) within what a vehicle can have."""
    far = constants[C.FARTHEST]
    for i in range(X.LN_KX, mean.shape[0]):
        middle, spread = prior_of(i, constants)
        mean[i] = min(max(mean[i], middle - far * spread), middle + far * spread)


@compiled
def recall_lost(mean: FloatArray, root: FloatArray, weight: FloatArray, constants: FloatArray) -> None:
    """Give nodes (K, n) that have lost the motion the state of the most probable one, and no weight."""
    best = int(np.argmax(weight))
    for j in range(mean.shape[0]):
        astray = max(
            abs(mean[j, X.VX] - mean[best, X.VX]) / constants[C.LOST_X],
            abs(mean[j, X.VY] - mean[best, X.VY]) / constants[C.LOST_Y],
        )
        if astray > 1.0:
            mean[j] = mean[best]
            root[j] = root[best]
            weight[j] = SMALLEST


@compiled
def prior_of(state: int, constants: FloatArray) -> tuple[float, float]:
    """Prior (mean, std) of a state that is a property of vehicle or sensor."""
    if state == X.LEAK_Y:
        return constants[C.LEAK_Y_MEAN], constants[C.LEAK_Y_STD]
    if state == X.LEAK_X:
        return constants[C.LEAK_X_MEAN], constants[C.LEAK_X_STD]
    if state == X.BIAS_X or state == X.BIAS_Y:
        return 0.0, constants[C.BIAS_STD]
    return 0.0, constants[C.STEER_STD] if state == X.STEER else constants[C.STIFFNESS_STD]


@compiled
def scratch_states(work: FloatArray, n: int, count: int) -> FloatArray:
    """A view (n, count) at the top of work."""
    return work[:n, :count]


@compiled
def predict_node(
    mean: FloatArray,
    root: FloatArray,
    constants: FloatArray,
    turn_cos: float,
    turn_sin: float,
    gain: FloatArray,
    noise: FloatArray,
    duration: float,
    work: FloatArray,
) -> None:
    """Advance one node over a block: exact rotation, gained velocity gains (8,) of memory.G, process noise (n,) stds.

    The map is affine, and the cubature of an affine map is the map itself: root <- triangle of [F*root, diag(noise)].
    Stiffness factors and the leak return to their priors, so that they stay within them when nothing is learned.
    """
    n = mean.shape[0]
    keep_k = math.exp(-duration / constants[C.STIFFNESS_TIME])
    keep_l = math.exp(-duration / constants[C.LEAK_TIME])
    keep_b = math.exp(-duration / constants[C.BIAS_TIME])
    vx, vy = mean[X.VX], mean[X.VY]
    mean[X.VX] = turn_cos * vx + turn_sin * vy + gained(gain, 0, mean, 0)
    mean[X.VY] = turn_cos * vy - turn_sin * vx + gained(gain, 0, mean, 1)
    mean[X.LN_KX] *= keep_k
    mean[X.LN_KY] *= keep_k
    mean[X.STEER] *= keep_k
    mean[X.LEAK_Y] = constants[C.LEAK_Y_MEAN] + keep_l * (mean[X.LEAK_Y] - constants[C.LEAK_Y_MEAN])
    mean[X.LEAK_X] = constants[C.LEAK_X_MEAN] + keep_l * (mean[X.LEAK_X] - constants[C.LEAK_X_MEAN])
    mean[X.BIAS_X] *= keep_b
    mean[X.BIAS_Y] *= keep_b
    for j in range(n):
        a, b = root[X.VX, j], root[X.VY, j]
        column = root[:, j]
        work[X.VX, j] = turn_cos * a + turn_sin * b + gained(gain, 0, column, 0) - gain[0]
        work[X.VY, j] = turn_cos * b - turn_sin * a + gained(gain, 0, column, 1) - gain[1]
        work[X.LN_KX, j] = keep_k * root[X.LN_KX, j]
        work[X.LN_KY, j] = keep_k * root[X.LN_KY, j]
        work[X.STEER, j] = keep_k * root[X.STEER, j]
        work[X.LEAK_Y, j] = keep_l * root[X.LEAK_Y, j]
        work[X.LEAK_X, j] = keep_l * root[X.LEAK_X, j]
        work[X.BIAS_X, j] = keep_b * root[X.BIAS_X, j]
        work[X.BIAS_Y, j] = keep_b * root[X.BIAS_Y, j]
    for i in range(n):
        for j in range(n):
            work[i, n + j] = noise[i] if i == j else 0.0
    triangularize(work, n, 2 * n)
    for i in range(n):
        for j in range(n):
            root[i, j] = work[i, j] if j <= i else 0.0
