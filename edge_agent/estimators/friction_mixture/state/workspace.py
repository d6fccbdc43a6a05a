"""Scratch records for intermediate results while one block (0.05 s) of one vehicle is processed.
Nothing is kept between steps: a step writes each field before it reads it.
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
    """Inputs of the measurement equations for one block (the samples within 0.05 s).

    The mean velocity of the block is rotation(cos, sin)*v + gains, where v is the velocity at the
    block's beginning. The order of wheels is fl, fr, rl, rr, and of axles front, rear. The order of
    measurements is the four wheels (longitudinal), then the two axles (lateral).
    """

    duration: float  # [s]
    speed: float  # |v_x| at the beginning [m/s]
    cos: float
    sin: float
    gain: VelocityGain  # mean over the block
    yaw_rate: float  # mean [rad/s]
    novelty: float  # share of the block that is new, with the floor `steady_share` [1]
    new: float  # membership of forces and lateral slips in "new" [1]
    demand: float  # larger force over load of the two axles [1]
    change: float  # measured a_x, mean [m/s^2]
    steering: float  # mean angle of the front wheels [rad]
    steer_rate: float  # of it [rad/s]
    asymmetry: float  # slip left against right beyond force and noise, in force over load [1]
    loads: Annotated[FloatArray, 4]  # [N]
    spin: Annotated[FloatArray, 4]  # wheel acceleration [rad/s^2]
    rolling: Annotated[FloatArray, 4]  # R*omega, mean [m/s]; NaN without a reading
    force: Annotated[FloatArray, 4]  # F_x/F_z [1]
    force_unit: Annotated[FloatArray, 4]  # its derivative by a_x, where torque is missing [s^2/m]
    load_share: Annotated[FloatArray, 4]  # wheel load over axle load [1]
    steer_cos: Annotated[FloatArray, 4]
    steer_sin: Annotated[FloatArray, 4]
    # velocity of the wheel's centre from the yaw rate, along and across the wheel [m/s]
    turn_along: Annotated[FloatArray, 4]
    turn_across: Annotated[FloatArray, 4]
    side: Annotated[FloatArray, 2]  # F_y/F_z of an axle in the wheel's frame [1]; NaN where unknown
    side_leak: Annotated[FloatArray, 2]  # its derivative by the leak [1]
    side_unit: Annotated[FloatArray, 2]  # its derivative by a_y [s^2/m]
    noise_std: Annotated[FloatArray, ROWS]  # nominal, of a residual where the curve rises [1]
    slip_noise: Annotated[
        FloatArray, ROWS
    ]  # variance of slip, as linear force over load; half of it is in noise_std
    abrupt_noise: Annotated[FloatArray, 4]  # variance of slip that came within the block, likewise
    informs_x: Annotated[
        FloatArray, 2
    ]  # how much the force of an axle's wheels informs of stiffness, 0 to 1
    axle_scale: float  # R of the axles over R as the constants state it
    informs_y: Annotated[FloatArray, 2]


class NodeSlip:
    """Slips of wheels and axles, and the forces that the tyre curve gives for them, for one state
    vector of each node (filter of one friction hypothesis) in a group.
    """

    along: Annotated[LaneArray, 4]  # g_x, linear force over load [1]
    across: Annotated[LaneArray, 4]  # g_y
    size: Annotated[LaneArray, 4]  # of (g_x, g_y)
    place: Annotated[LaneArray, 4]  # u of the tables over slip, theta/(1 + theta)
    ratio: Annotated[LaneArray, 4]  # force over that of a linear tyre [1]
    axle_slip: Annotated[
        LaneArray, 2
    ]  # across, mean of an axle's wheels, as linear force over load
    axle_force: Annotated[LaneArray, 2]  # of it by the tyre curve, over load [1]
    scale_x: Annotated[LaneArray, 2]  # what a wheel's residual is multiplied by, per axle
    scale_y: Annotated[LaneArray, 2]  # the same for an axle's residual


class NodeForces:
    """Measured forces over load [1] of wheels and axles, corrected by the states of each node
    (filter of one friction hypothesis).
    """

    force: Annotated[LaneArray, ROWS]
    slip_at_force: Annotated[LaneArray, ROWS]  # linear force over load that gives it


class NodeWorkspace:
    """Scratch arrays for the update of one group of nodes (friction hypotheses)."""

    gained_x: Annotated[LaneArray, 1]  # mean velocity gained in the block, by a node's mean [m/s]
    gained_y: Annotated[LaneArray, 1]
    rolling: Annotated[LaneArray, 4]  # R*omega with radius and lag as the node has them [m/s]
    steering: Annotated[LaneArray, 1]  # true minus measured steering angle of the front axle [rad]
    mu: Annotated[LaneArray, 2]  # friction on the left and right
    per_mu: Annotated[LaneArray, 2]
    axle_mu: Annotated[LaneArray, 2]  # mean over an axle's wheels by load
    per_axle_mu: Annotated[LaneArray, 2]
    point: Annotated[LaneArray, STATES]
    slip: NodeSlip  # at the mean
    moved_slip: NodeSlip  # at another point
    forces: NodeForces  # at the mean
    moved_forces: NodeForces
    # force over load by which a tyre one spread sharper differs
    shape_force: Annotated[LaneArray, ROWS]
    # at the mean, then mean of the cubature points, then innovation
    residual: Annotated[LaneArray, ROWS]
    ahead: Annotated[LaneArray, ROWS]
    behind: Annotated[LaneArray, ROWS]
    nonlinearity: Annotated[LaneArray, ROWS]  # variance that the rows' curvature adds
    middle: Annotated[LaneArray, CURVED, ROWS]
    derivative: Annotated[LaneArray, ACTIVE, ROWS]
    root: Annotated[LaneArray, STATES, CURVED]  # first columns of the covariance's factor
    curved: Annotated[LaneArray, CURVED, ROWS]  # deviation of the cubature points in their axes
    whole: Annotated[LaneArray, CURVED, ROWS]  # the same with the rows' linear part
    cross: Annotated[LaneArray, STATES, ROWS]  # covariance of the states with the rows
    gain: Annotated[LaneArray, ROWS]  # inverse variances of the innovations
    scaled: Annotated[LaneArray, 1, ROWS]
    spread: Annotated[LaneArray, ROWS, ROWS]  # covariance of the rows
    noise: Annotated[LaneArray, ROWS]  # variance of the rows' noise
    abrupt: Annotated[
        LaneArray, ROWS
    ]  # variance of what came within the block: a bump says nothing of later ones
    turned: Annotated[LaneArray, 2, STATES]  # covariance of the predicted velocity with the states
    velocity: Annotated[LaneArray, STATES]  # covariance of a measured velocity with the states


class Scratch:
    """Scratch arrays for intermediate results of one block (the samples within 0.05 s) of one
    vehicle.
    """

    features: BlockFeatures
    node: NodeWorkspace
    mixing: Annotated[FloatArray, PLACES]  # share of foreign probability by road change
    share: Annotated[FloatArray, PLACES]  # weight of the active nodes, 0 elsewhere
    updated: Annotated[LaneArray, GROUPS, 2]  # velocity after the measurements [m/s]
    apart: Annotated[LaneArray, GROUPS, STATES]  # from the mean of the mixture
    process: Annotated[FloatArray, STATES]  # variances
    keep: Annotated[FloatArray, STATES]
    log_likelihood: Annotated[FloatArray, PLACES]
    plain: Annotated[FloatArray, PLACES]  # the same with the nominal R
    moved: Annotated[FloatArray, PLACES]  # change of what the belief about the vehicle costs [nat]
    predicted: Annotated[FloatArray, ALL_NODES]
    # sums over the nodes by weight, of the wheels and of the axles, first lane by lane
    actual_lanes: Annotated[LaneArray, 2]
    theoretical_lanes: Annotated[LaneArray, 2]
    stated_lanes: Annotated[LaneArray, 1]
    square_lanes: Annotated[LaneArray, 1]
    actual_sum: Annotated[FloatArray, 2]  # squared innovations
    theoretical_sum: Annotated[FloatArray, 2]  # their variances
    stated_sum: float  # the axles' with R as the constants state it
    projected: Annotated[FloatArray, NODES]
    expected: Annotated[FloatArray, NODES]
    blended: Annotated[FloatArray, NODES]


class MixtureContext:
    """Tables of the filter (`design`) and scratch memory that the filters of a thread share."""

    design: MixtureDesign
    scratch: Scratch
