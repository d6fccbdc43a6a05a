"""Filters of a group of nodes (friction hypotheses) that are computed together. Each is a cubature
Kalman filter of the vehicle, for given friction under its left and right wheels.

Legend
    m, P        mean (n,) and covariance (n, n) of the states
    L           first CURVED columns of the lower-triangular factor of P        (n, CURVED)
    B           column k: change of the measurements if the states move by column k of L,
                computed at the cubature points; node.curved is B'              (6, CURVED)
    D           derivatives of the measurements by the states that enter linearly, 0 for the others;
                node.derivative is D'                                           (6, n)
    h           covariance of the states with the measurements                  (n, 6)
    S           covariance of the measurements without noise                    (6, 6)

The six measurements (four wheels, two axles) are nonlinear in only four states: two velocities and
two stiffnesses. Therefore the third-degree cubature rule is applied in these four dimensions. The
measurements are linear in the other states, such as steering error, gain of torque and leak
(gravity that a tilted accelerometer measures). For the linear states the derivative D is exact, so
no cubature points are needed (a Rao-Blackwellised rule).

The covariances are h = L*B' + P*D' and S = B*(B + D*L)' + D*h. The update applies one scalar
measurement at a time, so that the noise of each may differ from node to node.
"""

from __future__ import annotations

import math
from typing import NamedTuple

from edge_agent.estimators.friction_mixture.block.wheel_slip import sliding_degree
from edge_agent.estimators.friction_mixture.node.covariance import (
    factorize_first,
    predict_covariance,
)
from edge_agent.estimators.friction_mixture.node.linearization import linearize_nodes
from edge_agent.estimators.friction_mixture.node.residuals import (
    find_ratios,
    find_residuals,
    find_slips,
    gained_by,
    is_measured,
)
from edge_agent.estimators.friction_mixture.node.row_vectors import (
    add_row,
    multiply_row,
    put_row,
    scale_row,
)
from edge_agent.estimators.friction_mixture.state.constants import (
    ACTIVE,
    CURVED,
    ROWS,
    STATES,
    Constants,
    NodeState,
)
from edge_agent.estimators.friction_mixture.state.design import MixtureDesign, Nominal
from edge_agent.estimators.friction_mixture.state.memory import MixtureMemory, Trust
from edge_agent.estimators.friction_mixture.state.workspace import (
    BlockFeatures,
    NodeWorkspace,
    Scratch,
)
from schemas.numeric import FloatArray
from schemas.runtime.jit import compiled, inlined
from schemas.runtime.lanes import lanes_at, log_lanes, put_lanes

REAR_ROWS = (2, 3, 5)  # measurements of the rear wheels and of the rear axle
# [1] share of `distrust_noise` that applies just before the model counts as contradicted
DOUBTED = 0.05


class NodeUpdate(NamedTuple):
    """Result of the measurement update of a group of nodes: for each node its log-likelihood, and
    the terms from which node weights and penalties are computed.
    """

    log_likelihood: float  # [nat] with the inflated R, minus the penalty for sliding
    moved: float  # [nat] change of `belief_cost`
    plain: float  # [nat] log-likelihood before inflation, for independent measurements


