"""Scratch records (working memory) for the intermediate results of one block (0.05 s) of one
vehicle. Nothing is kept between steps: a step writes each field before it reads it.
"""

from __future__ import annotations

from typing import Annotated

from edge_agent.estimators.friction_mixture.state.constants import (
    ACTIVE,
    ALL_NODES,
    CURVED,
    GROUPS,
    NODES,
    PLACES,
    ROWS,
    STATES,
)
from edge_agent.estimators.friction_mixture.state.design import MixtureDesign
from edge_agent.estimators.friction_mixture.state.memory import VelocityGain
from schemas.numeric import FloatArray
from schemas.runtime.records import LaneArray


class BlockFeatures:
    """Inputs of the measurement equations for one block.

    The mean velocity of the block is rotation(cos, sin)*v + gains, where v is the velocity at the
    block's beginning. The order of wheels is fl, fr, rl, rr, and of axles front, rear. The order of
    measurements is the four wheels (longitudinal), then the two axles (lateral).
    """

    duration: float  # [s]
    speed: float  # [m/s] |v_x| at the beginning
    cos: float  # mean cosine of the yaw angle since the beginning
    sin: float  # mean sine of the yaw angle since the beginning
    gain: VelocityGain  # mean over the block
    yaw_rate: float  # [rad/s] mean
    # [1] force over load of a rear wheel with linear tyre that turns at the same speed as the other
    # one (locked axle); 0 for a car with a differential
    locked_pull: float
    novelty: float  # [1] `new`, raised to at least `steady_share`
    new: float  # [1] fuzzy truth of "forces or lateral slips are new"
    demand: float  # [1] larger force over load of the two axles
    change: float  # [m/s^2] mean of the measured a_x
    steering: float  # [rad] mean angle of the front wheels
    steer_rate: float  # [rad/s] rate of change of `steering`
    asymmetry: float  # [1] see `unexplained_slip_difference`
    loads: Annotated[FloatArray, 4]  # [N]
    spin: Annotated[FloatArray, 4]  # [rad/s^2] acceleration of a wheel's rotation
    rolling: Annotated[FloatArray, 4]  # [m/s] mean of R*omega; NaN without a reading
    # [1] slips that belong to the tyres' force, minus slips of the wheels (`relaxation.py`)
    late_along: Annotated[FloatArray, 4]
    late_across: Annotated[FloatArray, 4]
    force: Annotated[FloatArray, 4]  # [1] F_x/F_z
    force_unit: Annotated[FloatArray, 4]  # [s^2/m] its derivative by a_x; 0 if torque is known
    load_share: Annotated[FloatArray, 4]  # [1] wheel load over axle load
    steer_cos: Annotated[FloatArray, 4]
    steer_sin: Annotated[FloatArray, 4]
    # [m/s] velocity of the wheel's centre from the yaw rate, along and across the wheel
    turn_along: Annotated[FloatArray, 4]
    turn_across: Annotated[FloatArray, 4]
    side: Annotated[FloatArray, 2]  # [1] F_y/F_z of an axle in the wheel's frame; NaN if unknown
    side_leak: Annotated[FloatArray, 2]  # [1] derivative of `side` by the leak
    side_unit: Annotated[FloatArray, 2]  # [s^2/m] derivative of `side` by a_y
    noise_std: Annotated[FloatArray, ROWS]  # [1] noise of a residual where the curve's slope is 1
    # [1] variance of slip, as force over load of a linear tyre; `noise_std` contains half of it
    slip_noise: Annotated[FloatArray, ROWS]
    abrupt_noise: Annotated[FloatArray, 4]  # [1] variance of sudden slip, as `slip_noise`
    # [1] factors, 0 to 1, on the effect of the stiffness states on an axle's slips
    informs_x: Annotated[FloatArray, 2]
    axle_scale: float  # [1] adapted R of the axles over the R that the constants state
    informs_y: Annotated[FloatArray, 2]


class NodeSlip:
    """Slips of wheels and axles, and the forces that the tyre curve gives for them, for one state
    vector of each node (filter of one friction hypothesis) in a group.
    """

    # Slips are given as force over load of a linear tyre [1].
    along: Annotated[LaneArray, 4]  # g_x
    across: Annotated[LaneArray, 4]  # g_y
    size: Annotated[LaneArray, 4]  # hypot(g_x, g_y)
    place: Annotated[LaneArray, 4]  # theta/(1 + theta), the argument of the tables over slip
    ratio: Annotated[LaneArray, 4]  # force over that of a linear tyre
    axle_slip: Annotated[LaneArray, 2]  # lateral slip, mean of an axle's wheels by load
    axle_force: Annotated[LaneArray, 2]  # lateral force over load according to the tyre curve
    scale_x: Annotated[LaneArray, 2]  # factor on the residuals of an axle's wheels
    scale_y: Annotated[LaneArray, 2]  # factor on an axle's residual


