"""Filter of one node: a cubature Kalman filter of the vehicle, given the friction under its left
and right wheels.

Legend
    m, L        mean (n,) and square root of the covariance, L*L' = P          (n, n)
    A           measurement deviations in the axes of L's columns              (6, ACTIVE)
    f, a        row of A that is applied, and its variance f'f + r^2
    D           derivative of the rows by a state that they depend on linearly

The measurement rows are nonlinear only in velocity and stiffness. Therefore the third-degree
cubature rule is applied in these four dimensions. The rows are linear in the other states: leak
(gravity that a tilted accelerometer measures), steering error, shape of the tyre curve and gain of
torque. These enter exactly, by the derivative D (a Rao-Blackwellised rule). Rows are applied one
after the other (Potter 1963): L <- L*(I - g*f*f'), with g such that no covariance is ever
subtracted.
"""

from __future__ import annotations

import math
from typing import NamedTuple

from edge_agent.dynamics.slip import SLOWEST_M_S
from edge_agent.estimators.friction_mixture.node.residuals import (
    correct_forces,
    find_residuals,
    find_shape_force,
    find_slips,
    gained_velocity,
    slope_along,
)
from edge_agent.estimators.friction_mixture.state.constants import (
    ACTIVE,
    CURVED,
    ROWS,
    STATES,
    STRAIGHT,
    Constants,
    NodeState,
)
from edge_agent.estimators.friction_mixture.state.design import MixtureDesign, Nominal
from edge_agent.estimators.friction_mixture.state.memory import MixtureMemory, Trust
from edge_agent.estimators.friction_mixture.state.tyre_curve import TyreCurve
from edge_agent.estimators.friction_mixture.state.workspace import (
    BlockFeatures,
    NodeWorkspace,
    Scratch,
)
from edge_agent.filters.cholesky import covariance_of_factor
from edge_agent.filters.sequential import apply_projection, potter_factors
from schemas.numeric import FloatArray
from schemas.runtime.jit import compiled

REAR_ROWS = (2, 3, 5)
DOUBTED = 0.05  # of distrust_noise, at the brink of it


class NodeUpdate(NamedTuple):
    """Result of the measurement update of one node (friction hypothesis): its log-likelihood, the
    number of measurement rows (scalar measurements) used, and the terms from which the weights of
    all nodes and the penalties are computed.
    """

    log_likelihood: float  # with the inflated R and the price of sliding [nat]
    moved: float  # change of `belief_cost` [nat]
    plain: float  # log-likelihood with the plain R, rows taken as independent [nat]
    square: float  # normalised innovation squared with the plain R
    rows: int


@compiled
def update_node(
    memory: MixtureMemory, design: MixtureDesign, scratch: Scratch, j: int, inflation: float
) -> NodeUpdate:
    """Run the cubature update of node j (friction hypothesis) with the measurement noise R times
    `inflation`. The update changes the node's mean and scratch.root[j].

    The noise of the axles' rows is increased further if these rows contradict the model, and while
    the inputs are steady. With steady inputs, errors of the tyre curve and of offsets repeat from
    block to block; if they were treated as noise, the filter would average them into stiffness and
    shape.

    The function also stores each innovation (measurement minus prediction), and its expected
    variance without `inflation`.
    """
    constants = design.constants
    nominal = memory.nominal
    features = scratch.features
    node = scratch.node
    mean = memory.mean[j]
    root = scratch.root[j]
    innovation = scratch.innovation[j]
    theoretical = scratch.theoretical[j]
    node.gained.x, node.gained.y = gained_velocity(features.gain, mean)
    price = linearize_node(memory, design, scratch, j)
    spread_points(memory, design, scratch, j)
    across = inflation * doubted_noise(memory.trust, constants) / features.novelty
    unlike = rear_noise(memory, constants)
    plain = square = 0.0
    for r in range(ROWS):
        innovation[r] = -node.residual[r]
        noise = node.noise[r]
        variance = node.nonlinearity[r]
        for column in range(ACTIVE):
            variance += node.deviation[r, column] ** 2
        theoretical[r] = variance + noise
        excess = node.residual[r] ** 2 / constants.huber**2 - variance
        factor = inflation if r < 4 else across
        if r in REAR_ROWS:
            factor *= unlike
        node.inflated[r] = max(noise * factor, excess) + node.nonlinearity[r] + node.abrupt[r]
        if not math.isnan(node.residual[r]):
            ratio = node.residual[r] ** 2 / theoretical[r]
            square += ratio
            plain -= 0.5 * (ratio + math.log(2.0 * math.pi * theoretical[r]))
    for r in range(ROWS):
        node.residual[r] = innovation[r]
    before = belief_cost(mean, nominal)
    loss, used = take_rows(mean, root, node, constants.axle_penalty)
    keep_within(mean, constants, nominal)
    moved = belief_cost(mean, nominal) - before
    return NodeUpdate(
        -loss - constants.sliding_penalty / inflation * price, moved, plain, square, used
    )


