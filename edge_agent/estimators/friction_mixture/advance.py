"""One sample of one vehicle: sums of the block, and at the block's end one turn of the mixture.

Order at the end of a block: road change per metre and re-injection, measurement update of every node at the state of
the block's beginning, reweighing with the evidence tempered by demand, adaptation of R, prediction to the block's end.
Between ends of blocks the velocity is carried on by the same exact kinematics.
"""

from __future__ import annotations

import math
from typing import Annotated, NamedTuple

from edge_agent.adaptation.fuzzy import adapted
from edge_agent.dynamics.parameters import P
from edge_agent.estimators import flags
from edge_agent.estimators.friction_mixture.arrays import clear_rows, put, put_square
from edge_agent.estimators.friction_mixture.block import F, block_features
from edge_agent.estimators.friction_mixture.constants import NODES, PAIRS, STATES, C, X
from edge_agent.estimators.friction_mixture.curve import Curve
from edge_agent.estimators.friction_mixture.memory import INPUTS, RING, H, Memory
from edge_agent.estimators.friction_mixture.mixture import moments, recall_lost, reinject
from edge_agent.estimators.friction_mixture.node import Nominal, Room, factorize, predict_node, update_node
from edge_agent.estimators.friction_mixture.nodes import Sides, change_road, projected, quantile, reweigh
from edge_agent.estimators.friction_mixture.residuals import ROWS, gained
from edge_agent.estimators.friction_mixture.sample import (
    fall_asleep,
    forget_vehicle,
    restart_motion,
    start,
    take_sample,
)
from schemas.numeric import FloatArray
from schemas.runtime.jit import compiled
from schemas.signals import S

SLIDING_THETA = 3.0  # normalised slip beyond the peak of every passenger tyre's curve
FREE_FORCE = 0.05  # along, over load, below which wheels that roll alike are taken for rolling freely
ALIKE = 0.03  # relative difference of their speeds
LOST_RATIO = 8.0  # of actual over nominal innovation variance in the window: no noise or curve does that
LOST_SPREAD_M_S = 5.0
SLOWEST_TOLD_M_S = 1.5  # below this speed of vehicle and wheels slip has no meaning, and nothing is concluded
EXCITED_S = 1.0  # memory of the grip used
TOLD = (int(H.LEFT), int(H.RIGHT), int(H.MU))  # where the friction of left, right and both is held


class Design(NamedTuple):
    """What does not change while driving: tables that the kernels read."""

    constants: Annotated[FloatArray, len(C)]
    mu: Annotated[FloatArray, NODES]  # nodes of one friction
    prior: Annotated[FloatArray, NODES]
    sides: Sides  # all nodes
    curve: Curve
    nominal: Nominal
    inputs: Annotated[FloatArray, 5]  # fuzzy sets
    outputs: Annotated[FloatArray, 5]
    scales: Annotated[FloatArray, 2]  # on nominal variances
    adaptive: bool


class Scratch:
    """Arrays that a kernel writes before it reads them: intermediate results of one block of one vehicle."""

    features: Annotated[FloatArray, F.LENGTH]
    loads: Annotated[FloatArray, 4]
    spin: Annotated[FloatArray, 4]
    innovation: Annotated[FloatArray, NODES + PAIRS, ROWS]
    theoretical: Annotated[FloatArray, NODES + PAIRS, ROWS]
    process: Annotated[FloatArray, STATES]
    keep: Annotated[FloatArray, STATES]
    gain: Annotated[FloatArray, 8]
    log_likelihood: Annotated[FloatArray, NODES + PAIRS]
    plain: Annotated[FloatArray, NODES + PAIRS]
    moved: Annotated[FloatArray, NODES + PAIRS]
    predicted: Annotated[FloatArray, NODES + PAIRS]
    sums: Annotated[FloatArray, 4]
    scales: Annotated[FloatArray, 2]
    root: Annotated[FloatArray, NODES + PAIRS, STATES, STATES]
    room: Room


@compiled
def finish_block(memory: Memory, design: Design, scratch: Scratch, row: FloatArray) -> None:
    """Close the block and begin the next at the same instant."""
    held, constants = memory.held, design.constants
    duration = held[H.TIME] - held[H.BLOCK_TIME]
    speed = abs(memory.all_mean[X.VX])
    scratch.scales[0] = design.scales[0] * memory.factor[0]
    scratch.scales[1] = design.scales[1] * memory.factor[1]
    health = block_features(
        row, constants, scratch.scales, held, memory.side, memory.gain_sum, memory.sums, memory.counts,
        memory.start_omega, memory.last_omega, memory.last_delta, duration, speed, scratch.loads,
        scratch.spin, scratch.features,
    )  # fmt: skip
    _wake_or_sleep(memory, design, scratch)
    _road(memory, design, scratch, speed * duration)
    _measure(memory, design, scratch, row, duration)
    _predict(memory, design, scratch, duration, speed)
    health |= _recover(memory, design, scratch, row)
    _conclude(memory, design, scratch, row, health)