@compiled
def update_nodes(
    memory: MixtureMemory, design: MixtureDesign, scratch: Scratch, group: int, inflation: float
) -> NodeUpdate:
    """Run the cubature update of a group of nodes with the measurement noise R times `inflation`.
    The update changes mean and covariance of the nodes.

    The function also adds the innovations (measurement minus prediction), weighted by the nodes'
    probabilities, to the sums from which R is adapted.
    """
    features = scratch.features
    node = scratch.node
    mean = memory.mean[group]
    covariance = memory.covariance[group]
    put_friction(design, features, node, group)
    gained_x, gained_y = gained_by(features.gain, mean)
    put_lanes(node.gained_x, 0, gained_x)
    put_lanes(node.gained_y, 0, gained_y)
    price = linearize_nodes(memory.row, design, mean, features, node)
    factorize_first(covariance, node.root)
    spread_points(memory.row, design, mean, features, node, sliding_degree(memory))
    find_covariances(covariance, node)
    plain = weigh_rows(memory, design, scratch, lanes_at(scratch.share, group), inflation)
    before = belief_cost(mean, memory.nominal)
    weight = features.novelty * certain_share(memory, inflation)
    loss = take_rows(features, mean, covariance, node, weight)
    keep_within(mean, design.constants, memory.nominal)
    moved = belief_cost(mean, memory.nominal) - before
    price *= design.constants.chosen.freedom_penalty / inflation
    return NodeUpdate(-loss - price, moved, plain)


@compiled
def put_friction(
    design: MixtureDesign, features: BlockFeatures, node: NodeWorkspace, group: int
) -> None:
    """Write to `node` the friction that each node (hypothesis) of a group assumes on each side of
    the car and under each axle, and its inverse.
    """
    for side in range(2):
        mu = lanes_at(design.sides.lanes, (group, side))
        put_lanes(node.mu, side, mu)
        put_lanes(node.per_mu, side, 1.0 / mu)
    for axle in range(2):
        mu = features.load_share[2 * axle] * lanes_at(node.mu, 0)
        mu += features.load_share[2 * axle + 1] * lanes_at(node.mu, 1)
        put_lanes(node.axle_mu, axle, mu)
        put_lanes(node.per_axle_mu, axle, 1.0 / mu)


@compiled
def weigh_rows(
    memory: MixtureMemory,
    design: MixtureDesign,
    scratch: Scratch,
    share: float,
    inflation: float,
) -> float:
    """Compute the innovation of the six measurements and its variance with increased noise. Return
    the log-likelihood [nat] of the measurements without any increase of their noise R.

    The function increases R for these reasons:

    - Errors are correlated over several blocks (of 0.05 s). Therefore R is multiplied by
      `inflation`.
    - The innovation is an outlier.
    - Only axles: the measurements contradict the model.
    - Only axles: the inputs are steady. Errors of the tyre curve and of offsets then repeat from
      block to block. With a small R, the filter would adapt stiffness and shape of the tyres to
      them.
    - Only at the rear: the front axle is already on another surface.

    The axles' squared innovations and their variances without the increase are added to the sums of
    the block, weighted by the nodes' probabilities `share`.
    """
    constants = design.constants
    features = scratch.features
    node = scratch.node
    across = inflation * doubted_noise(memory.trust, constants) / features.novelty
    rear_factor = rear_noise(memory, constants)
    surplus = 1.0 - 1.0 / features.axle_scale
    squares = 0.0 * share
    product = 1.0 + squares
    for r in range(ROWS):
        if not is_measured(features, r):
            continue
        residual = lanes_at(node.residual, r)
        noise = lanes_at(node.noise, r)
        curvature = lanes_at(node.nonlinearity, r)
        variance = lanes_at(node.spread, (r, r)) + curvature
        total = variance + noise
        excess = residual * residual * (1.0 / constants.guards.huber**2) - variance
        factor = inflation if r < 4 else across
        if r in REAR_ROWS:
            factor *= rear_factor
        inflated = max(noise * factor, excess) + curvature + lanes_at(node.abrupt, r)
        put_lanes(node.residual, r, -residual)
        spread = lanes_at(node.spread, (r, r)) + inflated
        put_lanes(node.spread, (r, r), spread)
        squares += residual * residual / total
        product *= 2.0 * math.pi * total
        if r >= 4:
            _add_lanes(scratch.actual_lanes, share * residual * residual)
            _add_lanes(scratch.theoretical_lanes, share * total)
            _add_lanes(scratch.stated_lanes, share * (total - surplus * noise))
    _add_lanes(scratch.square_lanes, share * squares)
    return -0.5 * (squares + log_lanes(product))


