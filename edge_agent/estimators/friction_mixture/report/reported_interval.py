"""The reported friction interval. The quantile levels of both ends are chosen so that the interval
covers the true friction as often as stated.

The upper end is the UPPER_END quantile of the node probabilities (of the friction hypotheses). It
is lower for a car that behaves as its vehicle file predicts (`trust.nominal_agreement`), once its
measurements have changed the probabilities. The measure of this change is their divergence from the
prior (Kullback and Leibler 1951).

The quantile level of the lower end decreases from LOWER_END to half of it as P(mu < SLIPPERY_MU)
rises from .5 to 1.

P(mu < SLIPPERY_MU) is computed from the same node probabilities. The filter weakens (tempers)
evidence so that a repeated error does not count twice. Therefore P tends to be too close to its
prior value.
"""

from __future__ import annotations

import math

from edge_agent.estimators.friction_mixture.state.constants import PATCH_NODES
from edge_agent.estimators.friction_mixture.state.design import MixtureDesign
from edge_agent.estimators.friction_mixture.state.friction_grid import probability_below, quantile
from edge_agent.estimators.friction_mixture.state.memory import Quantiles
from schemas.numeric import FloatArray
from schemas.runtime.jit import compiled
from schemas.thresholds import SLIPPERY_MU

# [1] quantile level of the lower end. Safe deceleration depends on it: with .04 the lower end was
# above the true friction for a sixth of the ice in town.
# On a road that is certainly slippery, half of it applies. The forces of sliding wheels share an
# error (load, slope of the road), which more measurements do not reduce. On ice in four towns, the
# interval contained the true friction in .89 of the samples with .03 and in .92 with .015.
LOWER_END = 0.03
UPPER_END = 0.95  # [1] quantile level of the upper end
# [1] reduction of this level, and largest reduction of the upper end (in friction), for a car that
# agrees with its vehicle file, because its other errors are small too. The lower end stays, because
# safe deceleration depends on it.
NEARER = 0.15
# [nat] scale of the information (divergence from the prior) from which the level is reduced
LEARNED = 0.05


@compiled
def find_interval(
    design: MixtureDesign,
    weight: FloatArray,
    patch: FloatArray,
    blended: FloatArray,
    likeness: float,
    friction: Quantiles,
) -> None:
    """Compute median, interval and P(mu < SLIPPERY_MU) of friction from the probabilities `weight`
    (NODES,) of the friction hypotheses.

    The car may also be on a short ice patch. `patch` (PATCH_NODES,) is the probability of a patch
    with the friction of each of the first PATCH_NODES hypotheses. Only the lower end of the
    interval uses `patch`. For it, `weight` is multiplied by 1 minus the sum of `patch`, and `patch`
    is added.

    `likeness`, 0 to 1, is the agreement of the car with its vehicle file. `blended` (NODES,) is
    scratch memory.
    """
    friction.median = quantile(design.mu, design.width, weight, 0.5)
    friction.upper = upper_end(design, weight, likeness)
    friction.p_slippery = probability_below(design.mu, design.width, weight, SLIPPERY_MU)
    rest = 1.0
    for j in range(PATCH_NODES):
        rest -= patch[j]
    for j in range(weight.shape[0]):
        blended[j] = rest * weight[j] + (patch[j] if j < PATCH_NODES else 0.0)
    icy = max(2.0 * friction.p_slippery - 1.0, 0.0)
    level = LOWER_END * (1.0 - 0.5 * icy)
    friction.lower = quantile(design.mu, design.width, blended, level)


@compiled
def upper_end(design: MixtureDesign, weight: FloatArray, likeness: float) -> float:
    """Return the upper end of the friction interval for the probabilities `weight` (NODES,) of the
    friction hypotheses. `likeness`, 0 to 1, is the agreement of the car with its vehicle file.

    The quantile level is chosen so that the true friction lies above the result in at most one case
    of twenty.
    """
    learned = 0.0
    for j in range(weight.shape[0]):
        if weight[j] > 0.0:
            learned += weight[j] * math.log(weight[j] / design.prior[j])
    nearer = NEARER * likeness * (1.0 - math.exp(-max(learned, 0.0) / LEARNED))
    widest = quantile(design.mu, design.width, weight, UPPER_END)
    return max(quantile(design.mu, design.width, weight, UPPER_END - nearer), widest - nearer)
