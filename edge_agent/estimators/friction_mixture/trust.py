"""Whether any friction explains what is measured: no belief survives its contradiction.

Two signs: the axles' innovations stay beyond their theory, as with steering that is late or a bank; or all that is
believed of vehicle and sensors together is beyond what can be. A change of the road is over within the block that
takes it; sensors that contradict each other go on. At full distrust nothing is concluded on friction (its interval
goes back to the prior), the axles have no say in the motion, and what was learned meanwhile is forgotten.
"""

from __future__ import annotations

import math

from edge_agent.estimators.friction_mixture.design import MixtureDesign
from edge_agent.estimators.friction_mixture.memory import MixtureMemory
from edge_agent.estimators.friction_mixture.node_filter import belief_cost
from schemas.runtime.jit import compiled

LEAST_VARIANCE = 1e-12  # before the first innovation
REPORTED = 0.5  # distrust from which health says so


@compiled
def judge(memory: MixtureMemory, design: MixtureDesign, duration: float) -> None:
    """Renew memory.trust by the innovations and the belief of the block."""
    trust, constants = memory.trust, design.constants
    ratio = memory.actual[1] / max(memory.theoretical[1], LEAST_VARIANCE)
    belief = belief_cost(memory.overall_mean, design.nominal)
    odd = max(ratio / constants.odd_ratio - 1.0, (belief - constants.odd_belief) / constants.odd_belief_width)
    odd = min(max(odd, 0.0), 1.0)
    keep = math.exp(-duration / (constants.odd_rise if odd > trust.odd else constants.odd_fall))
    trust.odd = keep * trust.odd + (1.0 - keep) * odd
    share = (trust.odd - constants.distrust_from) / (constants.distrust_full - constants.distrust_from)
    trust.distrust = min(max(share, 0.0), 1.0)
