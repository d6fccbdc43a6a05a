"""Records of the data that the friction mixture (default estimator) keeps between samples, one set
per vehicle.
"""

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

    x: float
    y: float


class VelocityGain:
    """Change of velocity [m/s], integrated from the accelerometers since the block (0.05 s) began,
    in the current vehicle axes.
    """

    measured: PlanarVector  # from the measured accelerations
    leak_y: PlanarVector  # part of `measured` that comes from a_y
    unit: PlanarVector  # from a forward acceleration of 1 m/s^2: effect of a sensor offset


class BlockSums:
    """Sums of the inputs and of the motion over the samples of the current block (.05 s), from
    which the block's means are computed when it ends.
    """

    time: float  # [s] beginning of the block
    samples: int
    angle: float  # [rad] yaw angle since the beginning
    cos_sum: float  # sum of the cosine of `angle` over the samples
    sin_sum: float  # sum of the sine of `angle` over the samples
    gain: VelocityGain  # since the beginning
    gain_sum: VelocityGain  # sum of `gain` over the samples
    sums: Annotated[FloatArray, INPUTS]  # sum of each channel's valid samples
    counts: Annotated[IntArray, INPUTS]  # number of each channel's valid samples
    missing_x: float  # [m^2/s^2] variance of v_x from the time in which a_x is missing
    missing_y: float  # [m^2/s^2] variance of v_y, the same for a_y and the yaw rate
    start_yaw_rate: float  # [rad/s] yaw rate at the beginning
    start_omega: Annotated[FloatArray, 4]  # [rad/s] wheel speeds at the beginning
    start_omega_time: Annotated[FloatArray, 4]  # [s] time at which each of them was read


class WheelSensors:
    """Record of the wheel speed readings of the last seconds, from which failed sensors are
    recognised.
    """

    reading: Annotated[FloatArray, 4]  # [rad/s] last reading
    time: Annotated[FloatArray, 4]  # [s] time of the last reading
    changed: Annotated[FloatArray, 4]  # [s] time at which the reading last changed
    # [rad/s] size of that change, at least the finest and at most the coarsest resolution
    step: Annotated[FloatArray, 4]
    # [s] longest time between two changes in the last second
    interval: Annotated[FloatArray, 4]
    # [rad/s] readings of the other wheels when the reading of a wheel last changed
    others: Annotated[FloatArray, 4, 4]
    turned: Annotated[IntArray, 4]  # 1 if the wheel has turned since the drive began
    # 1 if the wheel last stopped faster than by a brake
    fell: Annotated[IntArray, 4]


class LastInputs:
    """Record of the latest value of each input signal, which the filter needs at the next
    sample.
    """

    time: float  # [s] time of the last sample
    position_time: float  # [s] time of the last position
    now: Annotated[FloatArray, INPUTS]  # readings of the last sample, NaN where missing
    reading: Annotated[FloatArray, INPUTS]  # last valid reading of each channel
    reading_time: Annotated[FloatArray, INPUTS]  # [s] time of that reading
    # [s] longest time between two readings of a channel in the last second
    reading_interval: Annotated[FloatArray, INPUTS]
    inertial_time: float  # [s] time of the last sample with both accelerations
    ax: float  # [m/s^2] last value used
    ay: float
    read_ax: float  # [m/s^2] last reading, used or rejected
    read_ay: float
    yaw_rate: float  # [rad/s] estimate of the scalar filter
    yaw_rate_var: float  # [rad^2/s^2] variance of `yaw_rate`
    omega: Annotated[FloatArray, 4]  # [rad/s] wheel speeds
    omega_held: Annotated[IntArray, 4]  # number of readings since a wheel speed changed
    omega_step: Annotated[FloatArray, 4]  # [rad/s] resolution of a wheel speed signal
    wheel_sensors: WheelSensors
    delta: Annotated[FloatArray, 4]  # [rad] steering angles
    delta_before: Annotated[FloatArray, 4]  # [rad] steering angles in the previous block
    rear_steering: bool  # True once a rear steering angle has been read


class GripInUse:
    """Record of the grip in use according to the accelerometers, that is, smoothed horizontal
    acceleration over g [1].
    """

    slow: float  # smoothed over `abrupt_time`, for the penalty of nodes
    fast: float  # smoothed over a block
    held: float  # recent maximum of `fast`: the reported upper end is not below it
    age: float  # [s] time since `held` was last reached


class RollingMotion:
    """Record of the velocity that follows from the speeds of rolling wheels, without a tyre
    model.
    """

    moved_time: float  # [s] time at which a wheel last turned
    disagreed_time: float  # [s] time at which the wheels last disagreed
    resting_ax: float  # [m/s^2] moving average of a_x while the wheels stand
    stands: bool
    ahead: float  # [m/s] v_x according to agreeing wheels; NaN if they do not agree
    ahead_std: float  # [m/s] standard deviation of `ahead`
    left: float  # [m/s] v_y according to the rear axle; NaN if this axle may slide
    left_std: float  # [m/s] standard deviation of `left`


