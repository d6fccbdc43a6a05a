"""The measurement equations of one node (filter of one friction hypothesis): distances of slip and
force from the tyre curve, by total least squares.

Legend
    mu          friction of the node under the wheel's side [1]
    g_x, g_y    linear force over load, slope*stiffness factor*slip [1]
    theta       hypot(g_x, g_y)/mu, normalised slip
    e_b         force minus the tyre's force at the measured slip, over load [1]
    e_a         slip at the measured force by the inverse tyre, minus the measured slip, as linear
                force over load [1]
    e           sign(e_b)*|e_a*e_b|/sqrt(e_a^2 + e_b^2): distance to the tyre curve [1]

Rows: the longitudinal residuals of four wheels, then the lateral residuals of two axles. In the
linear range e weights slip and force equally. On the flat part and beyond the peak only the force
counts, so the row of a sliding wheel measures its friction (errata, what made the difference, 1).
An axle has one mean slip; its wheels share the lateral force in proportion to load. The states of a
node (gravity leaking into a_y, gain of torque, shape of the tyre) correct the measured force.
"""

from __future__ import annotations

import math

from edge_agent.dynamics.parameters import Parameter
from edge_agent.dynamics.slip import SLOWEST_M_S, wheel_position
from edge_agent.dynamics.tyres import TINY
from edge_agent.estimators.friction_mixture.state.constants import Constants, NodeState
from edge_agent.estimators.friction_mixture.state.memory import VelocityGain
from edge_agent.estimators.friction_mixture.state.tyre_curve import (
    TyreCurve,
    interpolate_table,
    ratio_at,
    theta_at,
)
from edge_agent.estimators.friction_mixture.state.workspace import BlockFeatures, NodeWorkspace
from schemas.numeric import FloatArray
from schemas.runtime.jit import compiled

# of its friction, that the slippery side gives before the other side takes the rest
SPLIT_LIMIT = 0.9
FLATTEST = 0.03  # a sliding wheel's slip is not quite arbitrary: its inertia holds it for a block


@compiled
def curve_distance(along: float, across: float) -> float:
    """Return the signed distance [1] of a measured point (slip, force) from the tyre curve: `along`
    is its distance along the slip axis, `across` its distance along the force axis.

    If `along` is infinite (the force exceeds the peak), return `across`.
    """
    if math.isinf(along):
        return across
    size = math.sqrt(along * along + across * across)
    return 0.0 if size < TINY else across * abs(along) / size


@compiled
def gained_velocity(gain: VelocityGain, x: FloatArray) -> tuple[float, float]:
    """Return the velocity (forward, left) [m/s] gained in the block (0.05 s), corrected by the
    states in x (n,): leak (gravity that tilted accelerometers measure), sensor offsets, and the
    road's slope and bank (lateral slope).

    An offset of a_y has the same effect as an offset of a_x, rotated by 90 degrees.
    """
    leak_y = x[NodeState.LEAK_Y]
    bias_x = x[NodeState.BIAS_X] + x[NodeState.SLOPE]
    bias_y = x[NodeState.BIAS_Y] + x[NodeState.BANK]
    measured = gain.measured
    unit = gain.unit
    return (
        measured.x - leak_y * gain.leak_y.x - bias_x * unit.x + bias_y * unit.y,
        measured.y - leak_y * gain.leak_y.y - bias_x * unit.y - bias_y * unit.x,
    )


@compiled
def slope_along(curve: TyreCurve, g_x: float, g_y: float, mu: float) -> float:
    """Return the derivative [1] of the tyre's longitudinal force by that of a linear tyre with the
    same slip.

    It is 1 at small slip, 0 on the flat part of the curve, and limited to at least FLATTEST.
    """
    square = g_x * g_x + g_y * g_y
    if square < TINY:
        return 1.0
    theta = math.sqrt(square) / mu
    u = theta / (1.0 + theta)
    return max(
        (interpolate_table(curve.slope, u) * g_x * g_x + ratio_at(curve, theta) * g_y * g_y)
        / square,
        FLATTEST,
    )