@inlined
def _add_lanes(sums: FloatArray, value: float) -> None:
    put_lanes(sums, 0, lanes_at(sums, 0) + value)


@compiled
def spread_points(
    row: FloatArray,
    design: MixtureDesign,
    mean: FloatArray,
    features: BlockFeatures,
    node: NodeWorkspace,
    slides: float,
) -> None:
    """Evaluate the residuals of the six measurements at the cubature points (sample states around
    the mean) of a group of nodes.

    The results for each residual are:

    - node.residual: mean over the points. For wheels, the more they slide (`slides`, 0 to 1), the
      more it stays the residual at the mean state. Beyond its peak the tyre curve is almost flat.
      The points between there and the peak would raise the mean force in each block, although
      earlier blocks have excluded these states. The estimated speed would then increase.
    - node.curved: for each column of node.root, change of the residual if the states move by this
      column. node.root is the first columns of the lower-triangular factor of the covariance.
    - node.nonlinearity: variance caused by nonlinearity.
    """
    scale = math.sqrt(CURVED)
    slip = node.moved_slip
    for column in range(CURVED):
        for sign in range(2):
            signed = scale if sign == 0 else -scale
            out = node.ahead if sign == 0 else node.behind
            for i in range(CURVED):
                moved = lanes_at(mean, i) + signed * lanes_at(node.root, (i, column))
                put_lanes(node.point, i, moved)
            find_slips(row, design.constants, mean, features, node, slip)
            find_ratios(design.curve, features, node, slip)
            find_residuals(features, slip, node.forces, out)
        for r in range(ROWS):
            ahead = lanes_at(node.ahead, r)
            behind = lanes_at(node.behind, r)
            put_lanes(node.curved, (column, r), (0.5 / scale) * (ahead - behind))
            put_lanes(node.middle, (column, r), 0.5 * (ahead + behind))
    for r in range(ROWS):
        centre = 0.0
        for column in range(CURVED):
            centre += lanes_at(node.middle, (column, r)) * (1.0 / CURVED)
        nonlinearity = 0.0
        for column in range(CURVED):
            deviation = lanes_at(node.middle, (column, r)) - centre
            nonlinearity += deviation * deviation * (1.0 / CURVED)
        at_mean = slides if r < 4 else 0.0
        residual = at_mean * lanes_at(node.residual, r) + (1.0 - at_mean) * centre
        put_lanes(node.residual, r, residual)
        put_lanes(node.nonlinearity, r, nonlinearity)


@compiled
def find_covariances(covariance: FloatArray, node: NodeWorkspace) -> None:
    """Compute node.cross, the covariance of the states with each of the six measurements, and
    node.spread, the covariance of the measurements with each other.
    """
    derivative = node.derivative
    for i in range(STATES):
        total = scale_row(node.curved, 0, lanes_at(node.root, (i, 0)))
        for column in range(1, CURVED):
            total = add_row(total, node.curved, column, lanes_at(node.root, (i, column)))
        for state in range(CURVED, min(i + 1, ACTIVE)):
            total = add_row(total, derivative, state, lanes_at(covariance, (i, state)))
        for state in range(max(i + 1, CURVED), ACTIVE):
            total = add_row(total, derivative, state, lanes_at(covariance, (state, i)))
        put_row(node.cross, i, total)
    for column in range(CURVED):
        total = scale_row(node.curved, column, 1.0)
        for state in range(CURVED, ACTIVE):
            total = add_row(total, derivative, state, lanes_at(node.root, (state, column)))
        put_row(node.whole, column, total)
    for r in range(ROWS):
        total = scale_row(node.whole, 0, lanes_at(node.curved, (0, r)))
        for column in range(1, CURVED):
            total = add_row(total, node.whole, column, lanes_at(node.curved, (column, r)))
        for state in range(CURVED, ACTIVE):
            total = add_row(total, node.cross, state, lanes_at(derivative, (state, r)))
        put_row(node.spread, r, total)


