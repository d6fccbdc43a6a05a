"""Linearisation of the six measurement equations (rows: four wheels, two axles) of a group of nodes
(friction hypotheses) at their means. The result is the noise of the rows, and their derivatives by
the linear states.

The linear states are those in which the rows are linear or nearly linear, such as sensor offsets,
steering error and wheel radii. The rows are nonlinear in the two velocities and the two tyre
stiffnesses. For these four states, `node_filter` evaluates the rows at cubature points instead.
"""

from __future__ import annotations

import math

from edge_agent.dynamics.slip import SLOWEST_M_S
from edge_agent.dynamics.tyres import TINY
from edge_agent.estimators.friction_mixture.node.residuals import (
    FLATTEST,
    correct_forces,
    find_ratios,
    find_readings,
    find_residuals,
    find_shape_force,
    find_slips,
    is_measured,
)
from edge_agent.estimators.friction_mixture.state.constants import (
    ROWS,
    STATES,
    STRAIGHT,
    NodeState,
)
from edge_agent.estimators.friction_mixture.state.design import MixtureDesign
from edge_agent.estimators.friction_mixture.state.tyre_curve import TyreCurve, interpolate_table
from edge_agent.estimators.friction_mixture.state.workspace import BlockFeatures, NodeWorkspace
from schemas.numeric import FloatArray
from schemas.runtime.jit import compiled, inlined
from schemas.runtime.lanes import inverse_of, lanes_at, log_lanes, put_lanes, select


@compiled
def linearize_nodes(
    row: FloatArray,
    design: MixtureDesign,
    mean: FloatArray,
    features: BlockFeatures,
    node: NodeWorkspace,
) -> float:
    """Linearise the measurement equations (rows) of a group of nodes at their `mean` (n, LANES).
    Compute tyre forces over load, residuals, noise, and node.derivative, the derivatives of the
    rows by the linear states. Return the penalty [nat] that each node gets for sliding wheels.

    The leak (gravity in a_y when the body rolls) and the offset of a_y change the same forces.
    Therefore the derivative by the leak is a multiple of the derivative by the offset.
    """
    constants = design.constants
    for i in range(STATES):
        put_lanes(node.point, i, lanes_at(mean, i))
    find_readings(features, node)
    find_slips(row, constants, mean, features, node, node.slip)
    find_ratios(design.curve, features, node, node.slip)
    find_shape_force(design.curve, features, node)
    price = weigh_slopes(design.curve, features, constants.chosen.sliding_slope, node)
    correct_forces(row, design.curve, features, node, node.forces)
    find_residuals(features, node.slip, node.forces, node.residual)
    _differentiate_forces(row, design, mean, features, node)
    _differentiate_steering(row, design, mean, features, node)
    _differentiate_speeds(row, design, mean, features, node)
    return price


@compiled
def _differentiate_forces(
    row: FloatArray,
    design: MixtureDesign,
    mean: FloatArray,
    features: BlockFeatures,
    node: NodeWorkspace,
) -> None:
    """Compute the derivatives of the measurement rows (residuals of wheels and axles) by the states
    that correct the measured forces.
    """
    all_torques = True
    for wheel in range(4):
        all_torques = all_torques and features.force_unit[wheel] == 0.0
    derivative = node.derivative
    for state in range(NodeState.SHAPE, STRAIGHT):
        out = derivative[state]
        if state == NodeState.BIAS_X and all_torques:  # no force is then computed from a_x
            for r in range(ROWS):
                put_lanes(out, r, 0.0)
            continue
        step = 0.5 * design.nominal.std[state]
        put_lanes(node.point, state, lanes_at(mean, state) + step)
        correct_forces(row, design.curve, features, node, node.moved_forces)
        put_lanes(node.point, state, lanes_at(mean, state))
        find_residuals(features, node.slip, node.moved_forces, out)
        _divide_by_step(node, out, step)
    for r in range(ROWS):
        axle = r // 2 if r < 4 else r - 4
        across = -features.side_leak[axle] / features.side_unit[axle]
        by_bias = lanes_at(derivative, (NodeState.BIAS_Y, r))
        known = not math.isnan(across)
        put_lanes(derivative, (NodeState.LEAK_Y, r), by_bias * (across if known else 0.0))


@inlined
def _divide_by_step(node: NodeWorkspace, out: FloatArray, step: float) -> None:
    """Turn the residuals `out` (6, LANES), computed with one state changed by `step`, into
    derivatives by this state: their difference from node.residual, divided by `step`.
    """
    per_step = 1.0 / step
    for r in range(ROWS):
        put_lanes(out, r, (lanes_at(out, r) - lanes_at(node.residual, r)) * per_step)


@compiled
def _differentiate_steering(
    row: FloatArray,
    design: MixtureDesign,
    mean: FloatArray,
    features: BlockFeatures,
    node: NodeWorkspace,
) -> None:
    """Compute the derivatives of the measurement rows by the states that change the
    steering angle.
    """
    step = 0.5 * design.nominal.std[NodeState.STEER]
    derivative = node.derivative
    out = derivative[NodeState.STEER]
    steering = lanes_at(node.steering, 0)
    put_lanes(node.steering, 0, steering + step)
    find_slips(row, design.constants, mean, features, node, node.moved_slip)
    put_lanes(node.steering, 0, steering)
    find_ratios(design.curve, features, node, node.moved_slip)
    find_residuals(features, node.moved_slip, node.forces, out)
    _divide_by_step(node, out, step)
    compliance = 0.0 if math.isnan(features.side[0]) else -features.side[0]
    for r in range(ROWS):
        by_angle = lanes_at(out, r)
        put_lanes(derivative, (NodeState.LAG_STEER, r), by_angle * features.steer_rate)
        put_lanes(derivative, (NodeState.STEER_GAIN, r), by_angle * features.steering)
        put_lanes(derivative, (NodeState.COMPLIANCE, r), by_angle * compliance)


