"""Operations on all nodes (filters of one friction hypothesis each): mixing after a road change,
moment matching, and replacement of diverged nodes.

Legend
    m_j, P_j, w_j   mean (n,), covariance (n, n) and probability of node j
    m, P            mean and covariance of the whole mixture
    zeta            share of a node's predicted probability that came from any other node by a
                    sudden road change [1]

The state of a node after mixing is (1 - zeta)*N(m_j, P_j) + zeta*N(m, P), matched in its first two
moments. An improbable node thus keeps a plausible vehicle state and can explain the next sample
(interacting multiple models, Blom and Bar-Shalom 1988). Covariances are only added here, never
subtracted.
"""

from __future__ import annotations

import math

import numpy as np

from edge_agent.dynamics.tyres import TINY
from edge_agent.estimators.common.arrays import copy_vector
from edge_agent.estimators.friction_mixture.block.wheel_slip import sliding_degree
from edge_agent.estimators.friction_mixture.node.covariance import mix_states
from edge_agent.estimators.friction_mixture.state.constants import (
    ALL_NODES,
    NODES,
    PLACES,
    STATES,
    Constants,
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
from schemas.runtime.lanes import lanes_at, largest_lane, put_lanes, select, sum_lanes
from schemas.runtime.records import LANES

LEAST_MIXING = 1e-3  # [1] smaller shares are not mixed, because they change no digit of the output
# [1] The split nodes are deactivated if their probability is below this share of `split_prior`.
SLEEPING_SHARE = 0.5
# [1] largest share of a node's probability that moves to its neighbours in a block. A larger share
# would overshoot the balance between neighbours.
LARGEST_DRIFT = 0.5


@compiled
def active_nodes(memory: MixtureMemory) -> int:
    """Return the number of active nodes. It is NODES, or ALL_NODES while the nodes of split roads
    (different friction left and right) are active too.
    """
    return ALL_NODES if memory.split else NODES


@compiled
def wake_or_sleep(memory: MixtureMemory, design: MixtureDesign, scratch: Scratch) -> None:
    """Activate the nodes of split roads (hypotheses with different friction left and right) at the
    first sign of a split road, and deactivate them once they are improbable.
    """
    weight = memory.weight
    visit = memory.visit_weight
    constants = design.constants
    sign = scratch.features.asymmetry > constants.chosen.split_asymmetry
    if memory.split:
        total = 0.0
        for j in range(NODES, ALL_NODES):
            total += weight[j]
        if total < SLEEPING_SHARE * constants.physical.split_prior and not sign:
            put_split_to_sleep(memory)
    elif sign:
        memory.split = True
        for j in range(NODES):
            weight[j] *= 1.0 - constants.physical.split_prior
            visit[j] *= 1.0 - constants.physical.split_prior
        for j in range(NODES, ALL_NODES):
            weight[j] = design.sides.prior[j]
            visit[j] = weight[j]
            memory.penalty[j] = 0.0
            _put_moments(memory, j)


@compiled
def _put_moments(memory: MixtureMemory, node: int) -> None:
    """Set mean and covariance of the node with index `node` to those of the whole mixture."""
    group = node // LANES
    lane = node % LANES
    for i in range(STATES):
        memory.mean[group, i, lane] = memory.overall_mean[i]
        for j in range(i + 1):
            memory.covariance[group, i, j, lane] = memory.overall_covariance[i, j]


@compiled
def apply_road_change(
    memory: MixtureMemory, design: MixtureDesign, scratch: Scratch, metres: float
) -> None:
    """Move probability between the nodes, because the road may have changed within the last
    `metres`.

    Also compute scratch.mixing: for each node, the share of its probability that came from all
    nodes by a sudden change. `mix_nodes` then replaces this share of the node's state by that of
    the whole mixture.

    A node's penalty has reduced only the probability that the node had before. Therefore the
    penalty shrinks by the whole share that came from other nodes, its neighbours included.
    """
    count = active_nodes(memory)
    constants = design.constants
    prior = design.sides.prior[:count] if memory.split else design.prior[:count]
    # The force of a sliding wheel follows the friction. If it stays the same, so does the road.
    metres *= 1.0 - sliding_degree(memory) * (1.0 - scratch.features.new)
    hazard = 1.0 - math.exp(-metres * constants.physical.hazard)
    ended = max(memory.slip.ended, memory.slip.axle_ended)
    ended *= carried_degree(memory, constants, scratch.features.demand)
    slid = 1.0 - math.exp(-metres * constants.physical.slip_hazard * ended)
    hazard = max(hazard, slid, constants.physical.slip_change * memory.slip.begins)
    # While the model is distrusted, friction returns to its prior.
    hazard = max(hazard, memory.trust.distrust)
    drift = min(metres * constants.physical.diffusion * NODES, LARGEST_DRIFT)
    predicted = scratch.predicted[:count]
    weight = memory.weight[:count]
    visit = memory.visit_weight[:count]
    change = RoadChange(hazard, drift)
    change_road(visit, prior, NODES, change, predicted)
    copy_vector(visit, predicted)
    change_road(weight, prior, NODES, change, predicted)
    for j in range(PLACES):
        # An inactive node takes the state of the whole mixture, so that its values stay finite.
        gained = 1.0
        scratch.mixing[j] = 1.0
        if j < count:
            scratch.mixing[j] = min(hazard * prior[j] / predicted[j], 1.0)
            gained = max(1.0 - (1.0 - hazard) * weight[j] / predicted[j], scratch.mixing[j])
        memory.penalty[j] *= 1.0 - gained
    copy_vector(weight, predicted)
    share_weights(memory, scratch)


@compiled
def carried_degree(memory: MixtureMemory, constants: Constants, demand: float) -> float:
    """Return the fuzzy degree, 0 to 1, to which the end of a slide shows that the road has changed.

    After a slide, a wheel grips again either because the road has changed, or because the driver
    has released the brake or the accelerator. In the second case the tyre forces are small.
    Therefore the degree grows with the ratio of the tyre force to the friction of the slippery
    road. It is 0 up to the ratio `carried_share`, 1 from twice that ratio, and linear between them.

    Args:
        memory: state of the filter; its friction is still that of the slippery road.
        constants: contain `carried_share` [1].
        demand: larger force over load of the two axles [1].
    """
    slippery = min(memory.friction_left.median, memory.friction_right.median)
    share = demand / max(slippery, TINY)
    return min(max(share / constants.chosen.carried_share - 1.0, 0.0), 1.0)


@compiled
def share_weights(memory: MixtureMemory, scratch: Scratch) -> None:
    """Write the weights (probabilities) of the active nodes (friction hypotheses in use) to
    scratch.share, and 0 for the others.
    """
    count = active_nodes(memory)
    for j in range(PLACES):
        scratch.share[j] = memory.weight[j] if j < count else 0.0


@compiled
def mix_nodes(memory: MixtureMemory, scratch: Scratch, group: int) -> None:
    """Mix the states of a group of nodes after a road change has moved probability to them. In each
    node, the share scratch.mixing of the state is replaced by the state of the whole mixture.
    """
    zeta = lanes_at(scratch.mixing, group)
    zeta = select(zeta < LEAST_MIXING, 0.0, zeta)
    if largest_lane(zeta) > 0.0:
        mix_states(
            memory.mean[group],
            memory.covariance[group],
            zeta,
            memory.overall_mean,
            memory.overall_covariance,
        )


@compiled
def match_moments(memory: MixtureMemory, scratch: Scratch) -> None:
    """Compute mean (n,) and covariance (n, n) of the mixture of all active nodes, weighted by
    scratch.share, and store them in `memory`.
    """
    groups = (active_nodes(memory) + LANES - 1) // LANES
    deviation = scratch.deviation
    for i in range(STATES):
        total = 0.0
        for group in range(groups):
            share = lanes_at(scratch.share, group)
            total += share * lanes_at(memory.mean, (group, i))
        memory.overall_mean[i] = sum_lanes(total)
        for group in range(groups):
            own = lanes_at(memory.mean, (group, i))
            put_lanes(deviation, (group, i), own - memory.overall_mean[i])
    for i in range(STATES):
        for j in range(i + 1):
            total = 0.0
            for group in range(groups):
                share = lanes_at(scratch.share, group)
                share = select(share < SMALLEST, 0.0, share)
                product = lanes_at(deviation, (group, i)) * lanes_at(deviation, (group, j))
                total += share * (lanes_at(memory.covariance, (group, i, j)) + product)
            found = sum_lanes(total)
            memory.overall_covariance[i, j] = found
            memory.overall_covariance[j, i] = found


@compiled
def reset_diverged(
    memory: MixtureMemory, scratch: Scratch, weight: FloatArray, constants: Constants
) -> None:
    """Reset diverged nodes: each gets the state of the most probable node, and a probability of
    almost zero. A node has diverged if its velocity after the measurements, scratch.updated, is far
    from that of the most probable node.
    """
    best = int(np.argmax(weight))
    velocity = scratch.updated
    group = best // LANES
    lane = best % LANES
    for j in range(weight.shape[0]):
        own = velocity[j // LANES]
        astray = max(
            abs(own[0, j % LANES] - velocity[group, 0, lane]),
            abs(own[1, j % LANES] - velocity[group, 1, lane]),
        )
        if astray > constants.guards.diverged:
            _copy_node(memory, j, best)
            weight[j] = SMALLEST


@compiled
def _copy_node(memory: MixtureMemory, target: int, source: int) -> None:
    """Set mean and covariance of the node `target` to those of `source`."""
    mean = memory.mean
    covariance = memory.covariance
    group = target // LANES
    lane = target % LANES
    for i in range(STATES):
        mean[group, i, lane] = mean[source // LANES, i, source % LANES]
        for j in range(i + 1):
            covariance[group, i, j, lane] = covariance[source // LANES, i, j, source % LANES]