@compiled
def doubted_noise(trust: Trust, constants: Constants) -> float:
    """Return the factor by which the measurement noise R of the axles is multiplied when
    measurements contradict the model.

    It grows with the evidence against the model, so that contradicting readings do not change the
    motion estimate.
    """
    if trust.distrust > 0.0:
        return 1.0 + constants.chosen.distrust_noise
    return (
        1.0
        + DOUBTED * constants.chosen.distrust_noise * (trust.odd / constants.chosen.odd_least) ** 2
    )


@compiled
def rear_noise(memory: MixtureMemory, constants: Constants) -> float:
    """Return the factor by which the measurement noise R of the rear axle is multiplied. It is
    above 1 while the front axle is already on another surface, because then no single friction
    explains both axles.
    """
    return constants.chosen.rear_unlike if memory.last.time < memory.slip.rear_unlike_until else 1.0


@compiled
def belief_cost(mean: FloatArray, nominal: Nominal) -> float:
    """Return the penalty [nat] of each node for deviations of its vehicle and sensor states from
    their prior. It is half the sum of the squared deviations, in standard deviations. `mean` has
    shape (n, LANES).
    """
    total = 0.0
    for i in range(NodeState.LN_KX, mean.shape[0]):
        deviation = (lanes_at(mean, i) - nominal.mean[i]) * (1.0 / nominal.std[i])
        total += deviation * deviation
    return 0.5 * total


@compiled
def take_rows(
    features: BlockFeatures,
    mean: FloatArray,
    covariance: FloatArray,
    node: NodeWorkspace,
    weight: float,
) -> float:
    """Update the filters of a group of nodes with the innovations node.residual, one scalar
    measurement at a time. node.spread is the covariance of the innovations.

    Return the negative log-likelihood [nat] without constants: half of the normalised squared
    innovations, plus half of `weight`·ln(innovation variance) for each measurement of an axle.

    This logarithm favours nodes that predict a force exactly: those whose tyres slide. Its weight
    is 1 for independent blocks. Correlated errors, and unchanged forces, reduce it as they reduce
    the other evidence, and so do innovations below their stated variance (`certain_share`).
    Otherwise the friction would approach the grip in use in each long turn.
    """
    squares = 0.0 * lanes_at(node.residual, 0)
    product = 1.0 + squares
    for r in range(ROWS):
        if not is_measured(features, r):
            put_lanes(node.gain, r, 0.0)
            continue
        variance = lanes_at(node.spread, (r, r))
        per = 1.0 / variance
        innovation = lanes_at(node.residual, r)
        step = innovation * per
        squares += innovation * step
        if r >= 4:
            product *= variance
        put_lanes(node.gain, r, per)
        for i in range(STATES):
            put_lanes(mean, i, lanes_at(mean, i) + lanes_at(node.cross, (i, r)) * step)
        _condition_rows(node, r, per)
    _subtract_rows(covariance, node)
    return 0.5 * (squares + weight * log_lanes(product))


@inlined
def _condition_rows(node: NodeWorkspace, r: int, per: float) -> None:
    """Correct the remaining measurements, those after measurement r, for the fact that the filter
    has already used measurement r.

    Their innovations (node.residual), the covariances of these innovations (node.spread) and their
    covariances with the states (node.cross) become those given measurement r. `per` is the inverse
    of the innovation variance of measurement r.
    """
    for q in range(r + 1, ROWS):
        share = lanes_at(node.spread, (q, r)) * per
        innovation = lanes_at(node.residual, q) - share * lanes_at(node.residual, r)
        put_lanes(node.residual, q, innovation)
        for p in range(r + 1, q + 1):
            left = lanes_at(node.spread, (q, p)) - share * lanes_at(node.spread, (p, r))
            put_lanes(node.spread, (q, p), left)
        for i in range(STATES):
            left = lanes_at(node.cross, (i, q)) - share * lanes_at(node.cross, (i, r))
            put_lanes(node.cross, (i, q), left)


