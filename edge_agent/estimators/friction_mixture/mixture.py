"""The mixture of node filters: re-injection, its overall moments, and nodes that have lost the motion.

Legend
    m_j, P_j, w_j   mean (n,), covariance (n, n) and probability of node j
    m, P            mean and covariance of the whole mixture
    zeta            share of a node's predicted mass that came from anywhere by a road change [1]

The state of a node after mixing is (1 - zeta)*N(m_j, P_j) + zeta*N(m, P), matched in its first two moments: an
improbable node keeps the state of the vehicle and is ready to explain the next sample (interacting multiple models,
Blom and Bar-Shalom 1988). Covariances are only ever added here.
"""

from __future__ import annotations

import numpy as np

from edge_agent.estimators.friction_mixture.arrays import clear, clear_rows, put, put_square
from edge_agent.estimators.friction_mixture.constants import C, X
from edge_agent.estimators.friction_mixture.nodes import SMALLEST
from schemas.numeric import FloatArray
from schemas.runtime.jit import compiled

LEAST_MIXING = 1e-3  # a smaller share of foreign mass changes no digit that is read
LEAST_WEIGHT = 1e-9  # nor does a node of less


@compiled
def reinject(
    mean: FloatArray, covariance: FloatArray, zeta: float, all_mean: FloatArray, all_covariance: FloatArray
) -> None:
    """Mix one node (mean (n,), covariance (n, n), changed in place) with the whole."""
    if zeta < LEAST_MIXING:
        return
    n = mean.shape[0]
    for i in range(n):
        apart = zeta * (1.0 - zeta) * (all_mean[i] - mean[i])
        for j in range(i + 1):
            covariance[i, j] += zeta * (all_covariance[i, j] - covariance[i, j]) + apart * (all_mean[j] - mean[j])
            covariance[j, i] = covariance[i, j]
    for i in range(n):
        mean[i] += zeta * (all_mean[i] - mean[i])


@compiled
def moments(
    mean: FloatArray, covariance: FloatArray, weight: FloatArray, all_mean: FloatArray, all_covariance: FloatArray
) -> None:
    """Mean (n,) and covariance (n, n) of the mixture of the first K nodes, weight (K,)."""
    count, n = weight.shape[0], mean.shape[1]
    clear(all_mean)
    clear_rows(all_covariance)
    for k in range(count):
        for i in range(n):
            all_mean[i] += weight[k] * mean[k, i]
    for k in range(count):
        if weight[k] < LEAST_WEIGHT:
            continue
        for i in range(n):
            apart = mean[k, i] - all_mean[i]
            for j in range(i + 1):
                all_covariance[i, j] += weight[k] * (covariance[k, i, j] + apart * (mean[k, j] - all_mean[j]))
    for i in range(n):
        for j in range(i):
            all_covariance[j, i] = all_covariance[i, j]


@compiled
def recall_lost(mean: FloatArray, root: FloatArray, weight: FloatArray, constants: FloatArray) -> None:
    """Give nodes (K, n) that have lost the motion the state of the most probable one, and no weight."""
    best = int(np.argmax(weight))
    for j in range(weight.shape[0]):
        astray = max(
            abs(mean[j, X.VX] - mean[best, X.VX]) / constants[C.LOST_X],
            abs(mean[j, X.VY] - mean[best, X.VY]) / constants[C.LOST_Y],
        )
        if astray > 1.0:
            put(mean[j], mean[best])
            put_square(root[j], root[best])
            weight[j] = SMALLEST
