"""The friction hypotheses (nodes) on a fixed grid, and the operations on their probabilities:
prior, change of the road, quantiles and evidence.

Legend
    mu          node values, equidistant in sqrt(mu)                                  (K,)
    width       share of the range [.05, 1.20] of mu that each node represents        (K,)
    prior       probability of each node without measurements                         (K,)
    w           probabilities of the nodes                                            (K,)
    density     w/width, the posterior over a uniform distribution, linear between nodes
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from schemas.mugrid import LOWER, UPPER
from schemas.numeric import FloatArray
from schemas.runtime.jit import compiled

SMALLEST = 1e-12  # [1] smallest probability of a node, above 0 so that it can grow again


def node_table(count: int) -> tuple[FloatArray, FloatArray]:
    """Return (mu, width), shape (K,) each, for K = `count` nodes (assumed friction values).

    The range of sqrt(mu) is divided into K equal cells. `mu` has the friction at the middle of each
    cell, `width` the share of the range of mu that the cell covers.
    """
    edges = np.linspace(math.sqrt(LOWER), math.sqrt(UPPER), count + 1)
    middle = 0.5 * (edges[:-1] + edges[1:])
    return middle**2, np.diff(edges**2) / (UPPER - LOWER)


def friction_prior(mu: FloatArray, width: FloatArray, common: float) -> FloatArray:
    """Return the probability (K,) of each node without measurements, for the `mu` and `width` of
    `node_table`.

    Up to the friction `common` all values are equally likely. Above it, the density falls linearly
    to 0 at the end of the friction range, because few tyres have so much grip. If `common` lies
    beyond this range, all values are equally likely.
    """
    fall = max(UPPER - common, SMALLEST)
    mass = width * np.clip((UPPER - mu) / fall, 0.0, 1.0)
    return np.asarray(mass / mass.sum())


class RoadChange(NamedTuple):
    """Probabilities that the friction changes within a step.

    Attributes:
        hazard: change from any node to a friction drawn from the prior.
        drift: approximate probability of a change to the node with the next lower or higher
            friction. Only nodes with one friction for both sides have such neighbours.
    """

    hazard: float
    drift: float


@compiled
def change_road(
    w: FloatArray,
    prior: FloatArray,
    chain: int,
    change: RoadChange,
    out: FloatArray,
) -> None:
    """Compute the probabilities `out` (K,) of K nodes after a possible road change; before it they
    were `w`.

    Every node loses the share `change.hazard`, which goes to all nodes in proportion to `prior`.
    The nodes are of two kinds:

    - The first `chain` nodes assume one friction for both sides of the car, in ascending order.
      They exchange probability with their neighbours (`change.drift`). The exchange does not change
      probabilities that equal the prior.
    - The other nodes assume a split road (different friction left and right), so they have no order
      and no neighbours.
    """
    hazard, drift = change
    count = w.shape[0]
    for j in range(count):
        out[j] = w[j]
    for j in range(chain - 1):
        least = min(prior[j], prior[j + 1])
        flow = 0.5 * drift * least * (w[j] / prior[j] - w[j + 1] / prior[j + 1])
        out[j] -= flow
        out[j + 1] += flow
    for j in range(count):
        out[j] = max((1.0 - hazard) * out[j] + hazard * prior[j], SMALLEST)


@compiled
def multiply_likelihood(w: FloatArray, log_likelihood: FloatArray) -> None:
    """Multiply the probabilities w (K,) by exp(log_likelihood) and normalise. The largest value of
    `log_likelihood` (K,) must be near 0, so that exp does not overflow.
    """
    total = 0.0
    for j in range(w.shape[0]):
        w[j] = max(w[j] * math.exp(log_likelihood[j]), SMALLEST)
        total += w[j]
    for j in range(w.shape[0]):
        w[j] /= total


@compiled
def quantile(mu: FloatArray, width: FloatArray, w: FloatArray, q: float) -> float:
    """Return the q-quantile of the friction, given probabilities w (K,) of the grid values mu (K,).
    The density between grid values is interpolated linearly; beyond the first and last value it is
    constant.
    """
    count = mu.shape[0]
    total = 0.0
    for j in range(count + 1):
        total += _segment_mass(mu, width, w, j)
    target = q * total
    for j in range(count + 1):
        mass = _segment_mass(mu, width, w, j)
        if target <= mass or j == count:
            left = LOWER if j == 0 else mu[j - 1]
            right = UPPER if j == count else mu[j]
            first = w[0] / width[0] if j == 0 else w[j - 1] / width[j - 1]
            last = w[count - 1] / width[count - 1] if j == count else w[j] / width[j]
            slope = (last - first) / (right - left)
            root = math.sqrt(max(first * first + 2.0 * slope * target, 0.0))
            return float(min(left + 2.0 * target / max(first + root, SMALLEST), right))
        target -= mass
    return UPPER


@compiled
def probability_below(mu: FloatArray, width: FloatArray, w: FloatArray, limit: float) -> float:
    """Return the probability that the friction is below `limit`, given probabilities w (K,) of the
    grid values mu (K,). The density between grid values is interpolated linearly.
    """
    count = mu.shape[0]
    below = 0.0
    total = 0.0
    for j in range(count + 1):
        mass = _segment_mass(mu, width, w, j)
        total += mass
        if 0 < j < count and mu[j - 1] <= limit < mu[j]:
            share = (limit - mu[j - 1]) / (mu[j] - mu[j - 1])
            first = w[j - 1] / width[j - 1]
            at_limit = first + share * (w[j] / width[j] - first)
            below += 0.5 * (limit - mu[j - 1]) * (first + at_limit)
        elif j < count and mu[j] <= limit:
            below += mass
    return below / total


@compiled
def _segment_mass(mu: FloatArray, width: FloatArray, w: FloatArray, j: int) -> float:
    """Return the unnormalised probability mass between nodes j - 1 and j. Nodes are the grid values
    `mu` of friction; `width` is the share of the range that each represents, and `w` its
    probability. For j = 0, and for j equal to the number of nodes, the segment extends from the
    outer node to the end of the friction range.
    """
    count = mu.shape[0]
    if j == 0:
        return float((mu[0] - LOWER) * w[0] / width[0])
    if j == count:
        return float((UPPER - mu[count - 1]) * w[count - 1] / width[count - 1])
    return float(0.5 * (mu[j] - mu[j - 1]) * (w[j - 1] / width[j - 1] + w[j] / width[j]))


@compiled
def visit_evidence(
    mu: FloatArray, prior: FloatArray, w: FloatArray, centres: FloatArray, out: FloatArray
) -> None:
    """Compute the evidence on friction of a visit (passage of a map cell), out = log(w/prior), at
    the centres (32,) of the friction bins. It is interpolated between nodes (grid values of
    friction) and shifted to maximum 0.
    """
    count = mu.shape[0]
    top = -math.inf
    j = 0
    for i in range(centres.shape[0]):
        while j < count - 1 and mu[j + 1] < centres[i]:
            j += 1
        k = min(j + 1, count - 1)
        first = math.log(w[j] / prior[j])
        last = math.log(w[k] / prior[k])
        share = 0.0 if k == j else min(max((centres[i] - mu[j]) / (mu[k] - mu[j]), 0.0), 1.0)
        out[i] = (1.0 - share) * first + share * last
        top = max(top, out[i])
    for i in range(centres.shape[0]):
        out[i] -= top