@compiled
def _differentiate_speeds(
    row: FloatArray,
    design: MixtureDesign,
    mean: FloatArray,
    features: BlockFeatures,
    node: NodeWorkspace,
) -> None:
    """Compute the derivatives of the measurement rows by the four wheel radii, and by the time lag
    of the wheel speed signals.

    The row of a wheel depends on the speed of this wheel only, and the rows of the axles hardly
    depend on the radii. Therefore one evaluation with all four radii changed gives all derivatives.
    """
    step = design.nominal.std[NodeState.RADIUS]
    by_lag = node.derivative[NodeState.LAG_WHEEL]
    for wheel in range(4):
        longer = lanes_at(node.rolling, wheel) + features.rolling[wheel] * step
        put_lanes(node.rolling, wheel, longer)
    find_slips(row, design.constants, mean, features, node, node.moved_slip)
    find_readings(features, node)
    find_ratios(design.curve, features, node, node.moved_slip)
    find_residuals(features, node.moved_slip, node.forces, by_lag)
    _divide_by_step(node, by_lag, step)
    for wheel in range(4):
        by_radius = node.derivative[NodeState.RADIUS + wheel]
        for r in range(ROWS):
            put_lanes(by_radius, r, 0.0)
        put_lanes(by_radius, wheel, lanes_at(by_lag, wheel))
        later = features.change / max(abs(features.rolling[wheel]), SLOWEST_M_S)
        put_lanes(
            by_lag,
            wheel,
            lanes_at(by_lag, wheel) * (later if is_measured(features, wheel) else 0.0),
        )
    put_lanes(by_lag, 4, 0.0)
    put_lanes(by_lag, 5, 0.0)


@compiled
def weigh_slopes(
    curve: TyreCurve, features: BlockFeatures, flat: float, node: NodeWorkspace
) -> float:
    """Compute node.noise, the noise variances of the six residuals (four wheels, two axles) at the
    slips node.slip. Return a penalty [nat] for sliding wheels per node.

    The penalty is for wheels on the flat part of the tyre curve. There a wheel may have any slip,
    so the probability density of the measured slip is low.
    """
    slip = node.slip
    density = 1.0 + 0.0 * lanes_at(slip.size, 0)
    for axle in range(2):
        across = 0.0
        for wheel in range(2 * axle, 2 * axle + 2):
            g_x = lanes_at(slip.along, wheel)
            g_y = lanes_at(slip.across, wheel)
            size = lanes_at(slip.size, wheel)
            slope = interpolate_table(curve.slope, lanes_at(slip.place, wheel))
            ratio = lanes_at(slip.ratio, wheel)
            along = slope_along(slope, ratio, g_x * g_x, size * size)
            across += features.load_share[wheel] * slope_along(slope, ratio, g_y * g_y, size * size)
            correction = slip_noise_correction(along)
            noise = features.noise_std[wheel] ** 2 - correction * features.slip_noise[wheel]
            put_lanes(node.noise, wheel, noise)
            put_lanes(node.abrupt, wheel, (0.5 - correction) * features.abrupt_noise[wheel])
            if is_measured(features, wheel):
                density *= min(along * (1.0 / flat), 1.0)
        side = 4 + axle
        correction = slip_noise_correction(across)
        noise = features.noise_std[side] ** 2 - correction * features.slip_noise[side]
        put_lanes(node.noise, side, noise)
        put_lanes(node.abrupt, side, 0.0)
    return -log_lanes(density)


@inlined
def slope_along(slope: float, ratio: float, square: float, whole: float) -> float:
    """Return the slope [1] of the tyre curve in one direction (longitudinal or lateral): the
    derivative of force over load by slip, both in this direction.

    Slip is stated as the force over load that a linear tyre (constant stiffness) would have.
    Therefore the slope is 1 at small slip and decreases towards the flat part of the curve. The
    result is at least FLATTEST.

    Args:
        slope: slope of the tyre curve at the total slip [1].
        ratio: force divided by the force of a linear tyre at the same slip [1].
        square: squared slip in the direction [1].
        whole: squared total slip, over both directions [1].
    """
    mean = (slope * square + ratio * (whole - square)) * inverse_of(whole)
    return select(whole < TINY, 1.0, max(mean, FLATTEST))


@inlined
def slip_noise_correction(slope: float) -> float:
    """Return the share of the slip noise variance that the caller must subtract from the noise
    variance of a residual. `slope` is the slope k of the tyre curve.

    A residual is the distance of a measurement from the tyre curve, normal to the curve. Therefore
    the share k^2/(1 + k^2) of the slip noise variance enters the residual (errors in variables).
    `features.noise_std` assumes k = 1, where the share is 1/2. The result is 1/2 - k^2/(1 + k^2).

    Without the correction, the noise would be too large on the flat part of the curve. The filter
    would then prefer nodes in which the wheels slide.
    """
    return 0.5 - slope * slope * inverse_of(1.0 + slope * slope)
