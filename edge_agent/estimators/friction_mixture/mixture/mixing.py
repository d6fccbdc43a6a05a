"""Operations on all nodes (filters of one friction hypothesis each): mixing after a road change,
moment matching, and replacement of diverged nodes.

Legend
    m_j, P_j, w_j   mean (n,), covariance (n, n) and probability of node j
    m, P            mean and covariance of the whole mixture
    zeta            share of a node's predicted probability that came from any other node by a
                    road change [1]

The state of a node after mixing is (1 - zeta)*N(m_j, P_j) + zeta*N(m, P), matched in its first two
moments. An improbable node thus keeps a plausible vehicle state and can explain the next sample
(interacting multiple models, Blom and Bar-Shalom 1988). Covariances are only added here, never
subtracted.
"""

from __future__ import annotations

import math

import numpy as np

from edge_agent.estimators.common.arrays import clear_rows, clear_vector, copy_vector, put_square
from edge_agent.estimators.friction_mixture.mixture.trust import used_evidence_share
from edge_agent.estimators.friction_mixture.state.constants import (
    ALL_NODES,
    NODES,
    Constants,
    NodeState,
)
from edge_agent.estimators.friction_mixture.state.design import MixtureDesign
from edge_agent.estimators.friction_mixture.state.friction_grid import (
    SMALLEST,
    RoadChange,
    change_road,
)
from edge_agent.estimators.friction_mixture.state.gap import put_split_to_sleep
from edge_agent.estimators.friction_mixture.state.memory import MixtureMemory
from edge_agent.estimators.friction_mixture.state.workspace import Scratch
from schemas.numeric import FloatArray
from schemas.runtime.jit import compiled

LEAST_MIXING = 1e-3  # a smaller share of foreign mass changes no digit that is read
LEAST_WEIGHT = 1e-9  # nor does a node of less
# of the split nodes' prior: below, they sleep again; above, they would wake at the next sign
SLEEPING_SHARE = 0.5
FORGOTTEN_S = 0.5  # in which friction goes back to its prior once nothing is believed
BRINK = 4  # power of doubt in that: a contradiction that merely grows forgets nothing yet
# of a node's mass in a block: more would overshoot the balance between neighbours
LARGEST_DRIFT = 0.5


@compiled
def active_nodes(memory: MixtureMemory) -> int:
    """Return the number of active nodes (friction hypotheses): NODES, or ALL_NODES while the nodes
    of split roads (different friction left and right) are active too.
    """
    return ALL_NODES if memory.split else NODES


@compiled
def wake_or_sleep(memory: MixtureMemory, design: MixtureDesign, scratch: Scratch) -> None:
    """Activate the nodes of split roads (different friction left and right) at the first sign of
    such a road, and deactivate them once they are improbable.
    """
    weight = memory.weight
    visit = memory.visit_weight
    constants = design.constants
    sign = scratch.features.asymmetry > constants.split_asymmetry
    if memory.split:
        total = 0.0
        for j in range(NODES, ALL_NODES):
            total += weight[j]
        if total < SLEEPING_SHARE * constants.split_prior and not sign:
            put_split_to_sleep(memory)
    elif sign:
        memory.split = True
        for j in range(NODES):
            weight[j] *= 1.0 - constants.split_prior
            visit[j] *= 1.0 - constants.split_prior
        for j in range(NODES, ALL_NODES):
            weight[j] = visit[j] = design.sides.prior[j]
            memory.penalty[j] = 0.0
            copy_vector(memory.mean[j], memory.overall_mean)
            put_square(memory.covariance[j], memory.overall_covariance)


