"""Records of the data that the friction mixture keeps between samples, one set per vehicle."""

from __future__ import annotations

from typing import Annotated

import numpy as np

from edge_agent.dynamics.parameters import Parameter
from edge_agent.estimators.common.excitation import Excitation
from edge_agent.estimators.common.readings import INPUTS
from edge_agent.estimators.friction_mixture.state.constants import (
    GROUPS,
    NODES,
    PATCH_NODES,
    PLACES,
    STATES,
)
from edge_agent.estimators.friction_mixture.state.design import Nominal
from schemas.numeric import FloatArray, IntArray
from schemas.runtime.records import LaneArray, RecordArray, records


class PlanarVector:
    """Record of a vector in the plane of the road: x forward, y left."""

    x: float  # ahead
    y: float  # left


class VelocityGain:
    """Change of velocity [m/s], integrated from the accelerometers since the block (0.05 s) began,
    in the current vehicle axes.
    """

    measured: PlanarVector  # by the measured accelerations
    leak_y: PlanarVector  # the part of it from a_y
    unit: PlanarVector  # by 1 m/s^2 ahead, per [m/s^2] of offset


class BlockSums:
    """Sums of the inputs and of the motion over the samples of the current block (.05 s), from
    which the block's means are computed when it ends.
    """

    time: float  # at which it began [s]
    samples: int
    angle: float  # turned [rad]
    cos_sum: float  # of that angle, over the samples
    sin_sum: float
    gain: VelocityGain
    gain_sum: VelocityGain  # over the samples
    sums: Annotated[FloatArray, INPUTS]  # of the valid samples
    counts: Annotated[IntArray, INPUTS]
    missing_x: float  # variance per second of v_x where a_x is missing [m^2/s^3]
    missing_y: float
    start_yaw_rate: float  # [rad/s]
    start_omega: Annotated[FloatArray, 4]  # [rad/s]


class LastInputs:
    """Record of the latest value of each input signal, which the next sample needs."""

    time: float  # of the last sample [s]
    position_time: float  # of the last position [s]
    now: Annotated[FloatArray, INPUTS]  # readings of the last sample, NaN where there is none
    inertial_time: float  # of the last sample with both accelerations [s]
    ax: float  # last input used [m/s^2]
    ay: float
    read_ax: float  # last reading, used or refused [m/s^2]
    read_ay: float
    yaw_rate: float  # scalar filter [rad/s]
    yaw_rate_var: float
    omega: Annotated[FloatArray, 4]  # [rad/s]
    omega_held: Annotated[IntArray, 4]  # readings for which it has been the same
    omega_step: Annotated[FloatArray, 4]  # width of the steps that it is read in [rad/s]
    delta: Annotated[FloatArray, 4]  # [rad]
    delta_before: Annotated[FloatArray, 4]  # in the block before [rad]
    rear_steering: bool  # whether a rear steering angle has been seen


class GripInUse:
    """Record of the grip in use according to the accelerometers, that is, smoothed horizontal
    acceleration over g [1].
    """

    slow: float  # smoothed, for the nodes
    fast: float  # smoothed less
    held: float  # the largest of late: no friction is told below it
    age: float  # of that [s]


class RollingMotion:
    """Record of the velocity that follows from the speeds of rolling wheels, without a tyre
    model.
    """

    moved_time: float  # at which a wheel last turned [s]
    disagreed_time: float  # at which wheels last disagreed [s]
    resting_ax: float  # a_x while wheels stand, smoothed [m/s^2]
    stands: bool
    ahead: float  # v_x by wheels that agree [m/s]; NaN where they do not
    ahead_std: float
    left: float  # v_y by a rear axle that follows [m/s]; NaN where it may slide
    left_std: float


class WheelSlip:
    """Record of the evidence that wheels or axles slide.

    The evidence that a wheel slides comes from the wheel speeds alone (`block/wheel_slip.py`). The
    evidence that an axle slides on a slippery road comes from its slip and the friction estimate
    (`mixture/weighing.py`). A membership is a fuzzy truth value, 0 to 1.
    """

    held: float  # membership of the last second in "a wheel slides" [1]
    begins: float  # what this block adds to it [1]
    ended: float  # what of it this block no longer shows [1]
    axle_held: float  # membership of the last second in "an axle slides on a slippery road" [1]
    axle_ended: float  # what of it this block no longer shows, though its force is the same [1]
    rear_unlike_until: (
        float  # time until which the rear axle is on another surface than the front axle [s]
    )


