"""Weights of the friction hypotheses (nodes) after a block of 0.05 s: likelihoods that fuzzy rules
weaken (temper), and adaptation of the measurement noise R.

While nothing changes, errors of the tyre curve and of offsets repeat from block to block. Therefore
the evidence of such blocks counts less. Where a bend becomes icy the forces stay the same and the
slip grows, so a change of either counts as new. Where an axle has slid and grips again at the same
force, the ice has probably ended (`mixing.py`).
"""

from __future__ import annotations

import math

from edge_agent.adaptation.fuzzy import adapted_factor
from edge_agent.adaptation.rule_base import evidence_share
from edge_agent.dynamics.parameters import Parameter
from edge_agent.dynamics.slip import SLOWEST_M_S as SLOWEST_SLIP_M_S
from edge_agent.dynamics.tyres import TINY
from edge_agent.estimators.friction_mixture.block.grip_guard import guard_penalty
from edge_agent.estimators.friction_mixture.mixture.ice_patch import shrink_patches
from edge_agent.estimators.friction_mixture.mixture.mixing import active_nodes, reset_diverged
from edge_agent.estimators.friction_mixture.mixture.trust import (
    slippery_probability,
    used_evidence_share,
)
from edge_agent.estimators.friction_mixture.node.node_filter import update_node
from edge_agent.estimators.friction_mixture.node.rolling_motion import take_rolling
from edge_agent.estimators.friction_mixture.state.constants import NodeState
from edge_agent.estimators.friction_mixture.state.design import MixtureDesign
from edge_agent.estimators.friction_mixture.state.friction_grid import multiply_likelihood
from edge_agent.estimators.friction_mixture.state.gap import SLOWEST_M_S
from edge_agent.estimators.friction_mixture.state.memory import MixtureMemory
from edge_agent.estimators.friction_mixture.state.workspace import BlockFeatures, Scratch
from edge_agent.filters.cholesky import factorize
from schemas.numeric import FloatArray
from schemas.runtime.jit import compiled
from schemas.signals import S

LEAST_VARIANCE = 1e-18  # of a state given the states before it
LEAST_DEMAND = 1e-3  # [1] below it no evidence is left


@compiled
def apply_measurement(memory: MixtureMemory, design: MixtureDesign, scratch: Scratch) -> None:
    """Apply the measurements of the block (0.05 s): update all nodes (friction hypotheses),
    recompute their weights, and adapt the measurement noise R.
    """
    update_all(memory, design, scratch)
    temper_evidence(memory, design, scratch)
    weight = memory.weight[: active_nodes(memory)]
    reset_diverged(memory.mean, scratch.root, weight, design.constants)
    shrink_patches(memory.patch, weight, scratch.log_likelihood)
    multiply_likelihood(weight, scratch.log_likelihood)
    multiply_likelihood(memory.visit_weight[: active_nodes(memory)], scratch.log_likelihood)
    adapt_noise(memory, design, scratch)


@compiled
def update_all(memory: MixtureMemory, design: MixtureDesign, scratch: Scratch) -> None:
    """Update every active node (filter of one friction hypothesis); store the NIS (squared
    innovation over its variance) and the predictive log-likelihood of the mixture.
    """
    inflation = max(design.constants.correlation_time / scratch.features.duration, 1.0)
    count = active_nodes(memory)
    for group in range(2):
        scratch.actual_sum[group] = scratch.theoretical_sum[group] = 0.0
    scratch.stated_sum = 0.0
    surplus = 1.0 - 1.0 / scratch.features.axle_scale
    top = -math.inf
    nis = 0.0
    rows = 0
    features = scratch.features
    steady = design.constants.steady_share
    features.novelty = steady + (1.0 - steady) * features.new
    for j in range(count):
        factorize(memory.covariance[j], scratch.root[j], LEAST_VARIANCE)
        found = update_node(memory, design, scratch, j, inflation)
        scratch.log_likelihood[j] = found.log_likelihood - take_rolling(memory, design, scratch, j)
        scratch.moved[j] = found.moved
        scratch.joint[j] = found.plain + math.log(memory.weight[j])
        top = max(top, scratch.joint[j])
        rows = found.rows
        nis += memory.weight[j] * found.square
        for r in range(6):
            if not math.isnan(scratch.innovation[j, r]):
                group = 0 if r < 4 else 1
                scratch.actual_sum[group] += memory.weight[j] * scratch.innovation[j, r] ** 2
                scratch.theoretical_sum[group] += memory.weight[j] * scratch.theoretical[j, r]
                if group == 1:
                    without = scratch.theoretical[j, r] - surplus * scratch.node.noise[r]
                    scratch.stated_sum += memory.weight[j] * without
    total = 0.0
    for j in range(count):
        total += math.exp(scratch.joint[j] - top)
    memory.log_likelihood = top + math.log(total) if rows > 0 else 0.0
    memory.nis = nis / rows if rows > 0 else 0.0