@compiled
def apply_road_change(
    memory: MixtureMemory, design: MixtureDesign, scratch: Scratch, metres: float
) -> None:
    """Account for a possible change of the road within `metres`: move probability between nodes
    (friction hypotheses). The state of a node is mixed with the states of the nodes from which its
    probability comes.
    """
    count = active_nodes(memory)
    constants = design.constants
    prior = design.sides.prior[:count] if memory.split else design.prior[:count]
    hazard = 1.0 - math.exp(-metres * constants.hazard)
    doubt = 1.0 - used_evidence_share(memory.trust, constants)
    forgotten = 1.0 - math.exp(-(doubt**BRINK) * scratch.features.duration / FORGOTTEN_S)
    ended = max(memory.slip.ended, memory.slip.axle_ended)
    slid = 1.0 - math.exp(-metres * constants.slip_hazard * ended)
    hazard = max(hazard, forgotten, slid, constants.slip_change * memory.slip.begins)
    leaving = 1.0 - math.exp(-metres * constants.split_hazard)
    drift = min(metres * constants.diffusion * NODES, LARGEST_DRIFT)
    predicted = scratch.predicted[:count]
    weight = memory.weight[:count]
    visit = memory.visit_weight[:count]
    change = RoadChange(hazard, leaving, drift)
    change_road(visit, prior, NODES, change, predicted)
    copy_vector(visit, predicted)
    change_road(weight, prior, NODES, change, predicted)
    for j in range(count):
        zeta = min(hazard * prior[j] / predicted[j], 1.0)
        memory.penalty[j] *= 1.0 - zeta
        mix_node(
            memory.mean[j],
            memory.covariance[j],
            zeta,
            memory.overall_mean,
            memory.overall_covariance,
        )
    copy_vector(weight, predicted)


@compiled
def mix_node(
    mean: FloatArray,
    covariance: FloatArray,
    zeta: float,
    overall_mean: FloatArray,
    overall_covariance: FloatArray,
) -> None:
    """Mix the state of one node (friction hypothesis) with that of the whole mixture: mean (n,) and
    covariance (n, n) are changed in place."""
    if zeta < LEAST_MIXING:
        return
    n = mean.shape[0]
    for i in range(n):
        apart = zeta * (1.0 - zeta) * (overall_mean[i] - mean[i])
        for j in range(i + 1):
            foreign = zeta * (overall_covariance[i, j] - covariance[i, j])
            covariance[i, j] += foreign + apart * (overall_mean[j] - mean[j])
            covariance[j, i] = covariance[i, j]
    for i in range(n):
        mean[i] += zeta * (overall_mean[i] - mean[i])


@compiled
def match_moments(
    mean: FloatArray,
    covariance: FloatArray,
    weight: FloatArray,
    overall_mean: FloatArray,
    overall_covariance: FloatArray,
) -> None:
    """Compute mean (n,) and covariance (n, n) of the mixture of the first K nodes (filters of one
    friction hypothesis each) with weights (K,).
    """
    count = weight.shape[0]
    n = mean.shape[1]
    clear_vector(overall_mean)
    clear_rows(overall_covariance)
    for k in range(count):
        for i in range(n):
            overall_mean[i] += weight[k] * mean[k, i]
    for k in range(count):
        if weight[k] < LEAST_WEIGHT:
            continue
        for i in range(n):
            apart = mean[k, i] - overall_mean[i]
            for j in range(i + 1):
                overall_covariance[i, j] += weight[k] * (
                    covariance[k, i, j] + apart * (mean[k, j] - overall_mean[j])
                )
    for i in range(n):
        for j in range(i):
            overall_covariance[j, i] = overall_covariance[i, j]


@compiled
def reset_diverged(
    mean: FloatArray, root: FloatArray, weight: FloatArray, constants: Constants
) -> None:
    """Reset diverged nodes (filters of one friction hypothesis): each gets the state of the most
    probable node, and a weight of almost zero.
    """
    best = int(np.argmax(weight))
    for j in range(weight.shape[0]):
        astray = max(
            abs(mean[j, NodeState.VX] - mean[best, NodeState.VX]) / constants.diverged_x,
            abs(mean[j, NodeState.VY] - mean[best, NodeState.VY]) / constants.diverged_y,
        )
        if astray > 1.0:
            copy_vector(mean[j], mean[best])
            put_square(root[j], root[best])
            weight[j] = SMALLEST
