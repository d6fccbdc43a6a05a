"""Model of short ice patches, which occur on bridges, in shade, or where water ran over the road.

After a few metres without large tyre forces, the estimator lowers the lower end of the friction
interval, because the road may be icy again. The median is unaffected. The mixture assumes that the
road changes only once in hundreds of metres, so that learned friction lasts. With the mixture
alone, the lower end would fall to the friction of ice much too late for a patch of a few metres.

Therefore this module stores, for each ice node (hypothesis of low friction), the probability that
the car is now on a patch. While the car drives, this probability approaches a target, within about
the length of a patch. The target is the node's prior probability, minus the probability that the
mixture already gives to the node. Measurements that speak against ice reduce the stored
probability. Only the reported lower end uses the stored probability.
"""

from __future__ import annotations

import math

from edge_agent.estimators.friction_mixture.state.constants import PATCH_NODES
from edge_agent.estimators.friction_mixture.state.design import MixtureDesign
from edge_agent.estimators.friction_mixture.state.memory import MixtureMemory
from schemas.numeric import FloatArray
from schemas.runtime.jit import compiled


@compiled
def grow_patches(memory: MixtureMemory, design: MixtureDesign, metres: float) -> None:
    """Increase the probabilities that the car is now on a short ice patch, according to the metres
    driven since the last call.
    """
    share = 1.0 - math.exp(-metres / design.constants.physical.patch_length)
    for j in range(PATCH_NODES):
        memory.patch[j] += share * (max(design.prior[j] - memory.weight[j], 0.0) - memory.patch[j])


@compiled
def shrink_patches(patch: FloatArray, weight: FloatArray, log_likelihood: FloatArray) -> None:
    """Reduce the probabilities `patch` (PATCH_NODES,) that the car is on an ice patch, for those
    ice hypotheses that explain the measurements of the block (0.05 s) worse than the whole mixture
    of nodes (K,) does.
    """
    usual = 0.0
    for j in range(weight.shape[0]):
        usual += weight[j] * math.exp(log_likelihood[j])
    for j in range(patch.shape[0]):
        patch[j] *= min(math.exp(log_likelihood[j]) / usual, 1.0)
