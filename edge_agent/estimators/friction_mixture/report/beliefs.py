"""Read-only access to the current friction beliefs (probabilities of friction) of the default
estimator's filters.
"""

from __future__ import annotations

from edge_agent.estimators.common.arrays import clear_vector
from edge_agent.estimators.friction_mixture.state.constants import NODES
from edge_agent.estimators.friction_mixture.state.friction_grid import visit_evidence
from edge_agent.estimators.friction_mixture.state.memory import MixtureMemory
from edge_agent.estimators.friction_mixture.state.split_sides import BOTH, project_weights
from edge_agent.estimators.friction_mixture.state.workspace import MixtureContext
from schemas.mugrid import CENTRES
from schemas.numeric import FloatArray
from schemas.runtime.jit import compiled
from schemas.runtime.records import Records


@compiled
def report_beliefs(
    filters: Records[MixtureMemory],
    contexts: Records[MixtureContext],
    own: FloatArray,
    visit: FloatArray,
) -> None:
    """Write the friction belief of each filter, and its evidence from the current visit (passage of
    one map cell), on the 32 bins of the friction grid.

    `own` (N, 32) receives the belief as log(posterior/uniform), and `visit` (N, 32) the evidence as
    log-likelihood. Each vehicle's values have maximum 0.
    """
    design = contexts[0].design
    scratch = contexts[0].scratch
    for n in range(own.shape[0]):
        memory = filters[n]
        if not memory.started:
            clear_vector(own[n])
            clear_vector(visit[n])
        elif memory.split:
            project_weights(design.sides.prior, design.sides.share[BOTH], scratch.expected)
            project_weights(memory.weight, design.sides.share[BOTH], scratch.projected)
            visit_evidence(design.mu, design.width, scratch.projected, CENTRES, own[n])
            project_weights(memory.visit_weight, design.sides.share[BOTH], scratch.projected)
            visit_evidence(design.mu, scratch.expected, scratch.projected, CENTRES, visit[n])
        else:
            visit_evidence(design.mu, design.width, memory.weight[:NODES], CENTRES, own[n])
            visit_evidence(design.mu, design.prior, memory.visit_weight[:NODES], CENTRES, visit[n])