class WheelSlip:
    """Record of the evidence that wheels or axles slide.

    The evidence that a wheel slides comes from the wheel speeds alone (`block/wheel_slip.py`). The
    evidence that an axle slides on a slippery road comes from its slip and the friction estimate
    (`mixture/weighing.py`). A membership is a fuzzy truth value, 0 to 1.
    """

    held: float  # membership of the last second in "a wheel slides"
    begins: float  # increase of `held` by the current block
    ended: float  # `held` minus the membership of the current block
    axle_held: float  # membership of the last second in "an axle slides on a slippery road"
    # `axle_held` minus the membership of the current block; 0 if the force has changed
    axle_ended: float
    # [s] time until which the rear axle may be on another surface than the front axle
    rear_unlike_until: float


class Trust:
    """State of the consistency test, which checks that at least one friction explains the
    measurements.
    """

    # [1] moving average of the axles' squared innovations over their stated variance, without the
    # part that slides or slippery road explain
    ratio: float
    odd: float  # [nat] recent log-likelihood ratio against the model
    distrust: float  # 1 while the model counts as contradicted, else 0
    left: float  # [s] time until the model is tried again
    patience: float  # [s] duration of the last distrust, fading with time
    strain: float  # [1] chi-square of vehicle and sensor states over degrees of freedom


class Quantiles:
    """Median, lower and upper end (5 % and 95 % quantile) of friction, and the probability of a
    slippery road.
    """

    median: float
    lower: float  # 5 % quantile
    upper: float  # 95 % quantile
    p_slippery: float  # P(mu < SLIPPERY_MU)


class MixtureMemory:
    """State of the default estimator (friction mixture) for one vehicle, kept from one sample to
    the next.
    """

    row: Annotated[FloatArray, len(Parameter)]  # vehicle parameters
    nominal: Nominal  # prior of its states, narrowed by its calibration
    started: bool
    split: bool  # True while the nodes of split roads are active
    last: LastInputs
    block: BlockSums
    mean: Annotated[LaneArray, GROUPS, STATES]
    covariance: Annotated[LaneArray, GROUPS, STATES, STATES]  # only its lower half is used
    weight: Annotated[FloatArray, PLACES]  # probabilities of the nodes
    # Probabilities of the nodes that start from the prior with each visit
    visit_weight: Annotated[FloatArray, PLACES]
    # Most informative `visit_weight` of the current part of the visit
    surest: Annotated[FloatArray, NODES]
    information: float  # [nat] divergence of `surest` from the prior
    patch: Annotated[FloatArray, PATCH_NODES]  # probability of an ice patch here, per ice node
    # [nat] amount charged so far for deviations of a node's vehicle and sensor states
    penalty: Annotated[FloatArray, PLACES]
    overall_mean: Annotated[FloatArray, STATES]  # of the whole mixture
    overall_covariance: Annotated[FloatArray, STATES, STATES]
    # Averaged squared innovations of the axles, and their expected variances
    actual: float
    theoretical: float
    factor: float  # [1] adapted over nominal R of the axles
    last_side: Annotated[FloatArray, 2]  # [1] axles' lateral force over load in the previous block
    usual_rolling: Annotated[FloatArray, 4]  # [m/s] smoothed forward speed according to each wheel
    # [rad/s] mean wheel speeds of the last block and of the one before it
    earlier_omega: Annotated[FloatArray, 2, 4]
    vibration: float  # [rad/s] standard deviation of a block's mean wheel speed by uneven road
    # [1] slips of the wheels, along and across, that belong to the tyres' force (`relaxation.py`)
    built_along: Annotated[FloatArray, 4]
    built_across: Annotated[FloatArray, 4]
    usual_force: Annotated[FloatArray, 6]  # [1] smoothed force over load of wheels and axles
    # [1] smoothed slip of wheels (longitudinal) and axles (lateral), as force over load of a linear
    # tyre
    usual_slip: Annotated[FloatArray, 6]
    # [1] smoothed force over load of the axles, along and across
    axle_force: Annotated[FloatArray, 2, 2]
    drive_odds: Annotated[FloatArray, 3]  # probabilities of rear, all-wheel and front drive
    slip: WheelSlip
    rolling: RollingMotion
    grip: GripInUse
    trust: Trust
    excitation: Excitation
    friction: Quantiles
    friction_left: Quantiles
    friction_right: Quantiles
    health: int  # flags of the last block
    nis: float  # normalised squared innovation, mean over the measurements
    log_likelihood: float  # [nat] of the measurements of the block that ends at the sample


def new_filters(
    rows: FloatArray, nominal: Nominal, means: FloatArray, spreads: FloatArray
) -> RecordArray:
    """Return the filter records of vehicles with the parameters `rows` (N, 16), before the first
    sample.

    `means` and `spreads` (N, STATES) are the means and standard deviations of the state priors; the
    times within which states return to the prior are those of `nominal`.
    """
    filters = records(MixtureMemory, len(rows))
    prior = filters["nominal"]
    prior["mean"] = means
    prior["std"] = spreads
    prior["time"] = nominal.time
    filters["row"] = rows
    filters["factor"] = 1.0
    filters["last_side"] = np.nan
    filters["usual_rolling"] = np.nan
    filters["earlier_omega"] = np.nan
    return filters