@compiled
def linearize_node(memory: MixtureMemory, design: MixtureDesign, scratch: Scratch, j: int) -> float:
    """For node j (friction hypothesis) at its mean state, compute node.force (tyre forces over
    load) and node.derivative (of the measurement rows by the linear states). Return the penalty
    [nat] for sliding wheels.

    The leak (gravity in a_y when the body rolls) and the offset of a_y change the same forces.
    Therefore the derivative by the one is computed from the derivative by the other.
    """
    constants = design.constants
    curve = design.curve
    side_mu = design.sides.mu[j]
    row = memory.row
    mean = memory.mean[j]
    features = scratch.features
    node = scratch.node
    price = 0.0
    all_torques = True
    for wheel in range(4):
        all_torques = all_torques and features.force_unit[wheel] == 0.0
    for i in range(STATES):
        node.point[i] = mean[i]
    for state in range(STRAIGHT, CURVED - 1, -1):  # at the mean, then with each moved, STEER last
        if state == NodeState.LEAK_Y or (state == NodeState.BIAS_X and all_torques):
            continue
        step = 0.0 if state == STRAIGHT else 0.5 * design.nominal.std[state]
        if state < STRAIGHT:
            node.point[state] += step
        if state == STRAIGHT or state == NodeState.STEER:
            find_slips(row, constants, mean, features, node)
        if state == STRAIGHT:
            find_shape_force(curve, side_mu, features, node)
            price = weigh_slopes(curve, side_mu, features, constants.sliding_slope, node)
        correct_forces(row, curve, side_mu, features, node)
        out = node.residual[:] if state == STRAIGHT else node.derivative[state]
        find_residuals(curve, side_mu, features, node, out)
        if state < STRAIGHT:
            node.point[state] -= step
            for r in range(ROWS):
                out[r] = (out[r] - node.residual[r]) / step
    _by_wheel_speeds(memory, design, scratch, j)
    derivative = node.derivative
    for r in range(ROWS):
        axle = r // 2 if r < 4 else r - 4
        across = -features.side_leak[axle] / features.side_unit[axle]
        derivative[NodeState.LEAK_Y, r] = (
            0.0 if math.isnan(across) else derivative[NodeState.BIAS_Y, r] * across
        )
        by_angle = derivative[NodeState.STEER, r]
        derivative[NodeState.LAG_STEER, r] = by_angle * features.steer_rate
        derivative[NodeState.STEER_GAIN, r] = by_angle * features.steering
        derivative[NodeState.COMPLIANCE, r] = (
            0.0 if math.isnan(features.side[0]) else -by_angle * features.side[0]
        )
        if all_torques:  # an offset of a_x is then no force
            derivative[NodeState.BIAS_X, r] = 0.0
    return price


@compiled
def _by_wheel_speeds(
    memory: MixtureMemory, design: MixtureDesign, scratch: Scratch, j: int
) -> None:
    """Compute the derivatives of the measurement rows by the four wheel radii, and by the time lag
    of the wheel speed signals.

    Each wheel's measurement row depends on the speed of this wheel. One evaluation with all four
    radii changed gives all derivatives, because the radii hardly change the rows of the axles.
    node.force, the force over load, must already be computed at the mean.
    """
    row = memory.row
    mean = memory.mean[j]
    side_mu = design.sides.mu[j]
    features = scratch.features
    node = scratch.node
    step = design.nominal.std[NodeState.RADIUS]
    for wheel in range(4):
        node.point[NodeState.RADIUS + wheel] = mean[NodeState.RADIUS + wheel] + step
    find_slips(row, design.constants, mean, features, node)
    correct_forces(row, design.curve, side_mu, features, node)
    by_lag = node.derivative[NodeState.LAG_WHEEL]
    find_residuals(design.curve, side_mu, features, node, by_lag)
    for wheel in range(4):
        node.point[NodeState.RADIUS + wheel] = mean[NodeState.RADIUS + wheel]
        by_radius = node.derivative[NodeState.RADIUS + wheel]
        for r in range(ROWS):
            by_radius[r] = 0.0
        by_radius[wheel] = (by_lag[wheel] - node.residual[wheel]) / step
        by_lag[wheel] = (
            by_radius[wheel] * features.change / max(abs(features.rolling[wheel]), SLOWEST_M_S)
        )
    by_lag[4] = by_lag[5] = 0.0


