"""What a bank carries from sample to sample: one record of arrays, first axis the vehicle."""

from __future__ import annotations

from enum import IntEnum
from typing import NamedTuple

import numpy as np

from edge_agent.estimators.friction_mixture.constants import NODES, PAIRS, STATES
from schemas.numeric import BoolArray, FloatArray, IntArray

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


class Memory(NamedTuple):
    """State of N filters."""

    started: BoolArray  # (N,)
    held: FloatArray  # (N, int(H.LENGTH))
    gain: FloatArray  # (N, 4, 2) indexed by G
    gain_sum: FloatArray  # (N, 4, 2) over the samples of the block
    sums: FloatArray  # (N, 15) of the valid samples in the block
    counts: IntArray  # (N, 15)
    start_omega: FloatArray  # (N, 4) at the beginning of the block [rad/s]
    last_omega: FloatArray  # (N, 4) [rad/s]
    last_delta: FloatArray  # (N, 4) [rad]
    mean: FloatArray  # (N, K, n)
    covariance: FloatArray  # (N, K, n, n)
    weight: FloatArray  # (N, K)
    visit: FloatArray  # (N, K) probabilities from the reference prior at the start of the visit
    paid: FloatArray  # (N, K) price of what a node believes of the vehicle, beyond the evidence [nat]
    all_mean: FloatArray  # (N, n) moments of the mixture
    all_covariance: FloatArray  # (N, n, n)
    actual: FloatArray  # (N, 2) windowed innovation variances
    theoretical: FloatArray  # (N, 2)
    factor: FloatArray  # (N, 2) adapted over nominal R
    side: FloatArray  # (N, 2) SIDE of the axles in the block before [1]
    usual: FloatArray  # (N, 6) FORCE of the wheels and SIDE of the axles, smoothed [1]
    ring_time: FloatArray  # (N, 64) [s]
    ring_used: FloatArray  # (N, 64)


def new_memory(count: int) -> Memory:
    """Memory of `count` filters that have not seen a sample."""
    return Memory(
        started=np.zeros(count, np.bool_),
        held=np.zeros((count, int(H.LENGTH))),
        gain=np.zeros((count, 4, 2)),
        gain_sum=np.zeros((count, 4, 2)),
        sums=np.zeros((count, INPUTS)),
        counts=np.zeros((count, INPUTS), np.int64),
        start_omega=np.zeros((count, 4)),
        last_omega=np.zeros((count, 4)),
        last_delta=np.zeros((count, 4)),
        mean=np.zeros((count, NODES + PAIRS, STATES)),
        covariance=np.zeros((count, NODES + PAIRS, STATES, STATES)),
        weight=np.zeros((count, NODES + PAIRS)),
        visit=np.zeros((count, NODES + PAIRS)),
        paid=np.zeros((count, NODES + PAIRS)),
        all_mean=np.zeros((count, STATES)),
        all_covariance=np.zeros((count, STATES, STATES)),
        actual=np.zeros((count, 2)),
        theoretical=np.zeros((count, 2)),
        factor=np.ones((count, 2)),
        side=np.full((count, 2), np.nan),
        usual=np.zeros((count, 6)),
        ring_time=np.full((count, RING), -np.inf),
        ring_used=np.zeros((count, RING)),
    )