@compiled
def temper_evidence(memory: MixtureMemory, design: MixtureDesign, scratch: Scratch) -> None:
    """Replace scratch.log_likelihood [nat] of each node by the evidence of the block (0.05 s) that
    counts: rules weaken (temper) the likelihood.

    A node (friction hypothesis) below the grip in use gets its penalty however small the tyre
    forces are. Once the filter accepts that measurements contradict the model, no evidence is used.
    Without accelerations, yaw rate or steering, sliding cannot be distinguished from rolling, so no
    evidence on friction is used either.
    """
    constants = design.constants
    features = scratch.features
    count = active_nodes(memory)
    best = -math.inf
    for j in range(count):
        best = max(best, scratch.log_likelihood[j])
    need = (constants.demand_half / max(features.demand, LEAST_DEMAND)) ** constants.demand_power
    blind = memory.block.counts[S.AX] == 0 or math.isnan(features.side[0] + features.side[1])
    slid = memory.slip.held
    share = features.novelty / (1.0 + need)
    if design.adaptive:
        share = math.exp(
            evidence_share(design.rules, slid, features.demand, features.new, memory.trust.strain)
        )
    believed = used_evidence_share(memory.trust, constants)
    believed += slid * (1.0 - memory.trust.distrust) * (1.0 - believed)
    moving = slip_meaning(features, memory.overall_mean[NodeState.VX]) * believed
    for j in range(count):
        loss = scratch.log_likelihood[j] - best
        beyond = min(loss + constants.plausible_loss, 0.0)
        loss = max(loss, -constants.plausible_loss)
        loss = max(moving * (share * loss + beyond), -constants.largest_loss)
        loss -= moving * guard_penalty(memory.grip, constants, design.sides.mu[j])
        charged = charge_penalty(memory, j, moving * need / (1.0 + need) * scratch.moved[j])
        scratch.log_likelihood[j] = 0.0 if blind else loss - charged


@compiled
def charge_penalty(memory: MixtureMemory, node: int, price: float) -> float:
    """Return the charge [nat] of a node: how much its log-likelihood is reduced because its vehicle
    states moved away from the prior.

    `price` is the change of the node's penalty. A negative charge (refund) never exceeds the amount
    charged before. Tempered evidence charges this cost only in part, while the measurement has
    changed the node's state in full. Without this penalty, on drives with little grip demand a low
    friction would remain probable with a stiffness or an offset three standard deviations from the
    prior.
    """
    charged = max(price, -memory.penalty[node])
    memory.penalty[node] += charged
    return float(charged)


@compiled
def slip_meaning(features: BlockFeatures, vx: float) -> float:
    """Return the share, 0 to 1, of the evidence from slip that counts at the speed `vx` [m/s]: 0 up
    to SLOWEST_M_S, 1 from twice that speed.
    """
    fastest = abs(vx)
    for wheel in range(4):
        if not math.isnan(features.rolling[wheel]):
            fastest = max(fastest, abs(features.rolling[wheel]))
    return min(max(fastest / SLOWEST_M_S - 1.0, 0.0), 1.0)


