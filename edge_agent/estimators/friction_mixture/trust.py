"""Whether any friction explains what is measured: no belief survives its contradiction.

The rules are those of `adaptation/rule_base.py`. Two signs: the axles' innovations stay beyond their theory, as with
steering that is late or a bank; or all that is believed of vehicle and sensors together is beyond what can be. A change
of the road is over within the block that takes it; sensors that contradict each other go on. At full distrust nothing
is concluded on friction (its interval goes back to the prior), the axles have no say in the motion, and what was
learned meanwhile is forgotten.
"""

from __future__ import annotations

import math

from edge_agent.adaptation.rule_base import contradiction, distrust, hurry
from edge_agent.estimators.friction_mixture.design import MixtureDesign
from edge_agent.estimators.friction_mixture.memory import MixtureMemory
from edge_agent.estimators.friction_mixture.node_filter import belief_cost
from schemas.runtime.jit import compiled

LEAST_VARIANCE = 1e-12  # before the first innovation
REPORTED = 0.5  # distrust from which health says so


@compiled
def judge(memory: MixtureMemory, design: MixtureDesign, duration: float) -> None:
    """Renew memory.trust by the innovations and the belief of the block."""
    if not design.adaptive:
        return
    trust, constants, rules = memory.trust, design.constants, design.rules
    wheels = memory.actual[0] / max(memory.theoretical[0], LEAST_VARIANCE) - 1.0
    axles = memory.actual[1] / max(memory.theoretical[1], LEAST_VARIANCE) - 1.0
    # by what any car may be: a calibration makes the belief of this one narrower, and contradicts nothing
    odd = contradiction(rules, axles, belief_cost(memory.overall_mean, design.nominal))
    keep = math.exp(-duration / (constants.odd_rise if odd > trust.odd else constants.odd_fall))
    trust.odd = keep * trust.odd + (1.0 - keep) * odd
    trust.distrust, trust.hurry = distrust(rules, trust.odd), hurry(rules, wheels)