@compiled
def taking_part(memory: Memory) -> int:
    """How many nodes are awake."""
    return NODES + PAIRS if memory.held[H.UNLIKE] > 0.0 else NODES


@compiled
def _wake_or_sleep(memory: Memory, design: Design, scratch: Scratch) -> None:
    """Nodes of unlike sides take part from the first sign of such a road until they have become improbable."""
    chain, weight, visit = design.mu.shape[0], memory.weight, memory.visit
    sign = scratch.features[F.UNLIKE] > design.constants[C.ASYMMETRY]
    if memory.held[H.UNLIKE] > 0.0:
        total = 0.0
        for j in range(chain, weight.shape[0]):
            total += weight[j]
        if total < 0.5 * design.constants[C.UNLIKE] and not sign:
            fall_asleep(memory, design.prior)
    elif sign:
        memory.held[H.UNLIKE] = 1.0
        for j in range(weight.shape[0]):
            if j < chain:
                weight[j] *= 1.0 - design.constants[C.UNLIKE]
                visit[j] *= 1.0 - design.constants[C.UNLIKE]
            else:
                weight[j] = visit[j] = design.sides.prior[j]
                memory.paid[j] = 0.0
                put(memory.mean[j], memory.all_mean)
                put_square(memory.covariance[j], memory.all_covariance)


@compiled
def _road(memory: Memory, design: Design, scratch: Scratch, metres: float) -> None:
    chain, count = design.mu.shape[0], taking_part(memory)
    prior = design.sides.prior[:count] if count > chain else design.prior[:count]
    hazard = 1.0 - math.exp(-metres * design.constants[C.HAZARD])
    leaving = 1.0 - math.exp(-metres * design.constants[C.UNLIKE_HAZARD])
    drift = min(metres * design.constants[C.DIFFUSION] * chain, 0.5)
    predicted, weight, visit = scratch.predicted[:count], memory.weight[:count], memory.visit[:count]
    change_road(visit, prior, chain, hazard, leaving, drift, predicted)
    put(visit, predicted)
    change_road(weight, prior, chain, hazard, leaving, drift, predicted)
    for j in range(count):
        zeta = min(hazard * prior[j] / predicted[j], 1.0)
        memory.paid[j] *= 1.0 - zeta
        reinject(memory.mean[j], memory.covariance[j], zeta, memory.all_mean, memory.all_covariance)
    put(weight, predicted)


@compiled
def _measure(memory: Memory, design: Design, scratch: Scratch, row: FloatArray, duration: float) -> None:
    """Update all nodes, reweigh, adapt, and note NIS and the predictive log-likelihood.

    Without accelerations, yaw rate or steering, sliding cannot be told from rolling: nothing is concluded on friction.
    """
    held, constants = memory.held, design.constants
    inflation = max(constants[C.CORRELATION] / duration, 1.0)
    count = taking_part(memory)
    for g in range(4):
        scratch.sums[g] = 0.0
    best = top = -math.inf
    nis = rows = 0.0
    for j in range(count):
        factorize(memory.covariance[j], scratch.root[j])
        loglik, scratch.moved[j], plain, square, used = update_node(
            row, constants, design.curve, design.nominal, design.sides.pair[j], memory.mean[j], scratch.root[j],
            scratch.features, inflation, scratch.innovation[j], scratch.theoretical[j], scratch.room,
        )  # fmt: skip
        scratch.log_likelihood[j], scratch.plain[j] = loglik, plain + math.log(memory.weight[j])
        best, top = max(best, loglik), max(top, scratch.plain[j])
        nis += memory.weight[j] * square
        rows = used
        for r in range(6):
            if not math.isnan(scratch.innovation[j, r]):
                group = 0 if r < 4 else 1
                scratch.sums[group] += memory.weight[j] * scratch.innovation[j, r] ** 2
                scratch.sums[2 + group] += memory.weight[j] * scratch.theoretical[j, r]
    total = 0.0
    for j in range(count):
        total += math.exp(scratch.plain[j] - top)
    held[H.LOG_LIKELIHOOD] = top + math.log(total) if rows > 0 else 0.0
    held[H.NIS] = nis / rows if rows > 0 else 0.0
    need = (constants[C.DEMAND_HALF] / max(scratch.features[F.DEMAND], 1e-3)) ** constants[C.DEMAND_POWER]
    blind = memory.counts[S.AX] == 0 or math.isnan(scratch.features[F.SIDE] + scratch.features[F.SIDE + 1])
    share = novelty(memory.usual, scratch.features, constants, duration) / (1.0 + need)
    moving = meaning(scratch.features, memory.all_mean[X.VX])
    for j in range(count):
        loss = scratch.log_likelihood[j] - best
        beyond = min(loss + constants[C.PLAUSIBLE], 0.0)
        loss = max(loss, -constants[C.PLAUSIBLE])
        loss = max(moving * (share * loss + beyond), -constants[C.LARGEST_LOSS])
        scratch.log_likelihood[j] = 0.0 if blind else loss - _owed(memory, j, need / (1.0 + need) * scratch.moved[j])
    recall_lost(memory.mean, scratch.root, memory.weight[:count], constants)
    reweigh(memory.weight[:count], scratch.log_likelihood)
    reweigh(memory.visit[:count], scratch.log_likelihood)
    keep = math.exp(-duration / constants[C.WINDOW])
    for group in range(2):
        if scratch.sums[2 + group] > 0.0:
            memory.actual[group] = keep * memory.actual[group] + (1.0 - keep) * scratch.sums[group]
            memory.theoretical[group] = keep * memory.theoretical[group] + (1.0 - keep) * scratch.sums[2 + group]
            if design.adaptive:
                memory.factor[group] = adapted(
                    memory.factor[group], memory.actual[group], memory.theoretical[group],
                    design.inputs, design.outputs,
                )  # fmt: skip