@compiled
def find_slips(
    row: FloatArray,
    constants: Constants,
    mean: FloatArray,
    features: BlockFeatures,
    node: NodeWorkspace,
) -> None:
    """Compute node.slip, the slips of wheels and axles, at node.point: a state of this node
    (friction hypothesis) at the beginning of the block (0.05 s).

    `mean` (n,) is the node's mean. Where the force is too small to distinguish stiffness from slip
    noise, the logarithm of stiffness in node.point is moved towards that of `mean`.
    """
    x = node.point
    slip = node.slip
    vx = features.cos * x[NodeState.VX] + features.sin * x[NodeState.VY] + node.gained.x
    vy = features.cos * x[NodeState.VY] - features.sin * x[NodeState.VX] + node.gained.y
    mean_kx = mean[NodeState.LN_KX]
    mean_ky = mean[NodeState.LN_KY]
    for axle in range(2):
        blind = math.isnan(
            features.side[axle]
        )  # slip across is then guesswork, and must not bend the force along
        offset = steering_offset(x, features) if axle == 0 and not blind else 0.0
        ln_kx = mean_kx + features.informs_x[axle] * (x[NodeState.LN_KX] - mean_kx)
        ln_ky = mean_ky + features.informs_y[axle] * (x[NodeState.LN_KY] - mean_ky)
        slope_x = row[Parameter.SLOPE_X] * math.exp(ln_kx)
        slope_y = row[Parameter.SLOPE_Y] * math.exp(ln_ky)
        slip.scale_x[axle] = math.exp(-constants.stiffness_power_x * ln_kx)
        slip.scale_y[axle] = math.exp(-constants.stiffness_power_y * ln_ky)
        for wheel in range(2 * axle, 2 * axle + 2):
            px, py = wheel_position(row, wheel)
            ahead = vx - py * features.yaw_rate
            left = vy + px * features.yaw_rate
            cos = features.steer_cos[wheel]
            sin = features.steer_sin[wheel]
            along = cos * ahead + sin * left
            across = cos * left - sin * ahead
            speed = max(abs(along), SLOWEST_M_S)
            rolling = features.rolling[wheel] * (1.0 + x[NodeState.RADIUS + wheel])
            rolling += x[NodeState.LAG_WHEEL] * features.change
            known = not math.isnan(rolling)
            slip.along[wheel] = (
                slope_x * (rolling - along) / speed if known else features.force[wheel]
            )
            slip.across[wheel] = 0.0 if blind else slope_y * (offset - across / speed)


@compiled
def steering_offset(x: FloatArray, features: BlockFeatures) -> float:
    """Return the true minus the measured steering angle of the front wheels [rad], positive to the
    left, for state x (n,).

    The difference includes the compliance of the front axle: steering column and bushings of
    production cars yield up to 35 mrad per g of lateral acceleration.
    """
    lagged = x[NodeState.STEER] + x[NodeState.LAG_STEER] * features.steer_rate
    return float(
        lagged
        + x[NodeState.STEER_GAIN] * features.steering
        - x[NodeState.COMPLIANCE] * features.side[0]
    )


