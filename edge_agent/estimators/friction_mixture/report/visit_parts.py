"""Friction jumps inside a visit (passage of one map cell): their detection, and the evidence of the
part of the visit before the surface changed.

The friction belief (node probabilities) of a visit starts from the prior and follows the road. At
the end it describes only the last surface. In addition, the filter keeps the belief with the most
information so far; D measures the information. If almost all of the current belief lies at
frictions that the kept belief excludes, the friction has jumped. Then the kept belief becomes the
evidence of the part that ends, and the next part begins. A belief in transition between the two
surfaces neither replaces the kept belief nor counts as a jump.

Legend
    w, s       probabilities of the nodes in the visit, and those of the kept belief   (K,)
    p          prior probabilities of the nodes                                    (K,)
    D          information, Σ w·ln(w/p) [nat]
"""

from __future__ import annotations

import math

from edge_agent.estimators.common.arrays import copy_vector
from edge_agent.estimators.friction_mixture.state.constants import NODES
from edge_agent.estimators.friction_mixture.state.design import MixtureDesign
from edge_agent.estimators.friction_mixture.state.friction_grid import visit_evidence
from edge_agent.estimators.friction_mixture.state.memory import MixtureMemory
from schemas.mugrid import CENTRES
from schemas.numeric import FloatArray
from schemas.runtime.jit import compiled

# [nat] A friction is excluded if its log-likelihood minus the largest one is below this.
EXCLUDED_NATS = -3.0
EXCLUDED = math.exp(EXCLUDED_NATS)
# [1] part of the current belief at excluded frictions that means a jump. If as large a part is at
# the other frictions, the current belief may replace the kept one.
ALMOST_WHOLE = 0.9
# [nat] least information of a belief that can show a jump: half of the range is excluded
KNOWING = math.log(2.0)


@compiled
def begin_part(memory: MixtureMemory, design: MixtureDesign) -> None:
    """Begin a new part (stretch on one surface) of the visit, which is the passage of one map cell.
    The new part has no evidence on friction yet.
    """
    copy_vector(memory.surest, design.prior)
    memory.information = 0.0


@compiled
def end_part(memory: MixtureMemory, design: MixtureDesign, evidence: FloatArray) -> None:
    """Test at the end of a block (0.05 s) for a friction jump inside the visit. A jump ends the
    current part of the visit and begins the next part.

    If friction has jumped, write the log-likelihood of the part that ends to `evidence` (32,), at
    the friction values CENTRES. This log-likelihood comes from the belief (probabilities of the
    friction hypotheses) in `memory.surest`. Without a jump, the current belief replaces the belief
    in `memory.surest` if both are compatible and the current belief contains more information on
    friction.
    """
    if memory.split:
        return
    w = memory.visit_weight[:NODES]
    s = memory.surest
    p = design.prior
    known = 0.0
    most = 0.0
    for j in range(NODES):
        known += w[j] * math.log(w[j] / p[j])
        most = max(most, s[j] / p[j])
    excluded = 0.0
    for j in range(NODES):
        if s[j] < EXCLUDED * most * p[j]:
            excluded += w[j]
    jumped = known >= KNOWING and excluded > ALMOST_WHOLE
    if jumped:
        visit_evidence(design.mu, p, s, CENTRES, evidence)
    if jumped or (known > memory.information and 1.0 - excluded > ALMOST_WHOLE):
        copy_vector(s, w)
        memory.information = known
