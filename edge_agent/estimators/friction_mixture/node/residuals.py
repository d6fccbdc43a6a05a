"""The measurement equations of one node (filter of one friction hypothesis): distances of slip and
force from the tyre curve, by total least squares.

Legend
    mu          friction of the node under the wheel's side [1]
    g_x, g_y    slips, given as the force over load of a linear tyre (constant stiffness):
                slope*stiffness factor*slip [1]
    theta       hypot(g_x, g_y)/mu, normalised slip
    e_b         measured force minus the force of the tyre curve at the measured slip, over load [1]
    e_a         slip of the tyre curve at the measured force, minus the measured slip; both slips
                given as for g_x [1]
    e           sign(e_b)*|e_a*e_b|/sqrt(e_a^2 + e_b^2): distance to the tyre curve [1]

There are six measurements ("rows"): the longitudinal residuals e of four wheels, then the lateral
residuals of two axles. In the linear range e weights slip and force equally. On the flat part and
beyond the peak, e depends only on the force. The force of a sliding wheel is friction times load,
so its residual measures the friction (errata, section "what made the difference", item 1).

An axle has one mean slip; its wheels share the lateral force in proportion to load. The states of a
node (gravity leaking into a_y, gain of torque, shape of the tyre) correct the measured force.

All functions compute a group of nodes at once (`schemas.runtime.lanes`).
"""

from __future__ import annotations

import math

from edge_agent.dynamics.body import locked_axle_force
from edge_agent.dynamics.parameters import Parameter
from edge_agent.dynamics.slip import SLOWEST_M_S, wheel_position
from edge_agent.dynamics.tyres import TINY
from edge_agent.estimators.friction_mixture.state.constants import ROWS, Constants, NodeState
from edge_agent.estimators.friction_mixture.state.memory import VelocityGain
from edge_agent.estimators.friction_mixture.state.tyre_curve import (
    TyreCurve,
    interpolate_table,
    ratio_at,
    theta_at,
)
from edge_agent.estimators.friction_mixture.state.workspace import (
    BlockFeatures,
    NodeForces,
    NodeSlip,
    NodeWorkspace,
)
from schemas.numeric import FloatArray
from schemas.runtime.jit import compiled, inlined
from schemas.runtime.lanes import (
    exp_lanes,
    inverse_of,
    inverse_root_of,
    lanes_at,
    put_lanes,
    select,
)

# [1] share of its friction that the slippery side uses at most; the other side carries the rest
SPLIT_LIMIT = 0.9
# [1] smallest slope of the tyre curve. It is above 0, because a wheel's inertia limits the change
# of its slip within a block.
FLATTEST = 0.03


@inlined
def is_measured(features: BlockFeatures, r: int) -> bool:
    """Return True if the readings that residual r needs are known. Residuals 0 to 3 belong to the
    wheels, 4 and 5 to the axles.
    """
    reading = features.rolling[r] if r < 4 else features.side[r - 4]
    return not math.isnan(reading)


@inlined
def curve_distance(along: float, across: float) -> float:
    """Return the signed distance [1] of a measured point (slip, force) from the tyre curve: `along`
    is its distance along the slip axis, `across` its distance along the force axis.

    If `along` is infinite (the force exceeds the peak), return `across`.
    """
    square = along * along + across * across
    distance = across * abs(along) * inverse_root_of(square)
    distance = select(square < TINY * TINY, 0.0, distance)
    return select(abs(along) == math.inf, across, distance)


@inlined
def gained_velocity(
    gain: VelocityGain, leak_y: float, bias_x: float, bias_y: float
) -> tuple[float, float]:
    """Return the velocity (forward, left) [m/s] that the vehicle gains in the block (0.05 s),
    integrated from the accelerometers.

    The velocity is corrected by the leak (share of a_y that is gravity felt by the rolled body) and
    by the sensor offsets [m/s^2], to which the slope and bank (lateral slope) of the road have been
    added. An offset of a_y has the same effect as an offset of a_x, rotated by 90 degrees.
    """
    measured = gain.measured
    unit = gain.unit
    return (
        measured.x - leak_y * gain.leak_y.x - bias_x * unit.x + bias_y * unit.y,
        measured.y - leak_y * gain.leak_y.y - bias_x * unit.y - bias_y * unit.x,
    )


