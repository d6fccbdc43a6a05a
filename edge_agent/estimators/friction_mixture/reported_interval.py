"""The interval that is told of a friction: the truth lies below it, and above it, about as often as
it says.

Evidence is tempered, lest the same error count twice; so where much has been measured the belief is
wider than its errors, and where nothing has been it is the prior, as wide as it should be. The
level of the upper end goes from the one to the other by what has been learned, the divergence of
the belief from its prior (Kullback and Leibler 1951), and further in a car that is as its file says
(`trust.likeness`). Slippery for sure is said of nothing less than the belief itself holds by its
own 99 %.
"""

from __future__ import annotations

import math

from edge_agent.estimators.friction_mixture.constants import PATCH_NODES
from edge_agent.estimators.friction_mixture.design import MixtureDesign
from edge_agent.estimators.friction_mixture.friction_grid import quantile
from edge_agent.estimators.friction_mixture.memory import Quantiles
from schemas.numeric import FloatArray
from schemas.runtime.jit import compiled
from schemas.thresholds import SLIPPERY_MU

# safe deceleration rests on it: with .04 it lay above the truth for a sixth of the ice in town
LOWER_END = 0.03
# of the belief where nothing is known; where much is, one truth in thirty lay above in town,
UPPER_END = 0.95
LEARNED_END = 0.86  # and one in eighty on level drives
LEARNED = 0.05  # [nat] divergence at which most of it is
# [1] most by which the upper end comes nearer: a belief that leans to ice has a long upper tail
DRAWN_IN = 0.085
# How much nearer it comes in a car that is as its file says, by level and at the most: what else is
# wrong of it is small as well. On level drives one truth in eighty had lain above. The lower end
# stays: safe deceleration rests on it.
NEARER = 0.15
DRAWN_NEARER = 0.15
# Ice ends without a sign: of what .95 called slippery for sure in towns .08 lay beyond it
SURE_END = 0.99


@compiled
def find_interval(
    design: MixtureDesign,
    weight: FloatArray,
    patch: FloatArray,
    blended: FloatArray,
    likeness: float,
    friction: Quantiles,
) -> None:
    """Median and interval of the nodes of one friction (NODES,), where patches (PATCH_NODES,) of
    ice may be.

    blended (NODES,) is scratch; `likeness`, 0 to 1, how much the car is as its file says.
    """
    friction.median = quantile(design.mu, design.prior, weight, 0.5)
    friction.upper = upper_end(design, weight, likeness)
    rest = 1.0
    for j in range(PATCH_NODES):
        rest -= patch[j]
    for j in range(weight.shape[0]):
        blended[j] = rest * weight[j] + (patch[j] if j < PATCH_NODES else 0.0)
    friction.lower = quantile(design.mu, design.prior, blended, LOWER_END)


@compiled
def upper_end(design: MixtureDesign, weight: FloatArray, likeness: float) -> float:
    """Upper end of nodes of one friction with weight (NODES,): above it the truth lies once in
    twenty times at most.
    """
    learned = 0.0
    for j in range(weight.shape[0]):
        if weight[j] > 0.0:
            learned += weight[j] * math.log(weight[j] / design.prior[j])
    learned_end = LEARNED_END - NEARER * likeness
    level = learned_end + (UPPER_END - learned_end) * math.exp(-max(learned, 0.0) / LEARNED)
    widest = quantile(design.mu, design.prior, weight, UPPER_END)
    upper = max(
        quantile(design.mu, design.prior, weight, level),
        widest - DRAWN_IN - DRAWN_NEARER * likeness,
    )
    if upper >= SLIPPERY_MU:
        return upper
    surely = quantile(design.mu, design.prior, weight, SURE_END)
    return max(upper, min(surely, SLIPPERY_MU))
