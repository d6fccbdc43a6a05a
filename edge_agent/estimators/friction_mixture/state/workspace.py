"""Scratch records for intermediate results of one block of one vehicle. Nothing is kept between
steps: a step writes each field before it reads it.
"""

from __future__ import annotations

from typing import Annotated

from edge_agent.estimators.friction_mixture.state.constants import (
    ACTIVE,
    ALL_NODES,
    CURVED,
    NODES,
    ROWS,
    STATES,
)
from edge_agent.estimators.friction_mixture.state.design import MixtureDesign
from edge_agent.estimators.friction_mixture.state.memory import PlanarVector, VelocityGain
from schemas.numeric import FloatArray


class BlockFeatures:
    """Inputs of the measurement equations for one block (the samples within 0.05 s).

    The mean velocity of the block is rotation(cos, sin)*v + gains, where v is the velocity at the
    block's beginning. The order of wheels is fl, fr, rl, rr, and of axles front, rear. The order of
    measurement rows is the four wheels (longitudinal), then the two axles (lateral).
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
    """Slips of the wheels and axles, computed for one state vector of a node (filter of one
    friction hypothesis).
    """

    along: Annotated[FloatArray, 4]  # g_x, linear force over load [1]
    across: Annotated[FloatArray, 4]  # g_y
    scale_x: Annotated[FloatArray, 2]  # what a wheel's residual is multiplied by, per axle
    scale_y: Annotated[FloatArray, 2]  # the same for an axle's residual


class NodeWorkspace:
    """Scratch arrays for the update of one node (friction hypothesis)."""

    gained: PlanarVector  # mean velocity gained in the block, by the node's mean [m/s]
    point: Annotated[FloatArray, STATES]
    slip: NodeSlip
    shape_force: Annotated[
        FloatArray, ROWS
    ]  # force over load by which a tyre one spread sharper differs
    force: Annotated[FloatArray, ROWS]  # force over load as the node corrects it
    slip_at_force: Annotated[FloatArray, ROWS]  # linear force over load that gives it
    residual: Annotated[
        FloatArray, ROWS
    ]  # at the mean, then mean of the cubature points, then what is left of it
    ahead: Annotated[FloatArray, ROWS]
    behind: Annotated[FloatArray, ROWS]
    nonlinearity: Annotated[FloatArray, ROWS]  # variance that the rows' curvature adds
    middle: Annotated[FloatArray, CURVED, ROWS]
    derivative: Annotated[FloatArray, ACTIVE, ROWS]
    deviation: Annotated[FloatArray, ROWS, ACTIVE]
    noise: Annotated[FloatArray, ROWS]  # variance of the rows' noise
    abrupt: Annotated[
        FloatArray, ROWS
    ]  # variance of what came within the block: a bump says nothing of later ones
    inflated: Annotated[
        FloatArray, ROWS
    ]  # of the noise, for correlation in time, for outliers and what was abrupt


class Scratch:
    """Scratch arrays for intermediate results of one block (the samples within 0.05 s) of one
    vehicle.
    """

    features: BlockFeatures
    node: NodeWorkspace
    innovation: Annotated[FloatArray, ALL_NODES, ROWS]
    theoretical: Annotated[FloatArray, ALL_NODES, ROWS]  # variance of it
    process: Annotated[FloatArray, STATES]  # variances
    keep: Annotated[FloatArray, STATES]
    log_likelihood: Annotated[FloatArray, ALL_NODES]
    joint: Annotated[FloatArray, ALL_NODES]  # log of weight times likelihood with the nominal R
    moved: Annotated[
        FloatArray, ALL_NODES
    ]  # change of what the belief about the vehicle costs [nat]
    predicted: Annotated[FloatArray, ALL_NODES]
    actual_sum: Annotated[FloatArray, 2]
    stated_sum: float  # the axles' with R as the constants state it
    theoretical_sum: Annotated[FloatArray, 2]
    root: Annotated[FloatArray, ALL_NODES, STATES, STATES]
    velocity_row: Annotated[
        FloatArray, STATES
    ]  # deviation of a velocity in the axes of a root's columns
    projected: Annotated[FloatArray, NODES]
    expected: Annotated[FloatArray, NODES]
    blended: Annotated[FloatArray, NODES]


class MixtureContext:
    """Tables of the filter (`design`) and scratch memory that the filters of a thread share."""

    design: MixtureDesign
    scratch: Scratch