@compiled
def update_novelty(
    memory: MixtureMemory, design: MixtureDesign, features: BlockFeatures, vx: float, vy: float
) -> None:
    """Compute two fuzzy truth values, 0 to 1: features.new ("forces or slips are new") and
    memory.slip.axle_ended ("the slide has ended"). Update the smoothed usual forces and slips.

    (vx, vy) [m/s] is the mean velocity of the block.
    """
    constants = design.constants
    keep = math.exp(-features.duration / constants.steady_time)
    force = slip = slides = 0.0
    for r in range(6):
        now = features.force[r] if r < 4 else features.side[r - 4]
        force = max(force, advance_usual(memory.usual_force, r, now, keep))
    for axle in range(2):
        now = axle_slip(memory.row, features, vx, vy, axle)
        slip = max(slip, advance_usual(memory.usual_slip, axle, now, keep))
        slides = max(slides, saturation(now, memory.friction.median))
    change = max(force, slip)
    features.new = change**2 / (change**2 + constants.steady_half**2)
    slides *= slippery_probability(memory, design)
    held = memory.slip.axle_held * math.exp(-features.duration / constants.slip_time)
    memory.slip.axle_held = max(slides, held)
    steady = min(max(2.0 - 2.0 * force / max(features.demand, TINY), 0.0), 1.0)
    memory.slip.axle_ended = (memory.slip.axle_held - slides) * steady


@compiled
def saturation(slip: float, mu: float) -> float:
    """Return the fuzzy truth value, 0 to 1, of "the axle slides" on friction `mu`.

    `slip` is in units of the force over load of a linear tyre [1]. The result is 0 up to a slip of
    mu and 1 from 1.5 mu on; 0 where the slip is unknown.
    """
    return 0.0 if math.isnan(slip) else min(max(2.0 * (abs(slip) / mu - 1.0), 0.0), 1.0)


@compiled
def advance_usual(usual: FloatArray, i: int, now: float, keep: float) -> float:
    """Return the absolute difference between a value `now` and its usual value usual[i], and move
    usual[i] towards `now`: it keeps the share `keep`. Return 0 if `now` is NaN.
    """
    if math.isnan(now):
        return 0.0
    apart = abs(now - usual[i])
    usual[i] = keep * usual[i] + (1.0 - keep) * now
    return float(apart)


@compiled
def axle_slip(row: FloatArray, features: BlockFeatures, vx: float, vy: float, axle: int) -> float:
    """Return the lateral slip of an axle at the velocity (vx, vy) [m/s], as linear force over load;
    NaN if its lateral force is unknown.
    """
    if math.isnan(features.side[axle]):
        return math.nan
    place = row[Parameter.TO_FRONT] if axle == 0 else -row[Parameter.TO_REAR]
    left = vy + place * features.yaw_rate
    cos = features.steer_cos[2 * axle]
    sin = features.steer_sin[2 * axle]
    speed = max(abs(cos * vx + sin * left), SLOWEST_SLIP_M_S)
    return float(-row[Parameter.SLOPE_Y] * (cos * left - sin * vx) / speed)


@compiled
def adapt_noise(memory: MixtureMemory, design: MixtureDesign, scratch: Scratch) -> None:
    """Update the actual and expected variance of the innovations (measurement minus prediction),
    averaged over the last blocks (of 0.05 s). Compute from them the factors on the measurement
    noise R for the next block.
    """
    keep = math.exp(-scratch.features.duration / design.constants.window)
    for group in range(2):
        if scratch.theoretical_sum[group] > 0.0:
            memory.actual[group] = (
                keep * memory.actual[group] + (1.0 - keep) * scratch.actual_sum[group]
            )
            memory.theoretical[group] = (
                keep * memory.theoretical[group] + (1.0 - keep) * scratch.theoretical_sum[group]
            )
            if design.adaptive:
                memory.factor[group] = adapted_factor(
                    memory.factor[group],
                    memory.actual[group],
                    memory.theoretical[group],
                    design.fuzzy_inputs,
                    design.fuzzy_outputs,
                )
