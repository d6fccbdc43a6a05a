"""Processing of one sample of one vehicle by the default estimator. The sample is added to the sums
of the block (the samples within 0.05 s). At the end of a block, one step of the friction mixture is
run.

The friction mixture consists of nodes. A node is one hypothesis about the friction, with a
probability and a filter that assumes this friction. A group is LANES nodes that the processor
computes together in vector registers. A step has three parts.

1. Road change: the friction may have changed during the block. Therefore part of the probability of
   each node moves to other nodes.
2. Filters, for each group: mix the state of each node with the state of the whole mixture according
   to the probability that has moved, apply the measurements at the state of the block's beginning,
   and predict to the block's end.
3. Mixture: update the node probabilities, adapt the axles' measurement noise R, and compute mean
   and covariance of the whole mixture.

Between the ends of blocks, the velocity is advanced by integrating the measured accelerations.
"""

from __future__ import annotations

import math

from edge_agent.dynamics.parameters import Parameter
from edge_agent.dynamics.tyres import TINY
from edge_agent.estimators import flags
from edge_agent.estimators.common.excitation import note_excitation
from edge_agent.estimators.common.motion import SLIDING_THETA
from edge_agent.estimators.friction_mixture.block.block_features import block_features
from edge_agent.estimators.friction_mixture.block.drive_split import learn_drive
from edge_agent.estimators.friction_mixture.block.grip_guard import lower_while_sliding
from edge_agent.estimators.friction_mixture.block.intake import begin_block, take_sample
from edge_agent.estimators.friction_mixture.block.relaxation import relax_slips
from edge_agent.estimators.friction_mixture.block.used_grip import used_grip
from edge_agent.estimators.friction_mixture.block.wheel_slip import update_slip
from edge_agent.estimators.friction_mixture.mixture.ice_patch import grow_patches
from edge_agent.estimators.friction_mixture.mixture.mixing import (
    apply_road_change,
    match_moments,
    share_weights,
    wake_or_sleep,
)
from edge_agent.estimators.friction_mixture.mixture.trust import (
    nominal_agreement,
    update_consistency,
)
from edge_agent.estimators.friction_mixture.mixture.weighing import (
    update_all,
    update_novelty,
    weigh_nodes,
)
from edge_agent.estimators.friction_mixture.node.residuals import gained_velocity
from edge_agent.estimators.friction_mixture.node.rolling_motion import watch_wheels
from edge_agent.estimators.friction_mixture.report.reported_interval import find_interval
from edge_agent.estimators.friction_mixture.restart import reset_to_wheel_speed, start_vehicle
from edge_agent.estimators.friction_mixture.state.constants import NODES, NodeState
from edge_agent.estimators.friction_mixture.state.design import MixtureDesign
from edge_agent.estimators.friction_mixture.state.gap import SLOWEST_M_S
from edge_agent.estimators.friction_mixture.state.memory import (
    MixtureMemory,
    Quantiles,
    VelocityGain,
)
from edge_agent.estimators.friction_mixture.state.split_sides import (
    BOTH,
    LEFT,
    RIGHT,
    project_weights,
)
from edge_agent.estimators.friction_mixture.state.workspace import Scratch
from schemas.numeric import FloatArray
from schemas.runtime.jit import compiled


@compiled
def step(
    memory: MixtureMemory, design: MixtureDesign, scratch: Scratch, time: float, sample: FloatArray
) -> int:
    """Process one sample (18,) of a vehicle at `time` [s] with the default estimator's filter.
    Return the health flags that belong to this sample only.
    """
    if not memory.started:
        return start_vehicle(memory, design, scratch, time, sample) | flags.RESET
    health, whole = take_sample(memory, design, time, sample)
    if whole:
        finish_block(memory, design, scratch)
    return health


@compiled
def finish_block(memory: MixtureMemory, design: MixtureDesign, scratch: Scratch) -> None:
    """Process the block that ends: run one step of the friction mixture (the filters of all
    friction hypotheses) with the sums over the block's samples. The next block begins at the time
    of the last sample.
    """
    features = scratch.features
    features.duration = memory.last.time - memory.block.time
    features.speed = abs(memory.overall_mean[NodeState.VX])
    health = block_features(memory, design, features)
    learn_drive(memory, design.constants, features)
    update_slip(memory, design.constants, features)
    vx, vy = turned_velocity(memory, features.gain, features.cos, features.sin)
    relax_slips(memory, design.constants, features, (vx, vy))
    update_novelty(memory, design, features, vx, vy)
    watch_wheels(memory, design.constants, features)
    wake_or_sleep(memory, design, scratch)
    apply_road_change(memory, design, scratch, features.speed * features.duration)
    grow_patches(memory, design, features.speed * features.duration)
    prepare_prediction(memory, design, scratch)
    update_all(memory, design, scratch)
    weigh_nodes(memory, design, scratch)
    share_weights(memory, scratch)
    match_moments(memory, scratch)
    memory.health = health | reset_to_wheel_speed(memory, design)
    ratio = scratch.actual_sum / max(scratch.stated_sum, TINY)
    update_consistency(memory, design, features.duration, ratio, memory.health)
    if memory.trust.distrust > 0.0:
        memory.health |= flags.CONTRADICTION
    conclude_friction(memory, design, scratch)
    begin_block(memory)