@compiled
def _owed(memory: Memory, node: int, price: float) -> float:
    """Price [nat] of what a node has come to believe of the vehicle; what it takes back is at most what it has paid.

    Tempered evidence has charged it in part only, while its state has moved by all that was measured: on gentle drives
    a low friction would else live on a stiffness or an offset three spreads from what is known, and hardly pay.
    """
    owed = max(price, -memory.paid[node])
    memory.paid[node] += owed
    return float(owed)


@compiled
def meaning(features: FloatArray, vx: float) -> float:
    """Share of the evidence that slip is worth at low speed: none when creeping, all from twice that speed on."""
    fastest = abs(vx)
    for wheel in range(4):
        if not math.isnan(features[F.ROLL + wheel]):
            fastest = max(fastest, abs(features[F.ROLL + wheel]))
    return min(max(fastest / SLOWEST_TOLD_M_S - 1.0, 0.0), 1.0)


@compiled
def _recover(memory: Memory, design: Design, scratch: Scratch, row: FloatArray) -> int:
    """Begin the motion and the friction anew where freely rolling wheels have long contradicted them.

    A wheel without force rolls: if all nodes call it sliding, none finds back by itself, for the curve is flat there.
    """
    expected = memory.theoretical[0]
    if memory.actual[0] * memory.factor[0] < LOST_RATIO * expected:
        return 0
    least, most = math.inf, -math.inf
    for wheel in range(4):
        if abs(scratch.features[F.FORCE + wheel]) > FREE_FORCE:
            return 0
        if not math.isnan(scratch.features[F.ROLL + wheel]):
            least, most = min(least, scratch.features[F.ROLL + wheel]), max(most, scratch.features[F.ROLL + wheel])
    turning = abs(scratch.features[F.YAW_RATE]) * row[P.TRACK_REAR]
    if most - least > ALIKE * max(most, SLOWEST_TOLD_M_S) + turning:
        return 0
    forget_vehicle(memory, design.nominal)  # what was learned while lost is as wrong as the motion was
    restart_motion(memory, most if most >= 0.0 else math.nan, LOST_SPREAD_M_S)
    for group in range(2):
        memory.actual[group] = memory.theoretical[group]
        memory.factor[group] = 1.0
    fall_asleep(memory, design.prior)
    for j in range(design.prior.shape[0]):
        memory.weight[j] = memory.visit[j] = design.prior[j]
    return flags.RESET


@compiled
def novelty(usual: FloatArray, features: FloatArray, constants: FloatArray, duration: float) -> float:
    """Share of the evidence that is new: forces against their smoothed past `usual` (6,), moved on by a block."""
    keep = math.exp(-duration / constants[C.STEADY_TIME])
    most = 0.0
    for r in range(6):
        force = features[F.FORCE + r] if r < 4 else features[F.SIDE + r - 4]
        if not math.isnan(force):
            most = max(most, abs(force - usual[r]))
            usual[r] = keep * usual[r] + (1.0 - keep) * force
    least = constants[C.STEADY_SHARE]
    return float(least + (1.0 - least) * most * most / (most * most + constants[C.STEADY_HALF] ** 2))