class Trust:
    """Record of the consistency test, which asks whether any friction explains the measurements."""

    # squared innovations of the axles over their stated variance, smoothed, as far as unexplained
    # [1]
    ratio: float
    odd: float  # how much more likely it is of late that none does [nat]
    distrust: float  # 1 where none does, else 0
    left: float  # of that, before it is tried again [s]
    patience: float  # how long it lasted last [s]
    strain: float  # of what is believed of vehicle and sensors: chi-square over degrees of freedom
    hurry: (
        float  # at which offsets, slope and bank return to their prior, beside the usual pace [1/s]
    )


class Quantiles:
    """Median, lower and upper end (5 % and 95 % quantile) of friction."""

    median: float
    lower: float  # 5 %
    upper: float  # 95 %
    p_slippery: float  # P(mu < SLIPPERY_MU)


class MixtureMemory:
    """State of the default estimator (friction mixture) for one vehicle, kept from one sample to
    the next.
    """

    row: Annotated[FloatArray, len(Parameter)]  # parameters of the vehicle
    nominal: Nominal  # prior of its states, by what its file knows of them
    started: bool
    split: bool  # whether the split nodes take part
    last: LastInputs
    block: BlockSums
    mean: Annotated[LaneArray, GROUPS, STATES]
    covariance: Annotated[LaneArray, GROUPS, STATES, STATES]  # only its lower half is used
    weight: Annotated[FloatArray, PLACES]
    visit_weight: Annotated[
        FloatArray, PLACES
    ]  # probabilities from the reference prior at the visit's start
    surest: Annotated[
        FloatArray, NODES
    ]  # they where they knew most, since the road last became another
    information: float  # of them over the prior [nat]
    patch: Annotated[FloatArray, PATCH_NODES]  # probability of a patch of ice here, by node
    penalty: Annotated[
        FloatArray, PLACES
    ]  # ledger: charged so far for what a node believes of the vehicle [nat]
    overall_mean: Annotated[FloatArray, STATES]  # moments of the mixture
    overall_covariance: Annotated[FloatArray, STATES, STATES]
    actual: Annotated[FloatArray, 2]  # windowed innovation variances: wheels, axles
    theoretical: Annotated[FloatArray, 2]
    factor: Annotated[FloatArray, 2]  # adapted over nominal R
    last_side: Annotated[FloatArray, 2]  # side force over load of the axles in the block before [1]
    usual_rolling: Annotated[FloatArray, 4]  # speed ahead by each wheel, smoothed [m/s]
    usual_force: Annotated[FloatArray, 6]  # force over load of wheels and axles, smoothed [1]
    usual_slip: Annotated[
        FloatArray, 2
    ]  # of axles, across, as linear force over load, smoothed [1]
    # force over load of the axles, along and across, smoothed [1]
    axle_force: Annotated[FloatArray, 2, 2]
    drive_odds: Annotated[
        FloatArray, 3
    ]  # of a car that drives its rear axle, all wheels, its front axle
    slip: WheelSlip
    rolling: RollingMotion
    grip: GripInUse
    trust: Trust
    excitation: Excitation
    friction: Quantiles
    friction_left: Quantiles
    friction_right: Quantiles
    health: int  # of the last block
    nis: float  # per row
    log_likelihood: float  # of what was measured at the sample [nat]


def new_filters(
    rows: FloatArray, nominal: Nominal, means: FloatArray, spreads: FloatArray
) -> RecordArray:
    """Return the filter records of vehicles with the parameters `rows` (N, 15), before the first
    sample.

    `means` and `spreads` (N, STATES) are the means and standard deviations of the state priors; the
    times within which states return to the prior are those of `nominal`.
    """
    filters = records(MixtureMemory, len(rows))
    prior = filters["nominal"]
    prior["mean"], prior["std"], prior["time"] = means, spreads, nominal.time
    filters["row"], filters["factor"] = rows, 1.0
    filters["last_side"] = filters["usual_rolling"] = np.nan
    return filters