class NodeForces:
    """Measured forces over load [1] of wheels and axles, corrected by the states of each node."""

    force: Annotated[LaneArray, ROWS]
    slip_at_force: Annotated[LaneArray, ROWS]  # slip at which the tyre curve gives `force`


class NodeWorkspace:
    """Scratch arrays for the update of one group of nodes."""

    gained_x: Annotated[LaneArray, 1]  # [m/s] mean velocity gained in the block, per node
    gained_y: Annotated[LaneArray, 1]
    rolling: Annotated[LaneArray, 4]  # [m/s] R*omega, corrected by the node's radius and delay
    steering: Annotated[LaneArray, 1]  # [rad] true minus measured front steering angle
    mu: Annotated[LaneArray, 2]  # friction on the left and right
    per_mu: Annotated[LaneArray, 2]
    axle_mu: Annotated[LaneArray, 2]  # mean over an axle's wheels by load
    per_axle_mu: Annotated[LaneArray, 2]
    point: Annotated[LaneArray, STATES]  # states at which the residuals are evaluated
    slip: NodeSlip  # at the mean of the states
    moved_slip: NodeSlip  # at another state
    forces: NodeForces  # at the mean of the states
    moved_forces: NodeForces  # at another state
    # [1] difference of force over load if the tyre is sharper by one standard deviation
    shape_force: Annotated[LaneArray, ROWS]
    # Residual at the mean, then its mean over the cubature points, then the innovation
    residual: Annotated[LaneArray, ROWS]
    ahead: Annotated[LaneArray, ROWS]  # residual at the cubature point in positive direction
    behind: Annotated[LaneArray, ROWS]  # residual at the cubature point in negative direction
    nonlinearity: Annotated[LaneArray, ROWS]  # variance that the nonlinearity adds
    middle: Annotated[LaneArray, CURVED, ROWS]  # mean of `ahead` and `behind`
    derivative: Annotated[LaneArray, ACTIVE, ROWS]  # of the residuals by the linear states
    root: Annotated[LaneArray, STATES, CURVED]  # first columns of the covariance's factor
    curved: Annotated[LaneArray, CURVED, ROWS]  # B of `node_filter`
    whole: Annotated[LaneArray, CURVED, ROWS]  # B + D*L of `node_filter`
    cross: Annotated[LaneArray, STATES, ROWS]  # covariance of the states with the measurements
    gain: Annotated[LaneArray, ROWS]  # inverse variances of the innovations
    scaled: Annotated[LaneArray, 1, ROWS]
    spread: Annotated[LaneArray, ROWS, ROWS]  # covariance of the measurements
    noise: Annotated[LaneArray, ROWS]  # noise variance of the measurements
    # Noise variance of sudden slip. It is not multiplied by the inflation of R, because a bump
    # does not affect later blocks.
    abrupt: Annotated[LaneArray, ROWS]
    turned: Annotated[LaneArray, 2, STATES]  # covariance of the predicted velocity with the states
    velocity: Annotated[LaneArray, STATES]  # covariance of a measured velocity with the states


class Scratch:
    """Scratch arrays for intermediate results of one block of one vehicle."""

    features: BlockFeatures
    node: NodeWorkspace
    mixing: Annotated[FloatArray, PLACES]  # share of probability that a road change brought
    share: Annotated[FloatArray, PLACES]  # probabilities of the active nodes, 0 elsewhere
    updated: Annotated[LaneArray, GROUPS, 2]  # velocity after the measurements [m/s]
    deviation: Annotated[LaneArray, GROUPS, STATES]  # deviation from the mean of the mixture
    process: Annotated[FloatArray, STATES]  # process variances of the block
    keep: Annotated[FloatArray, STATES]  # factors by which states return to their prior
    log_likelihood: Annotated[FloatArray, PLACES]  # [nat] with the inflated R
    plain: Annotated[FloatArray, PLACES]  # [nat] log-likelihood with R before inflation
    moved: Annotated[FloatArray, PLACES]  # [nat] change of `belief_cost`
    predicted: Annotated[FloatArray, ALL_NODES]  # probabilities after the road change
    # Sums over the nodes, weighted by probability: first per lane, then total
    actual_lanes: Annotated[LaneArray, 1]
    theoretical_lanes: Annotated[LaneArray, 1]
    stated_lanes: Annotated[LaneArray, 1]
    square_lanes: Annotated[LaneArray, 1]
    actual_sum: float  # squared innovations of the axles
    theoretical_sum: float  # their variances
    stated_sum: float  # their variances with the R that the constants state
    projected: Annotated[FloatArray, NODES]
    expected: Annotated[FloatArray, NODES]
    blended: Annotated[FloatArray, NODES]


class MixtureContext:
    """Tables of the filter (`design`) and scratch memory that the filters of a thread share."""

    design: MixtureDesign
    scratch: Scratch