@compiled
def weigh_slopes(
    curve: TyreCurve, side_mu: FloatArray, features: BlockFeatures, flat: float, node: NodeWorkspace
) -> float:
    """Compute node.noise, the noise variances of the six measurement rows at the slips node.slip;
    return the penalty [nat] for sliding wheels.

    The penalty applies to wheels on the flat part of the curve: a sliding wheel may have any slip,
    so its probability density is low.
    """
    slip = node.slip
    price = 0.0
    for axle in range(2):
        across = 0.0
        for wheel in range(2 * axle, 2 * axle + 2):
            mu = side_mu[wheel % 2]
            g_x = slip.along[wheel]
            g_y = slip.across[wheel]
            along = slope_along(curve, g_x, g_y, mu)
            across += features.load_share[wheel] * slope_along(curve, g_y, g_x, mu)
            node.noise[wheel] = (
                features.noise_std[wheel] ** 2
                - slip_noise_correction(along) * features.slip_noise[wheel]
            )
            node.abrupt[wheel] = (0.5 - slip_noise_correction(along)) * features.abrupt_noise[wheel]
            if not math.isnan(features.rolling[wheel]):
                price -= min(math.log(along / flat), 0.0)
        side = 4 + axle
        node.noise[side] = (
            features.noise_std[side] ** 2
            - slip_noise_correction(across) * features.slip_noise[side]
        )
        node.abrupt[side] = 0.0
    return price


@compiled
def slip_noise_correction(slope: float) -> float:
    """Return one half minus the share of the slip noise variance that enters a residual, for a
    given slope of the tyre curve.

    A residual is the distance normal to the curve. On a line of slope k, the share k^2/(1 + k^2) of
    the slip noise enters it (errors in variables); at slope 1 this is one half, which
    features.noise_std already contains. A constant share would be too large on the flat part of the
    curve, where hardly any slip noise enters. It would favour nodes (friction hypotheses) by which
    the wheels slide.
    """
    return 0.5 - slope * slope / (1.0 + slope * slope)


@compiled
def spread_points(memory: MixtureMemory, design: MixtureDesign, scratch: Scratch, j: int) -> None:
    """Compute the predicted measurements at the cubature points (sample states) of node j, a
    friction hypothesis.

    Fill node.deviation (A), node.residual with the predicted rows, and node.nonlinearity with the
    variance caused by nonlinearity. scratch.root[j] is lower triangular.
    """
    row = memory.row
    mean = memory.mean[j]
    root = scratch.root[j]
    side_mu = design.sides.mu[j]
    features = scratch.features
    node = scratch.node
    scale = math.sqrt(CURVED)
    for r in range(ROWS):
        node.residual[r] = node.nonlinearity[r] = 0.0
    for column in range(CURVED):
        for sign in range(2):
            signed = scale if sign == 0 else -scale
            out = node.ahead[:] if sign == 0 else node.behind[:]
            for i in range(CURVED):
                node.point[i] = mean[i] + signed * root[i, column]
            find_slips(row, design.constants, mean, features, node)
            find_residuals(design.curve, side_mu, features, node, out)
        for r in range(ROWS):
            node.deviation[r, column] = 0.5 * (node.ahead[r] - node.behind[r]) / scale
            node.middle[column, r] = 0.5 * (node.ahead[r] + node.behind[r])
            node.residual[r] += node.middle[column, r] / CURVED
    for r in range(ROWS):
        for column in range(CURVED):
            node.nonlinearity[r] += (node.middle[column, r] - node.residual[r]) ** 2 / CURVED
        for column in range(CURVED, ACTIVE):
            node.deviation[r, column] = 0.0
        for state in range(CURVED, ACTIVE):
            by_state = node.derivative[state, r]
            for column in range(state + 1):
                node.deviation[r, column] += by_state * root[state, column]


@compiled
def doubted_noise(trust: Trust, constants: Constants) -> float:
    """Return the factor on the measurement noise R of the axles while the consistency test doubts
    the model.

    It grows with the evidence against the model, so that contradicting readings do not change the
    motion estimate.
    """
    if trust.distrust > 0.0:
        return 1.0 + constants.distrust_noise
    return 1.0 + DOUBTED * constants.distrust_noise * (trust.odd / constants.odd_least) ** 2