@inlined
def gained_by(gain: VelocityGain, mean: FloatArray) -> tuple[float, float]:
    """Return the velocity (forward, left) [m/s] that the vehicle gains in the block, as each node
    of a group estimates it. `gain` is the integral of the accelerometers, and `mean` (n, LANES)
    contains the sensor offsets that the nodes assume.
    """
    return gained_velocity(
        gain,
        lanes_at(mean, NodeState.LEAK_Y),
        lanes_at(mean, NodeState.BIAS_X) + lanes_at(mean, NodeState.SLOPE),
        lanes_at(mean, NodeState.BIAS_Y) + lanes_at(mean, NodeState.BANK),
    )


@compiled
def find_readings(features: BlockFeatures, node: NodeWorkspace) -> None:
    """Compute the corrected wheel speeds (node.rolling) and the correction of the steering angle
    (node.steering). The corrections follow from the filter states in node.point, such as errors of
    the wheel radii and delays of the sensors.

    The steering correction includes the compliance of the front axle. Steering column and bushings
    of production cars yield up to 35 mrad per g of lateral acceleration.
    """
    x = node.point
    late = lanes_at(x, NodeState.LAG_WHEEL) * features.change
    for wheel in range(4):
        radius = 1.0 + lanes_at(x, NodeState.RADIUS + wheel)
        put_lanes(node.rolling, wheel, features.rolling[wheel] * radius + late)
    steering = lanes_at(x, NodeState.STEER)
    steering += lanes_at(x, NodeState.LAG_STEER) * features.steer_rate
    steering += lanes_at(x, NodeState.STEER_GAIN) * features.steering
    steering -= lanes_at(x, NodeState.COMPLIANCE) * features.side[0]
    put_lanes(node.steering, 0, steering)


@compiled
def find_slips(
    row: FloatArray,
    constants: Constants,
    mean: FloatArray,
    features: BlockFeatures,
    node: NodeWorkspace,
    slip: NodeSlip,
) -> None:
    """Compute the slips of the wheels from the velocity and stiffness in node.point, the states of
    each node at the beginning of the block.

    `mean` (n, LANES) are the nodes' means. Where the force is too small to distinguish stiffness
    from slip noise, the logarithm of stiffness in node.point is moved towards that of `mean`.
    """
    x = node.point
    ahead = lanes_at(x, NodeState.VX)
    left = lanes_at(x, NodeState.VY)
    vx = features.cos * ahead + features.sin * left + lanes_at(node.gained_x, 0)
    vy = features.cos * left - features.sin * ahead + lanes_at(node.gained_y, 0)
    mean_kx = lanes_at(mean, NodeState.LN_KX)
    mean_ky = lanes_at(mean, NodeState.LN_KY)
    for axle in range(2):
        # Without a measured lateral force the lateral slip is too uncertain to be used. It must not
        # change the longitudinal force.
        blind = math.isnan(features.side[axle])
        ln_kx = mean_kx + features.informs_x[axle] * (lanes_at(x, NodeState.LN_KX) - mean_kx)
        ln_ky = mean_ky + features.informs_y[axle] * (lanes_at(x, NodeState.LN_KY) - mean_ky)
        slope_x = row[Parameter.SLOPE_X] * exp_lanes(ln_kx)
        slope_y = row[Parameter.SLOPE_Y] * exp_lanes(ln_ky)
        put_lanes(slip.scale_x, axle, exp_lanes(-constants.chosen.stiffness_power_x * ln_kx))
        put_lanes(slip.scale_y, axle, exp_lanes(-constants.chosen.stiffness_power_y * ln_ky))
        for wheel in range(2 * axle, 2 * axle + 2):
            cos = features.steer_cos[wheel]
            sin = features.steer_sin[wheel]
            along = cos * vx + sin * vy + features.turn_along[wheel]
            across = cos * vy - sin * vx + features.turn_across[wheel]
            per_speed = inverse_of(max(abs(along), SLOWEST_M_S))
            if is_measured(features, wheel):
                faster = lanes_at(node.rolling, wheel) - along
                built = faster * per_speed + features.late_along[wheel]
                put_lanes(slip.along, wheel, slope_x * built)
            else:
                put_lanes(slip.along, wheel, features.force[wheel])
            if blind:
                put_lanes(slip.across, wheel, 0.0)
            else:
                offset = lanes_at(node.steering, 0) if axle == 0 else 0.0
                built = offset - across * per_speed + features.late_across[wheel]
                put_lanes(slip.across, wheel, slope_y * built)


