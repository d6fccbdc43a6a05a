"""Weights (probabilities) of the friction hypotheses (nodes) after a block of 0.05 s. Fuzzy rules
weaken (temper) the likelihoods, and the measurement noise R of the axles is adapted.

While nothing changes, errors of the tyre curve and of offsets repeat from block to block. Therefore
the evidence of such blocks counts less. Where the road becomes icy in a bend or while the driver
brakes steadily, the forces stay the same and the slip grows. Therefore a change of force or of slip
makes the evidence count in full. Where an axle has slid and grips again at the same force, the ice
has probably ended (`mixing.py`).
"""

from __future__ import annotations

import math

from edge_agent.adaptation.fuzzy import adapted_factor
from edge_agent.adaptation.rule_base import demand_weight, evidence_share
from edge_agent.dynamics.parameters import Parameter
from edge_agent.dynamics.slip import SLOWEST_M_S as SLOWEST_SLIP_M_S
from edge_agent.dynamics.tyres import TINY
from edge_agent.estimators.friction_mixture.block.grip_guard import guard_penalty
from edge_agent.estimators.friction_mixture.block.wheel_slip import (
    fastest_speed,
    slow_noise,
    wheel_speed,
)
from edge_agent.estimators.friction_mixture.mixture.ice_patch import shrink_patches
from edge_agent.estimators.friction_mixture.mixture.mixing import (
    active_nodes,
    mix_nodes,
    reset_diverged,
)
from edge_agent.estimators.friction_mixture.mixture.trust import (
    slippery_probability,
    used_evidence_share,
)
from edge_agent.estimators.friction_mixture.node.node_filter import predict_nodes, update_nodes
from edge_agent.estimators.friction_mixture.node.residuals import is_measured
from edge_agent.estimators.friction_mixture.node.rolling_motion import take_rolling
from edge_agent.estimators.friction_mixture.state.constants import ROWS, Constants, NodeState
from edge_agent.estimators.friction_mixture.state.design import MixtureDesign
from edge_agent.estimators.friction_mixture.state.friction_grid import multiply_likelihood
from edge_agent.estimators.friction_mixture.state.gap import SLOWEST_M_S
from edge_agent.estimators.friction_mixture.state.memory import MixtureMemory
from edge_agent.estimators.friction_mixture.state.workspace import BlockFeatures, Scratch
from schemas.numeric import FloatArray
from schemas.runtime.jit import compiled
from schemas.runtime.lanes import (
    exp_lanes,
    lanes_at,
    largest_lane,
    put_lanes,
    select,
    sum_lanes,
)
from schemas.runtime.records import LANES
from schemas.signals import S
from schemas.thresholds import UTILISED_WINDOW_S


@compiled
def weigh_nodes(memory: MixtureMemory, design: MixtureDesign, scratch: Scratch) -> None:
    """Recompute the weights (probabilities) of all nodes (friction hypotheses) from the likelihoods
    of the block (0.05 s), and adapt the measurement noise R of the axles.
    """
    temper_evidence(memory, design, scratch)
    count = active_nodes(memory)
    weight = memory.weight[:count]
    reset_diverged(memory, scratch, weight, design.constants)
    shrink_patches(memory.patch, weight, scratch.log_likelihood)
    multiply_likelihood(weight, scratch.log_likelihood)
    multiply_likelihood(memory.visit_weight[:count], scratch.log_likelihood)
    adapt_noise(memory, design, scratch)


@compiled
def update_all(memory: MixtureMemory, design: MixtureDesign, scratch: Scratch) -> None:
    """Advance all groups of active nodes by one block. Mix their states after a road change, apply
    the measurements, and predict to the block's end. Store the predictive log-likelihood of the
    mixture, and its NIS. The NIS is the squared innovation (measurement minus prediction) over its
    variance, averaged over the measurements.
    """
    features = scratch.features
    inflation = max(design.constants.physical.correlation_time / features.duration, 1.0)
    inflation *= slow_noise(fastest_speed(features, memory.overall_mean[NodeState.VX]))
    steady = design.constants.chosen.steady_share
    features.novelty = steady + (1.0 - steady) * features.new
    put_lanes(scratch.actual_lanes, 0, 0.0)
    put_lanes(scratch.theoretical_lanes, 0, 0.0)
    put_lanes(scratch.stated_lanes, 0, 0.0)
    put_lanes(scratch.square_lanes, 0, 0.0)
    turn = (math.cos(memory.block.angle), math.sin(memory.block.angle))
    groups = (active_nodes(memory) + LANES - 1) // LANES
    for group in range(groups):
        mix_nodes(memory, scratch, group)
        found = update_nodes(memory, design, scratch, group, inflation)
        cost = take_rolling(memory, design, scratch, group)
        put_lanes(scratch.log_likelihood, group, found.log_likelihood - cost)
        put_lanes(scratch.moved, group, found.moved)
        put_lanes(scratch.plain, group, found.plain)
        for axis in range(2):
            velocity = lanes_at(memory.mean, (group, axis))
            put_lanes(scratch.updated, (group, axis), velocity)
        predict_nodes(memory, scratch, group, turn)
    scratch.actual_sum = sum_lanes(lanes_at(scratch.actual_lanes, 0))
    scratch.theoretical_sum = sum_lanes(lanes_at(scratch.theoretical_lanes, 0))
    scratch.stated_sum = sum_lanes(lanes_at(scratch.stated_lanes, 0))
    squares = sum_lanes(lanes_at(scratch.square_lanes, 0))
    rows = 0
    for r in range(ROWS):
        rows += 1 if is_measured(features, r) else 0
    memory.log_likelihood = mixture_likelihood(scratch, groups) if rows > 0 else 0.0
    memory.nis = squares / rows if rows > 0 else 0.0