@compiled
def find_shape_force(
    curve: TyreCurve, side_mu: FloatArray, features: BlockFeatures, node: NodeWorkspace
) -> None:
    """Compute node.shape_force: how much the force over load at the slips node.slip changes if the
    shape of the tyre curve changes by one standard deviation.

    side_mu (2,) is the friction under the left and right wheels.
    """
    slip = node.slip
    out = node.shape_force
    out[4] = out[5] = 0.0
    for wheel in range(4):
        mu = side_mu[wheel % 2]
        g_x = slip.along[wheel]
        g_y = slip.across[wheel]
        size = math.sqrt(g_x * g_x + g_y * g_y)
        theta = size / mu
        change = (
            0.0
            if size < TINY
            else mu * interpolate_table(curve.shape, theta / (1.0 + theta)) / size
        )
        out[wheel] = change * g_x
        out[4 + wheel // 2] += features.load_share[wheel] * change * g_y


@compiled
def correct_forces(
    row: FloatArray,
    curve: TyreCurve,
    side_mu: FloatArray,
    features: BlockFeatures,
    node: NodeWorkspace,
) -> None:
    """Compute node.force, the measured force over load, and node.slip_at_force, the slip that the
    tyre curve gives for it. Both are corrected by the filter states in node.point: leak (gravity in
    a_y when the body rolls), offsets, torque gain and curve shape.

    Without torque signals only the sum of the forces on both sides is measured. On a split road
    (different friction left and right) the slippery side is then assumed to take at most
    SPLIT_LIMIT of its friction, and the other side the rest. The unequal forces turn the car, and
    the lateral forces of the axles balance that moment.
    """
    leak = node.point[NodeState.LEAK_Y]
    shape = node.point[NodeState.SHAPE]
    gain = node.point[NodeState.GAIN]
    bias_x = node.point[NodeState.BIAS_X]
    bias_y = node.point[NodeState.BIAS_Y]
    force = node.force
    slip_at_force = node.slip_at_force
    moment = 0.0
    for wheel in range(4):
        along = (1.0 + gain) * features.force[wheel] - bias_x * features.force_unit[wheel]
        mu = side_mu[wheel % 2]
        other = side_mu[1 - wheel % 2]
        force[wheel] = along
        if other != mu and features.force_unit[wheel] != 0.0:
            force[wheel] = share_by_sides(along, SPLIT_LIMIT * mu, SPLIT_LIMIT * other)
            lever = wheel_position(row, wheel)[1] * features.steer_cos[wheel]
            moment -= lever * features.loads[wheel] * (force[wheel] - along)
    turning = moment / (row[Parameter.TO_FRONT] + row[Parameter.TO_REAR])
    for axle in range(2):
        left = 2 * axle
        right = 2 * axle + 1
        side = (
            features.side[axle]
            + leak * features.side_leak[axle]
            - bias_y * features.side_unit[axle]
        )
        load = (features.loads[left] + features.loads[right]) * features.steer_cos[left]
        side += (-turning if axle == 0 else turning) / load
        across = 0.0 if math.isnan(side) else side
        mean_along = mean_mu = 0.0
        for wheel in range(left, right + 1):
            mu = side_mu[wheel % 2]
            share = features.load_share[wheel]
            mean_along += share * force[wheel]
            mean_mu += share * mu
            force[wheel] -= shape * node.shape_force[wheel]
            slip_at_force[wheel] = _slip_at_force(curve, mu, force[wheel], across)
        force[4 + axle] = side - shape * node.shape_force[4 + axle]
        slip_at_force[4 + axle] = _slip_at_force(curve, mean_mu, force[4 + axle], mean_along)


@compiled
def share_by_sides(mean: float, most: float, most_other: float) -> float:
    """Return the force over load [1] of the wheel on one side of an axle, given the mean over both
    sides.

    The sides are equal until the slippery side reaches its limit.

    Args:
        mean: mean of both sides, signed [1].
        most: limit of this side [1].
        most_other: limit of the other side [1].
    """
    size = abs(mean)
    if most < most_other:
        return math.copysign(min(size, most), mean)
    return math.copysign(size + max(size - most_other, 0.0), mean)


@compiled
def _slip_at_force(curve: TyreCurve, mu: float, force: float, other: float) -> float:
    """Return the slip at which a tyre of friction `mu` has the force over load `force` [1] in one
    direction, while its force over load at right angles is `other` [1].

    The slip is given as the force over load [1] that a linear tyre would have at it; it is infinite
    at or beyond the peak of the curve.
    """
    size = math.sqrt(force * force + other * other)
    if math.isnan(size) or size < TINY:
        return force
    theta = theta_at(curve, size / mu)
    return math.copysign(math.inf, force) if math.isinf(theta) else mu * theta * force / size


@compiled
def find_residuals(
    curve: TyreCurve,
    side_mu: FloatArray,
    features: BlockFeatures,
    node: NodeWorkspace,
    out: FloatArray,
) -> None:
    """Compute out (6,): for each measurement row (four wheels, two axles), the distance [1] of the
    measured slip and force from the tyre curve; NaN if a reading is missing.
    """
    slip = node.slip
    force = node.force
    slip_at_force = node.slip_at_force
    for axle in range(2):
        side_model = side_slip = 0.0
        for wheel in range(2 * axle, 2 * axle + 2):
            g_x = slip.along[wheel]
            g_y = slip.across[wheel]
            theta = math.sqrt(g_x * g_x + g_y * g_y) / side_mu[wheel % 2]
            ratio = ratio_at(curve, theta)
            share = features.load_share[wheel]
            side_model += share * ratio * g_y
            side_slip += share * g_y
            out[wheel] = (
                math.nan
                if math.isnan(features.rolling[wheel])
                else slip.scale_x[axle]
                * curve_distance(slip_at_force[wheel] - g_x, force[wheel] - ratio * g_x)
            )
        row = 4 + axle
        out[row] = (
            math.nan
            if math.isnan(force[row])
            else slip.scale_y[axle]
            * curve_distance(slip_at_force[row] - side_slip, force[row] - side_model)
        )