@compiled
def prepare_prediction(memory: MixtureMemory, design: MixtureDesign, scratch: Scratch) -> None:
    """Prepare the prediction over the block: compute the process variances of the states, and the
    factors by which vehicle and sensor states return to their prior.
    """
    block = memory.block
    constants = design.constants
    nominal = memory.nominal
    duration = scratch.features.duration
    process = scratch.process
    keep = scratch.keep
    process[NodeState.VX] = constants.physical.drift**2 * duration + block.missing_x
    unsure = constants.chosen.distrust_drift * memory.trust.distrust
    process[NodeState.VY] = (constants.physical.drift**2 + unsure**2) * duration + block.missing_y
    forgets = memory.trust.distrust / constants.chosen.distrust_forget
    speed = scratch.features.speed
    turning = abs(scratch.features.yaw_rate)
    for i in range(NodeState.LN_KX, nominal.mean.shape[0]):
        pace = 1.0 / nominal.time[i] + forgets
        if i in (NodeState.SLOPE, NodeState.BANK):
            # A road has another slope after `slope_length`; so has a car that turned by 1 rad.
            pace += max(speed / constants.physical.slope_length, turning)
        keep[i] = math.exp(-duration * pace)
        process[i] = nominal.std[i] ** 2 * (1.0 - keep[i] ** 2)


@compiled
def conclude_friction(memory: MixtureMemory, design: MixtureDesign, scratch: Scratch) -> None:
    """Compute the friction interval and the grip used in the last second, and store them in
    `memory`. Set the health flag SLIDING if a wheel spins or is locked, so that its normalised slip
    exceeds SLIDING_THETA.
    """
    _find_friction(memory, design, scratch)
    used = used_grip(memory, design.constants, scratch.features)
    note_excitation(memory.excitation, memory.last.time, used)
    if not memory.split:
        for friction in (memory.friction, memory.friction_left, memory.friction_right):
            friction.lower = lower_while_sliding(
                memory.slip.held,
                memory.excitation.largest,
                friction.lower,
                design.constants.physical.force_share,
            )
    vx = memory.overall_mean[NodeState.VX]
    speed = max(abs(vx), SLOWEST_M_S)
    for wheel in range(4):
        along = scratch.features.rolling[wheel] - vx
        if (
            memory.row[Parameter.SLOPE_X] * abs(along) / speed
            > SLIDING_THETA * memory.friction.median
        ):
            memory.health |= flags.SLIDING


@compiled
def _find_friction(memory: MixtureMemory, design: MixtureDesign, scratch: Scratch) -> None:
    """Compute median and 90 % interval of three frictions: under the left wheels, under the right
    wheels, and the mean of both.
    """
    if memory.split:
        _find_side(memory, design, scratch, LEFT, memory.friction_left)
        _find_side(memory, design, scratch, RIGHT, memory.friction_right)
        _find_side(memory, design, scratch, BOTH, memory.friction)
    else:
        agreement = nominal_agreement(memory.trust, design.constants)
        find_interval(
            design, memory.weight[:NODES], memory.patch, scratch.blended, agreement, memory.friction
        )
        for side in (memory.friction_left, memory.friction_right):
            both = memory.friction
            side.median = both.median
            side.lower = both.lower
            side.upper = both.upper


@compiled
def _find_side(
    memory: MixtureMemory, design: MixtureDesign, scratch: Scratch, side: int, friction: Quantiles
) -> None:
    project_weights(memory.weight, design.sides.share[side], scratch.projected)
    agreement = nominal_agreement(memory.trust, design.constants)
    find_interval(design, scratch.projected, memory.patch, scratch.blended, agreement, friction)


@compiled
def mean_velocity(memory: MixtureMemory) -> tuple[float, float]:
    """Return the current velocity (v_x, v_y) [m/s], the mean over all friction hypotheses."""
    block = memory.block
    return turned_velocity(memory, block.gain, math.cos(block.angle), math.sin(block.angle))


@compiled
def turned_velocity(
    memory: MixtureMemory, gain: VelocityGain, cos: float, sin: float
) -> tuple[float, float]:
    """Return the mean velocity (v_x, v_y) [m/s] of the mixture of filters at the current time, in
    the current vehicle axes.

    Since the block began, the vehicle has turned by the angle with cosine `cos` and sine `sin`, and
    has gained the velocity `gain`.
    """
    x = memory.overall_mean
    gained_x, gained_y = gained_velocity(
        gain,
        x[NodeState.LEAK_Y],
        x[NodeState.BIAS_X] + x[NodeState.SLOPE],
        x[NodeState.BIAS_Y] + x[NodeState.BANK],
    )
    return (
        cos * x[NodeState.VX] + sin * x[NodeState.VY] + gained_x,
        cos * x[NodeState.VY] - sin * x[NodeState.VX] + gained_y,
    )