@compiled
def mixture_likelihood(scratch: Scratch, groups: int) -> float:
    """Return the log-likelihood [nat] of the measurements of the block under the whole mixture of
    friction hypotheses.
    """
    top = -math.inf
    for group in range(groups):
        awake = lanes_at(scratch.share, group) > 0.0
        plain = select(awake, lanes_at(scratch.plain, group), -math.inf)
        top = max(top, largest_lane(plain))
    total = 0.0
    for group in range(groups):
        likelihood = exp_lanes(lanes_at(scratch.plain, group) - top)
        total += sum_lanes(lanes_at(scratch.share, group) * likelihood)
    return top + math.log(total)


@compiled
def temper_evidence(memory: MixtureMemory, design: MixtureDesign, scratch: Scratch) -> None:
    """Weaken (temper) the log-likelihoods [nat] of all nodes in a block, and store them in
    scratch.log_likelihood.

    Each node's log-likelihood relative to that of the best node is multiplied by a factor from 0 to
    1. Fuzzy rules determine this factor, or a formula if the filter is not adaptive. A loss beyond
    `plausible_loss` counts in full. A node whose friction is below the grip in use gets a penalty
    that does not depend on the factor.

    All log-likelihoods become 0, so that no node gains probability, in three cases. (1) The
    consistency test (`trust.py`) has found that the measurements contradict the model. (2)
    Accelerations, yaw rate or steering are missing, so that sliding cannot be distinguished from
    rolling. (3) The car is too slow for a meaningful slip.
    """
    constants = design.constants
    features = scratch.features
    count = active_nodes(memory)
    best = -math.inf
    for j in range(count):
        best = max(best, scratch.log_likelihood[j])
    blind = memory.block.counts[S.AX] == 0 or math.isnan(features.side[0] + features.side[1])
    blind = blind or fastest_speed(features, memory.overall_mean[NodeState.VX]) < SLOWEST_M_S
    slid = memory.slip.held
    share = math.exp(
        evidence_share(design.rules, slid, features.demand, features.new, memory.trust.strain)
    )
    price = 1.0 - demand_weight(features.demand)
    used_share = used_evidence_share(memory.trust, constants)
    used_share += slid * (1.0 - memory.trust.distrust) * (1.0 - used_share)
    for j in range(count):
        loss = scratch.log_likelihood[j] - best
        beyond = min(loss + constants.guards.plausible_loss, 0.0)
        loss = max(loss, -constants.guards.plausible_loss)
        loss = max(used_share * (share * loss + beyond), -constants.guards.largest_loss)
        loss -= used_share * guard_penalty(memory.grip, constants, design.sides.mu[j])
        scratch.log_likelihood[j] = 0.0
        if not blind:
            charged = charge_penalty(memory, j, used_share * price * scratch.moved[j])
            scratch.log_likelihood[j] = loss - charged


@compiled
def charge_penalty(memory: MixtureMemory, node: int, price: float) -> float:
    """Return the amount [nat] by which the log-likelihood of a node must be reduced in this block.
    Add this amount to the node's total, memory.penalty[node].

    `price` [nat] grows with the distance by which the block has moved the node's vehicle states
    away from their prior. It is negative if the states have moved back. The result is then a
    refund, which is at most the total charged before. Probability that a node has since got from
    other nodes was never charged (`apply_road_change`).

    Reason: the evidence of a block is weakened, but its measurements change the vehicle states in
    full. Without the charge, a wrong low friction would remain probable on drives with little grip
    demand. An improbable stiffness or sensor offset would make up for the wrong friction.
    """
    charged = max(price, -memory.penalty[node])
    memory.penalty[node] += charged
    return float(charged)


