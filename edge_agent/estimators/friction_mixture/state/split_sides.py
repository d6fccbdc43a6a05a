"""Split roads: a low friction under one side of the vehicle, left or right, and a high friction
under the other.

The friction of each side is divided into cells of a coarse grid. A node (friction hypothesis)
represents a triangular density of friction. It has its maximum at the middle of its cell and
extends to the middles of the neighbouring cells. Therefore a friction between two middles is
covered by both nodes.
"""

from __future__ import annotations

import math
from itertools import pairwise
from typing import Annotated, NamedTuple

import numpy as np

from edge_agent.estimators.friction_mixture.state.constants import (
    ALL_NODES,
    GROUPS,
    NODES,
    PLACES,
    SPLIT_NODES,
)
from schemas.mugrid import LOWER, UPPER
from schemas.numeric import FloatArray
from schemas.runtime.jit import compiled
from schemas.runtime.records import LANES, LaneArray

LOW = (0.05, 0.11, 0.17, 0.25, 0.36, 0.50, 0.66)  # [1] cell edges of the side with less friction
# [1] cell edges of the side with more friction. They are coarse, because often only a lower limit
# of this friction is known.
HIGH = (0.36, 0.55, 0.80, 1.20)
LEFT, RIGHT, BOTH = range(3)  # first index of `Sides.share`; BOTH is the mean of the two sides


class Sides(NamedTuple):
    """Friction under the left and right wheels that each node (hypothesis) assumes. First come the
    nodes with one friction for both sides, then the split nodes with a different friction on each
    side.
    """

    mu: Annotated[FloatArray, ALL_NODES, 2]  # left, right
    lanes: Annotated[LaneArray, GROUPS, 2]  # `mu` in the layout of groups and lanes
    prior: Annotated[FloatArray, ALL_NODES]
    # Distribution of a split node's friction (LEFT, RIGHT, BOTH) over the nodes of one friction
    share: Annotated[FloatArray, 3, SPLIT_NODES, NODES]


class Triangle(NamedTuple):
    """Triangular probability density of friction: it rises from the left end to the middle and
    falls to the right end.
    """

    left: float
    middle: float
    right: float
    low: float  # borders of its cell
    high: float


def triangular_cells(edges: tuple[float, ...]) -> list[Triangle]:
    """Return one triangular density per cell (range of friction), with its maximum at the middle of
    the cell. `edges` are the borders of the cells.

    Each triangle extends to the middles of the neighbouring cells; the first and last extend to the
    outer edges.
    """
    middles = [0.5 * (a + b) for a, b in pairwise(edges)]
    lefts = [edges[0], *middles[:-1]]
    rights = [*middles[1:], edges[-1]]
    return [
        Triangle(*row) for row in zip(lefts, middles, rights, edges[:-1], edges[1:], strict=True)
    ]


def side_table(mu: FloatArray, prior: FloatArray, split_prior: float) -> Sides:
    """Return the table of all nodes: friction under both sides of the car, and prior probability.
    The K nodes with one friction for both sides come first, then SPLIT_NODES split nodes.

    A split node assumes a low friction under the wheels of one side and a high friction under those
    of the other side. `mu` and `prior` (K,) are friction and prior probability of the K nodes. In
    the result, the split nodes together have the prior probability `split_prior`, and the K nodes
    the rest.
    """
    edges = np.linspace(math.sqrt(LOWER), math.sqrt(UPPER), len(mu) + 1) ** 2
    pairs = []
    mass = []
    share = []
    for low, high in (
        (a, b) for a in triangular_cells(LOW) for b in triangular_cells(HIGH) if b.low >= a.high
    ):
        mean = Triangle._make(0.5 * (a + b) for a, b in zip(low, high, strict=True))
        for left, right in ((low, high), (high, low)):
            pairs.append((left.middle, right.middle))
            mass.append((low.high - low.low) * (high.high - high.low))
            share.append([_in_cells(edges, one) for one in (left, right, mean)])
    side_mu = np.vstack([np.column_stack([mu, mu]), pairs])
    spare = np.ones((PLACES - ALL_NODES, 2))
    return Sides(
        side_mu,
        LaneArray(np.vstack([side_mu, spare]).reshape(GROUPS, LANES, 2).swapaxes(1, 2)),
        np.concatenate([(1.0 - split_prior) * prior, split_prior * np.array(mass) / sum(mass)]),
        np.ascontiguousarray(np.array(share).transpose(1, 0, 2)),
    )


def _in_cells(edges: FloatArray, triangle: Triangle) -> FloatArray:
    """Return the probability of each cell under a triangular density, (cells,); `edges` (cells +
    1,) are the borders of the cells.
    """
    left, middle, right, *_ = triangle
    rising = np.clip(edges - left, 0.0, middle - left)
    falling = np.clip(right - edges, 0.0, right - middle)
    whole = right - left
    below = rising**2 / (middle - left) / whole
    above = falling**2 / (right - middle) / whole
    return np.diff(np.where(edges < middle, below, 1.0 - above))


@compiled
def project_weights(w: FloatArray, share: FloatArray, out: FloatArray) -> None:
    """Compute `out` (K,), the probabilities of K friction values of the road, from the
    probabilities `w` of all nodes.

    The first K nodes assume one friction for the whole car, and `out` starts with their
    probabilities. The other nodes are split nodes, which assume different friction left and right.
    `share` (SPLIT_NODES, K) distributes the probability of each split node over the K values.
    """
    chain = out.shape[0]
    for j in range(chain):
        out[j] = w[j]
    for k in range(share.shape[0]):
        for j in range(chain):
            out[j] += w[chain + k] * share[k, j]