@compiled
def find_ratios(
    curve: TyreCurve, features: BlockFeatures, node: NodeWorkspace, slip: NodeSlip
) -> None:
    """Compute the tyre forces at the slips in `slip` from the tyre curve, and write the results to
    `slip`.

    - slip.ratio, for each wheel: force divided by the force of a linear tyre at the same slip. The
      slip of a locked axle in a turn counts too.
    - slip.size and slip.place, for each wheel: total slip, and its position in the tables of the
      tyre curve.
    - slip.axle_force, for each axle: lateral force over load.
    - slip.axle_slip, for each axle: mean lateral slip of its wheels, weighted by load.
    """
    for axle in range(2):
        locked = features.locked_pull if axle == 1 else 0.0
        model = 0.0
        mean = 0.0
        for wheel in range(2 * axle, 2 * axle + 2):
            g_x = lanes_at(slip.along, wheel)
            g_y = lanes_at(slip.across, wheel)
            square = g_x * g_x + g_y * g_y + locked * locked
            size = square * inverse_root_of(square)
            theta = size * lanes_at(node.per_mu, wheel % 2)
            place = theta * inverse_of(1.0 + theta)
            ratio = ratio_at(curve, theta, place)
            put_lanes(slip.size, wheel, size)
            put_lanes(slip.place, wheel, place)
            put_lanes(slip.ratio, wheel, ratio)
            across = features.load_share[wheel] * g_y
            model += ratio * across
            mean += across
        put_lanes(slip.axle_force, axle, model)
        put_lanes(slip.axle_slip, axle, mean)


@compiled
def find_shape_force(curve: TyreCurve, features: BlockFeatures, node: NodeWorkspace) -> None:
    """Compute node.shape_force: how much the force over load at the slips node.slip changes if the
    tyre curve becomes sharper by one standard deviation of its shape.
    """
    slip = node.slip
    for axle in range(2):
        side = 0.0
        for wheel in range(2 * axle, 2 * axle + 2):
            size = lanes_at(slip.size, wheel)
            shape = interpolate_table(curve.shape, lanes_at(slip.place, wheel))
            change = lanes_at(node.mu, wheel % 2) * shape * inverse_of(size)
            change = select(size < TINY, 0.0, change)
            put_lanes(node.shape_force, wheel, change * lanes_at(slip.along, wheel))
            side += features.load_share[wheel] * change * lanes_at(slip.across, wheel)
        put_lanes(node.shape_force, 4 + axle, side)


@compiled
def correct_forces(
    row: FloatArray,
    curve: TyreCurve,
    features: BlockFeatures,
    node: NodeWorkspace,
    out: NodeForces,
) -> None:
    """Compute the measured force over load of each wheel and axle (out.force), and the slip at
    which the tyre curve gives this force (out.slip_at_force).

    The filter states in node.point correct the forces. These states are the leak (gravity in a_y
    when the body rolls), the sensor offsets, the torque gain and the curve shape.

    Without torque signals, only the sum of the longitudinal forces on both sides is measured. On a
    split road (different friction left and right), the function then divides the sum. The slippery
    side gets at most SPLIT_LIMIT of its friction, and the other side gets the rest. The unequal
    forces turn the car. Therefore the function also corrects the lateral forces of the axles, which
    balance this yaw moment. So do the forces of a locked rear axle, whose wheels pull forwards on
    one side and backwards on the other.
    """
    shape = lanes_at(node.point, NodeState.SHAPE)
    turning = _share_forces(row, features, node, out)
    held = (
        0.5 * features.locked_pull * (lanes_at(node.slip.ratio, 2) + lanes_at(node.slip.ratio, 3))
    )
    if features.locked_pull != 0.0:
        turning -= held * locked_axle_force(row, features.loads)
    for axle in range(2):
        locked_square = held * held if axle == 1 else 0.0 * held
        side = _correct_side(features, node, axle, -turning if axle == 0 else turning)
        known = is_measured(features, 4 + axle)
        across = side if known else 0.0
        mean_along = 0.0
        for wheel in range(2 * axle, 2 * axle + 2):
            along = lanes_at(out.force, wheel)
            mean_along += features.load_share[wheel] * along
            force = along - shape * lanes_at(node.shape_force, wheel)
            per_mu = lanes_at(node.per_mu, wheel % 2)
            mu = lanes_at(node.mu, wheel % 2)
            put_lanes(out.force, wheel, force)
            put_lanes(
                out.slip_at_force,
                wheel,
                _slip_at_force(curve, mu, per_mu, force, across * across + locked_square),
            )
        if known:
            force = side - shape * lanes_at(node.shape_force, 4 + axle)
            per_mu = lanes_at(node.per_axle_mu, axle)
            mu = lanes_at(node.axle_mu, axle)
            put_lanes(out.force, 4 + axle, force)
            other_square = mean_along * mean_along + locked_square
            found = _slip_at_force(curve, mu, per_mu, force, other_square)
            put_lanes(out.slip_at_force, 4 + axle, found)