@compiled
def update_novelty(
    memory: MixtureMemory, design: MixtureDesign, features: BlockFeatures, vx: float, vy: float
) -> None:
    """Compute two fuzzy truth values, 0 to 1: features.new ("forces or slips have just changed")
    and memory.slip.axle_ended ("a slide of an axle has ended").

    features.new is large if forces or slips differ from their usual values, which are moving
    averages over the last seconds. The function also updates these averages. (vx, vy) [m/s] is the
    mean velocity in the block.
    """
    constants = design.constants
    keep = math.exp(-features.duration / constants.chosen.window)
    force = 0.0
    slip = 0.0
    slides = 0.0
    for r in range(6):
        now = features.force[r] if r < 4 else features.side[r - 4]
        force = max(force, advance_usual(memory.usual_force, r, now, keep))
    drift = slip_drift(memory, constants, vx)
    for wheel in range(4):
        now = wheel_slip(memory, features, vx, wheel)
        # A bump makes a wheel turn faster for an instant; only a change that lasts is new.
        sudden = features.abrupt_noise[wheel] / constants.physical.abrupt_share**2
        noise = math.sqrt(sudden + features.slip_noise[wheel] + drift * drift)
        slip = max(slip, advance_usual(memory.usual_slip, wheel, now, keep) - noise)
    for axle in range(2):
        now = axle_slip(memory.row, features, vx, vy, axle)
        slip = max(slip, advance_usual(memory.usual_slip, 4 + axle, now, keep))
        slides = max(slides, saturation(now, memory.friction.median))
    change = max(force, slip)
    features.new = change**2 / (change**2 + constants.chosen.steady_half**2)
    slides *= slippery_probability(memory, design)
    held = memory.slip.axle_held * math.exp(-features.duration / UTILISED_WINDOW_S)
    memory.slip.axle_held = max(slides, held)
    steady = min(max(2.0 - 2.0 * force / max(features.demand, TINY), 0.0), 1.0)
    memory.slip.axle_ended = (memory.slip.axle_held - slides) * steady


@compiled
def saturation(slip: float, mu: float) -> float:
    """Return the degree, 0 to 1, to which an axle slides on a road with friction `mu` [1].

    `slip` is expressed as the force over load [1] that a tyre of constant stiffness would have at
    this slip. The degree is 0 up to a slip of mu, 1 above a slip of 1.5 mu, and linear between
    them. It is 0 if the slip is NaN (unknown).
    """
    return 0.0 if math.isnan(slip) else min(max(2.0 * (abs(slip) / mu - 1.0), 0.0), 1.0)


@compiled
def advance_usual(usual: FloatArray, i: int, now: float, keep: float) -> float:
    """Return the absolute difference between the current value `now` of a quantity and its moving
    average usual[i]. Then update the average: `keep` is the weight of the old average, 1 - keep
    that of `now`. Return 0 if `now` is NaN.
    """
    if math.isnan(now):
        return 0.0
    deviation = abs(now - usual[i])
    usual[i] = keep * usual[i] + (1.0 - keep) * now
    return float(deviation)


@compiled
def wheel_slip(memory: MixtureMemory, features: BlockFeatures, vx: float, wheel: int) -> float:
    """Return the longitudinal slip of a wheel at the speed `vx` [m/s] of the car; NaN without a
    reading of the wheel speed. Slip is expressed as the force over load [1] that a tyre of constant
    stiffness would have at this slip.
    """
    faster = wheel_speed(memory, features, wheel) - vx
    return float(memory.row[Parameter.SLOPE_X] * faster / max(abs(vx), SLOWEST_SLIP_M_S))


@compiled
def slip_drift(memory: MixtureMemory, constants: Constants, vx: float) -> float:
    """Return the standard deviation of the change of slip, within the time of its moving average,
    that an unknown offset of a_x and the unknown slope of the road explain. The unit is that of
    `wheel_slip`. `vx` is the speed of the car [m/s].
    """
    variance = memory.overall_covariance
    bias = NodeState.BIAS_X
    slope = NodeState.SLOPE
    offset = variance[bias, bias] + variance[slope, slope] + 2.0 * variance[slope, bias]
    gained = constants.chosen.window * math.sqrt(max(offset, 0.0))
    return float(memory.row[Parameter.SLOPE_X] * gained / max(abs(vx), SLOWEST_SLIP_M_S))


@compiled
def axle_slip(row: FloatArray, features: BlockFeatures, vx: float, vy: float, axle: int) -> float:
    """Return the lateral slip of an axle at the velocity (vx, vy) [m/s]; NaN if its lateral force
    is unknown. Slip is expressed as the force over load [1] that a tyre of constant stiffness would
    have at this slip.
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
    """Update the actual and expected variance of the axles' innovations, averaged over the latest
    blocks (of 0.05 s each). Compute from them the factor on the axles' measurement noise R for the
    next block.

    R of the wheels is not adapted: a slide also makes their innovations large, and a larger R would
    hide it. It follows from the measured vibration of the wheel speeds instead.
    """
    if scratch.theoretical_sum <= 0.0:
        return
    keep = math.exp(-scratch.features.duration / design.constants.chosen.window)
    memory.actual = keep * memory.actual + (1.0 - keep) * scratch.actual_sum
    memory.theoretical = keep * memory.theoretical + (1.0 - keep) * scratch.theoretical_sum
    if design.adaptive:
        memory.factor = adapted_factor(
            memory.factor,
            memory.actual,
            memory.theoretical,
            design.fuzzy_inputs,
            design.fuzzy_outputs,
        )
