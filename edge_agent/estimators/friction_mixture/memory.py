"""What a bank carries from sample to sample: one record per vehicle."""

from __future__ import annotations

from enum import IntEnum
from typing import Annotated

import numpy as np

from edge_agent.dynamics.parameters import P
from edge_agent.estimators.friction_mixture.constants import NODES, PAIRS, STATES
from schemas.numeric import FloatArray, IntArray
from schemas.runtime.records import RecordArray, records

INPUTS = 15  # ax, ay, yaw rate, steering, wheel speed, torque: the channels before the position
RING = 64  # blocks remembered for the grip used in the last second


class H(IntEnum):
    """Index of a scalar that is held between samples."""

    TIME = 0  # of the last sample [s]
    BLOCK_TIME = 1  # at which the block began [s]
    ANGLE = 2  # turned since the block began [rad]
    SUM_COS = 3  # of that angle, over the samples of the block
    SUM_SIN = 4
    SAMPLES = 5
    YAW_RATE = 6  # scalar filter [rad/s]
    YAW_RATE_VAR = 7
    START_YAW_RATE = 8  # at the beginning of the block
    AX = 9  # last input used [m/s^2]
    AY = 10
    POSITION_TIME = 11  # of the last position [s]
    MISSING_AX = 12  # share of the block without it
    MISSING_AY = 13
    RING_NEXT = 14
    HEALTH = 15
    NIS = 16
    MU = 17
    MU_LOWER = 18
    MU_UPPER = 19
    LOG_LIKELIHOOD = 20
    USED = 21
    REAR_STEERING = 22  # 1 once a rear steering angle has been seen
    UNLIKE = 23  # 1 while the nodes of unlike sides take part
    LEFT = 24  # median, lower, upper friction under the left wheels
    RIGHT = 27
    INERTIAL_TIME = 30  # of the last sample with both accelerations [s]
    TOLD_AX = 31  # last reading, used or refused [m/s^2]
    TOLD_AY = 32
    LENGTH = 33


class G(IntEnum):
    """Index of a velocity (x, y) [m/s] gained since the block began, in the axes of now."""

    INPUT = 0  # by the measured accelerations
    LEAK_X = 1  # the part of it from a_x, which its leak scales
    LEAK_Y = 2  # the part of it from a_y
    UNIT = 3  # by 1 m/s^2 ahead, per [m/s^2] of offset


class Memory:
    """One filter."""

    row: Annotated[FloatArray, len(P)]  # parameters of the vehicle
    started: bool
    held: Annotated[FloatArray, H.LENGTH]
    gain: Annotated[FloatArray, 4, 2]  # indexed by G
    gain_sum: Annotated[FloatArray, 4, 2]  # over the samples of the block
    sums: Annotated[FloatArray, INPUTS]  # of the valid samples in the block
    counts: Annotated[IntArray, INPUTS]
    start_omega: Annotated[FloatArray, 4]  # at the beginning of the block [rad/s]
    last_omega: Annotated[FloatArray, 4]  # [rad/s]
    last_delta: Annotated[FloatArray, 4]  # [rad]
    mean: Annotated[FloatArray, NODES + PAIRS, STATES]
    covariance: Annotated[FloatArray, NODES + PAIRS, STATES, STATES]
    weight: Annotated[FloatArray, NODES + PAIRS]
    visit: Annotated[FloatArray, NODES + PAIRS]  # probabilities from the reference prior at the start of the visit
    paid: Annotated[FloatArray, NODES + PAIRS]  # price of what a node believes of the vehicle [nat]
    all_mean: Annotated[FloatArray, STATES]  # moments of the mixture
    all_covariance: Annotated[FloatArray, STATES, STATES]
    actual: Annotated[FloatArray, 2]  # windowed innovation variances
    theoretical: Annotated[FloatArray, 2]
    factor: Annotated[FloatArray, 2]  # adapted over nominal R
    side: Annotated[FloatArray, 2]  # SIDE of the axles in the block before [1]
    usual: Annotated[FloatArray, 6]  # FORCE of the wheels and SIDE of the axles, smoothed [1]
    ring_time: Annotated[FloatArray, RING]  # [s]
    ring_used: Annotated[FloatArray, RING]


def new_filters(rows: FloatArray) -> RecordArray:
    """Filters of vehicles with parameters `rows` (N, 12) that have not seen a sample."""
    filters = records(Memory, len(rows))
    filters["row"], filters["factor"], filters["side"], filters["ring_time"] = rows, 1.0, np.nan, -np.inf
    return filters