@inlined
def _correct_side(features: BlockFeatures, node: NodeWorkspace, axle: int, balance: float) -> float:
    """Return the lateral force over load [1] of an axle, corrected for gravity in a_y when the body
    rolls, for the offset of a_y, and for `balance` [N], the lateral force that the axle exerts to
    balance the yaw moment of unequal forces left and right.
    """
    leak = lanes_at(node.point, NodeState.LEAK_Y)
    bias_y = lanes_at(node.point, NodeState.BIAS_Y)
    left = 2 * axle
    load = (features.loads[left] + features.loads[left + 1]) * features.steer_cos[left]
    side = features.side[axle] + leak * features.side_leak[axle] - bias_y * features.side_unit[axle]
    corrected: float = side + balance * (1.0 / load)
    return corrected


@inlined
def _share_forces(
    row: FloatArray, features: BlockFeatures, node: NodeWorkspace, out: NodeForces
) -> float:
    """Compute out.force, the longitudinal force over load of the four wheels. Return the lateral
    force of the front axle [N] that balances the yaw moment of unequal forces left and right.
    """
    gain = lanes_at(node.point, NodeState.GAIN)
    bias_x = lanes_at(node.point, NodeState.BIAS_X)
    moment = 0.0 * gain
    for wheel in range(4):
        along = (1.0 + gain) * features.force[wheel] - bias_x * features.force_unit[wheel]
        force = along
        if features.force_unit[wheel] != 0.0:
            mu = lanes_at(node.mu, wheel % 2)
            other = lanes_at(node.mu, 1 - wheel % 2)
            shared = share_by_sides(along, SPLIT_LIMIT * mu, SPLIT_LIMIT * other)
            force = select(mu == other, along, shared)
            lever = wheel_position(row, wheel)[1] * features.steer_cos[wheel]
            moment -= lever * features.loads[wheel] * (force - along)
        put_lanes(out.force, wheel, force)
    per_base: float = 1.0 / (row[Parameter.TO_FRONT] + row[Parameter.TO_REAR])
    return moment * per_base


@inlined
def share_by_sides(mean: float, most: float, most_other: float) -> float:
    """Return the force over load [1] of the wheel on one side of an axle, given the mean over both
    sides.

    Both sides carry the same force until the slippery side reaches its limit; the other side then
    carries the rest.

    Args:
        mean: mean of both sides, signed [1].
        most: limit of this side [1].
        most_other: limit of the other side [1].
    """
    size = abs(mean)
    compensated = size + max(size - most_other, 0.0)
    shared = select(most < most_other, min(size, most), compensated)
    return select(mean < 0.0, -shared, shared)


@inlined
def _slip_at_force(
    curve: TyreCurve, mu: float, per_mu: float, force: float, other_square: float
) -> float:
    """Return the slip in one direction at which a tyre of friction `mu` has two given forces over
    load [1]: `force` in this direction, and at right angles a force with the square `other_square`.

    The returned slip is multiplied by the stiffness at small slip [1], so that slip and force of a
    linear tyre are equal. It is infinite if the total force reaches or exceeds the grip. `per_mu`
    is 1/mu.
    """
    square = force * force + other_square
    per_size = inverse_root_of(square)
    theta = theta_at(curve, square * per_size * per_mu)
    slip = mu * theta * (force * per_size)
    slip = select(theta == math.inf, select(force < 0.0, -math.inf, math.inf), slip)
    return select(square < TINY * TINY, force, slip)


@compiled
def find_residuals(
    features: BlockFeatures, slip: NodeSlip, forces: NodeForces, out: FloatArray
) -> None:
    """Compute `out` (6, LANES): for each wheel (longitudinal) and then each axle (lateral), the
    distance [1] of the measured slip and force from the tyre curve; 0 if a reading is missing.
    """
    for r in range(ROWS):
        if not is_measured(features, r):
            put_lanes(out, r, 0.0)
            continue
        force = lanes_at(forces.force, r)
        slip_at_force = lanes_at(forces.slip_at_force, r)
        if r < 4:
            g = lanes_at(slip.along, r)
            model = lanes_at(slip.ratio, r) * g
            scale = lanes_at(slip.scale_x, r // 2)
        else:
            g = lanes_at(slip.axle_slip, r - 4)
            model = lanes_at(slip.axle_force, r - 4)
            scale = lanes_at(slip.scale_y, r - 4)
        put_lanes(out, r, scale * curve_distance(slip_at_force - g, force - model))