@inlined
def _subtract_rows(covariance: FloatArray, node: NodeWorkspace) -> None:
    """Reduce the state covariances P of a group of nodes by the information of all measurements:
    subtract the sum of h*h'*gain over the measurements.

    For each measurement, h (n,) is its covariance with the states (in node.cross). gain is the
    inverse of its innovation variance (in node.gain), or 0 if the measurement is missing.
    """
    for i in range(STATES):
        for r in range(ROWS):
            put_lanes(node.scaled, (0, r), lanes_at(node.cross, (i, r)) * lanes_at(node.gain, r))
        scaled = scale_row(node.scaled, 0, 1.0)
        for j in range(i + 1):
            left = lanes_at(covariance, (i, j)) - multiply_row(scaled, node.cross, j)
            put_lanes(covariance, (i, j), left)


@compiled
def certain_share(memory: MixtureMemory, inflation: float) -> float:
    """Return the share of ln(innovation variance) of the axles that counts as evidence.

    It is 1 / `inflation` for errors that are correlated over several blocks. If the innovations of
    the last second are smaller still than their variance, which includes the largest changes of
    slope, bank and offsets, it is the ratio of their squares to this variance. With more, nodes
    would lose probability only because their variance is too large.
    """
    share = 1.0 / inflation
    if memory.theoretical > 0.0:
        share = min(share, memory.actual / memory.theoretical)
    return share


@compiled
def keep_within(mean: FloatArray, constants: Constants, nominal: Nominal) -> None:
    """Limit the vehicle and sensor states in `mean` (n, LANES) to a range around their prior. The
    range is `constants.guards.farthest` standard deviations on each side.

    The function also subtracts the mean of the four wheels' radius errors from each of them. Only
    the ratios of the radii are observable: a common error scales the speed, and no sensor here
    measures that scale.
    """
    far = constants.guards.farthest
    common = 0.0
    for wheel in range(4):
        common += 0.25 * lanes_at(mean, NodeState.RADIUS + wheel)
    for wheel in range(4):
        i = NodeState.RADIUS + wheel
        put_lanes(mean, i, lanes_at(mean, i) - common)
    for i in range(NodeState.LN_KX, mean.shape[0]):
        middle = nominal.mean[i]
        reach = far * nominal.std[i]
        put_lanes(mean, i, min(max(lanes_at(mean, i), middle - reach), middle + reach))


@compiled
def predict_nodes(
    memory: MixtureMemory, scratch: Scratch, group: int, turn: tuple[float, float]
) -> None:
    """Predict the states of a group of nodes to the end of the block (0.05 s). The velocity is
    rotated by the yaw angle (cosine and sine `turn`), the velocity gained by acceleration is added,
    and the variances grow by scratch.process.

    The prediction is affine, so cubature is exact. Vehicle and sensor states return to their prior
    by the factors scratch.keep.
    """
    nominal = memory.nominal
    keep = scratch.keep
    mean = memory.mean[group]
    cos, sin = turn
    vx = lanes_at(mean, NodeState.VX)
    vy = lanes_at(mean, NodeState.VY)
    gained_x, gained_y = gained_by(memory.block.gain, mean)
    put_lanes(mean, NodeState.VX, cos * vx + sin * vy + gained_x)
    put_lanes(mean, NodeState.VY, cos * vy - sin * vx + gained_y)
    for i in range(NodeState.LN_KX, STATES):
        deviation = lanes_at(mean, i) - nominal.mean[i]
        put_lanes(mean, i, nominal.mean[i] + keep[i] * deviation)
    covariance = memory.covariance[group]
    gain = memory.block.gain
    predict_covariance(covariance, scratch.node.turned, gain, turn, keep, scratch.process)