@compiled
def _predict(memory: Memory, design: Design, scratch: Scratch, duration: float, speed: float) -> None:
    held, constants, nominal = memory.held, design.constants, design.nominal
    ax = abs(held[H.AX])
    drift_x = constants[C.DRIFT_X] ** 2 + (constants[C.LEAK_WANDER] * ax) ** 2 + held[H.MISSING_AX]
    drift_y = constants[C.DRIFT_Y] ** 2 + (constants[C.GYRO_WANDER] * speed) ** 2 + held[H.MISSING_AY]
    scratch.process[X.VX], scratch.process[X.VY] = drift_x * duration, drift_y * duration
    for i in range(X.LN_KX, nominal.mean.shape[0]):
        scratch.keep[i] = math.exp(-duration / nominal.time[i])
        scratch.process[i] = nominal.std[i] ** 2 * (1.0 - scratch.keep[i] ** 2)
    for k in range(8):
        scratch.gain[k] = memory.gain[k // 2, k % 2]
    cos, sin = math.cos(held[H.ANGLE]), math.sin(held[H.ANGLE])
    count = taking_part(memory)
    for j in range(count):
        predict_node(
            memory.mean[j], scratch.root[j], nominal, cos, sin, scratch.gain, scratch.keep, scratch.process,
            memory.covariance[j],
        )  # fmt: skip
    moments(memory.mean, memory.covariance, memory.weight[:count], memory.all_mean, memory.all_covariance)


@compiled
def tell_friction(memory: Memory, design: Design, scratch: Scratch) -> None:
    """Quantiles of the mean friction and of both sides."""
    held, chain = memory.held, design.mu.shape[0]
    unlike = taking_part(memory) > chain
    for side in range(3):
        place = TOLD[side]
        weight = memory.weight[:chain]
        if unlike:
            weight = scratch.predicted[:chain]
            projected(memory.weight, design.sides.share[side], weight)
        for k, level in enumerate((0.5, 0.05, 0.95)):
            if unlike or side == 0:
                held[place + k] = quantile(design.mu, design.prior, weight, level)
            else:
                held[place + k] = held[H.LEFT + k]


@compiled
def _conclude(memory: Memory, design: Design, scratch: Scratch, row: FloatArray, health: int) -> None:
    """Friction, grip used in the last second, health; and the next block begins."""
    held = memory.held
    tell_friction(memory, design, scratch)
    place = int(held[H.RING_NEXT])
    memory.ring_time[place], memory.ring_used[place] = held[H.TIME], scratch.features[F.DEMAND]
    held[H.RING_NEXT] = (place + 1) % RING
    used = 0.0
    for k in range(RING):
        if memory.ring_time[k] > held[H.TIME] - EXCITED_S:
            used = max(used, memory.ring_used[k])
    held[H.USED] = used
    speed = max(abs(memory.all_mean[X.VX]), 1.0)
    for wheel in range(4):
        along = scratch.features[F.ROLL + wheel] - memory.all_mean[X.VX]
        if row[P.SLOPE_X] * abs(along) / speed > SLIDING_THETA * held[H.MU]:
            health |= flags.SLIDING
    held[H.HEALTH] = health
    begin_block(memory)


@compiled
def begin_block(memory: Memory) -> None:
    """Empty the sums; the block begins at the last sample."""
    held = memory.held
    held[H.BLOCK_TIME] = held[H.TIME]
    for k in range(H.ANGLE, H.SAMPLES + 1):
        held[k] = 0.0
    clear_rows(memory.gain)
    clear_rows(memory.gain_sum)
    held[H.MISSING_AX] = held[H.MISSING_AY] = 0.0
    held[H.START_YAW_RATE] = held[H.YAW_RATE]
    for c in range(INPUTS):
        memory.sums[c] = 0.0
        memory.counts[c] = 0
    for wheel in range(4):
        memory.start_omega[wheel] = memory.last_omega[wheel]


@compiled
def step(memory: Memory, design: Design, scratch: Scratch, row: FloatArray, time: float, sample: FloatArray) -> int:
    """Take one sample (18,); returns health flags of this sample alone."""
    if not memory.started:
        return start(memory, design.nominal, design.mu, design.prior, row, time, sample) | flags.RESET
    health, whole = take_sample(memory, design.constants, design.prior, row, time, sample)
    if whole:
        finish_block(memory, design, scratch, row)
    return health


@compiled
def velocity(memory: Memory) -> tuple[float, float]:
    """(v_x, v_y) [m/s] of the mixture now."""
    x, gain = memory.all_mean, memory.gain.ravel()
    cos, sin = math.cos(memory.held[H.ANGLE]), math.sin(memory.held[H.ANGLE])
    return (
        cos * x[X.VX] + sin * x[X.VY] + gained(gain, 0, x, 0),
        cos * x[X.VY] - sin * x[X.VX] + gained(gain, 0, x, 1),
    )