@compiled
def rear_noise(memory: MixtureMemory, constants: Constants) -> float:
    """Return the factor on R (measurement noise) of the rear axle's rows. It is above 1 while the
    front axle is already on another surface than the rear axle, because then one friction cannot
    explain both.
    """
    return constants.rear_unlike if memory.last.time < memory.slip.rear_unlike_until else 1.0


@compiled
def belief_cost(mean: FloatArray, nominal: Nominal) -> float:
    """Return the penalty [nat] for deviations of a node's vehicle and sensor states from their
    prior (a node is the filter of one friction hypothesis): half the sum of the squared deviations
    in standard deviations. `mean` has shape (n,).
    """
    total = 0.0
    for i in range(NodeState.LN_KX, mean.shape[0]):
        total += 0.5 * ((mean[i] - nominal.mean[i]) / nominal.std[i]) ** 2
    return total


@compiled
def take_rows(
    mean: FloatArray, root: FloatArray, node: NodeWorkspace, axle_penalty: float
) -> tuple[float, int]:
    """Update a node (friction hypothesis) with the innovations node.residual (6,), one measurement
    row after the other.

    Return (negative log-likelihood [nat] without constants, number of rows applied). The former is
    half of the normalised squared innovations, plus half of `axle_penalty`·ln(innovation variance)
    for each row of the axles.
    """
    loss = 0.0
    used = 0
    for r in range(ROWS):
        if math.isnan(node.residual[r]):
            continue
        used += 1
        variance, gain = potter_factors(node.deviation[r], node.inflated[r])
        step = node.residual[r] * (1.0 / variance)
        loss += 0.5 * node.residual[r] * step
        if r >= 4:
            loss += 0.5 * axle_penalty * math.log(variance)
        apply_projection(mean, root, node.deviation[r], step, gain)
        apply_projection(
            node.residual[r + 1 :], node.deviation[r + 1 :], node.deviation[r], -step, gain
        )
    return loss, used


@compiled
def keep_within(mean: FloatArray, constants: Constants, nominal: Nominal) -> None:
    """Limit the vehicle and sensor states in `mean` (n,) to their possible range.

    Only the ratios of the wheel radii are observable. A common error of all radii scales the speed,
    and no sensor here measures that scale. Therefore the mean of the radius errors is set to zero.
    """
    far = constants.farthest
    common = 0.0
    for wheel in range(4):
        common += 0.25 * mean[NodeState.RADIUS + wheel]
    for wheel in range(4):
        mean[NodeState.RADIUS + wheel] -= common
    for i in range(NodeState.LN_KX, mean.shape[0]):
        middle = nominal.mean[i]
        reach = far * nominal.std[i]
        mean[i] = min(max(mean[i], middle - reach), middle + reach)


@compiled
def predict_node(
    memory: MixtureMemory, scratch: Scratch, j: int, turn_cos: float, turn_sin: float
) -> None:
    """Predict the state of node j (friction hypothesis) to the end of the block (0.05 s): rotate
    the velocity by the yaw angle (given by its cosine and sine), add the velocity gained by
    acceleration, and add the process variances scratch.process.

    The prediction is affine, so cubature is exact: the covariance P becomes F*P*F' + diag(noise),
    where F is the matrix of the prediction. Vehicle and sensor states return to their prior by the
    factors scratch.keep. The function multiplies the covariance root scratch.root[j] by F.
    """
    nominal = memory.nominal
    keep = scratch.keep
    noise = scratch.process
    gain = memory.block.gain
    mean = memory.mean[j]
    root = scratch.root[j]
    covariance = memory.covariance[j]
    n = mean.shape[0]
    for k in range(n):
        column = root[:, k]
        vx = column[NodeState.VX]
        vy = column[NodeState.VY]
        gained_x, gained_y = gained_velocity(gain, column)
        column[NodeState.VX] = turn_cos * vx + turn_sin * vy + (gained_x - gain.measured.x)
        column[NodeState.VY] = turn_cos * vy - turn_sin * vx + (gained_y - gain.measured.y)
        for i in range(NodeState.LN_KX, n):
            column[i] *= keep[i]
    vx = mean[NodeState.VX]
    vy = mean[NodeState.VY]
    gained_x, gained_y = gained_velocity(gain, mean)
    mean[NodeState.VX] = turn_cos * vx + turn_sin * vy + gained_x
    mean[NodeState.VY] = turn_cos * vy - turn_sin * vx + gained_y
    for i in range(NodeState.LN_KX, n):
        mean[i] = nominal.mean[i] + keep[i] * (mean[i] - nominal.mean[i])
    covariance_of_factor(root, noise, covariance)
