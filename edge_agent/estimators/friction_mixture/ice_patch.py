"""Ice comes in patches: on bridges, in shade, where water ran. Who has asked for no grip for some
metres does not know.

The mixture's road changes to anywhere once in hundreds of metres, so that what was learned lasts;
with it alone the lower end falls to ice long after a patch has been passed. Beside the mixture
stands, for each node of ice, how probable a patch is here: within the length of a patch it grows to
what the prior holds there and the mixture lacks, and what speaks against ice here takes it away.
Only the lower end is told with it: nothing is concluded on a patch.
"""

from __future__ import annotations

import math

from edge_agent.estimators.friction_mixture.constants import PATCH_NODES
from edge_agent.estimators.friction_mixture.design import MixtureDesign
from edge_agent.estimators.friction_mixture.memory import MixtureMemory
from schemas.numeric import FloatArray
from schemas.runtime.jit import compiled


@compiled
def drive_onto(memory: MixtureMemory, design: MixtureDesign, metres: float) -> None:
    """Patches become more probable over `metres`."""
    share = 1.0 - math.exp(-metres / design.constants.patch_length)
    for j in range(PATCH_NODES):
        memory.patch[j] += share * (max(design.prior[j] - memory.weight[j], 0.0) - memory.patch[j])


@compiled
def refute(patch: FloatArray, weight: FloatArray, log_likelihood: FloatArray) -> None:
    """Patches (PATCH_NODES,) become less probable where a block speaks less for them than for
    the mixture (K,).
    """
    usual = 0.0
    for j in range(weight.shape[0]):
        usual += weight[j] * math.exp(log_likelihood[j])
    for j in range(patch.shape[0]):
        patch[j] *= min(math.exp(log_likelihood[j]) / usual, 1.0)
