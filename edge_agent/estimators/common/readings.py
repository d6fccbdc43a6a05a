"""Which readings of a sample are believed, and the speed that the wheels report."""

from __future__ import annotations

import math

import numpy as np

from edge_agent.dynamics.parameters import P
from schemas.numeric import FloatArray
from schemas.runtime.jit import compiled
from schemas.signals import S

INPUTS = 15  # ax, ay, yaw rate, steering, wheel speed, torque: the channels before the position
# beyond these a reading is an error of the sensor, not of the driver
LARGEST_ACCELERATION = 40.0  # [m/s^2]
LARGEST_YAW_RATE = 6.0  # [rad/s]
LARGEST_STEER = 1.3  # [rad]
LARGEST_OMEGA = 500.0  # [rad/s]
LARGEST_TORQUE = 50_000.0  # [N m]
# largest believable size of a reading on each channel before the position
LIMITS = np.array(
    [LARGEST_ACCELERATION] * 2 + [LARGEST_YAW_RATE] + [LARGEST_STEER] * 4 + [LARGEST_OMEGA] * 4 + [LARGEST_TORQUE] * 4
)
GAP_S = 0.5  # a longer silence of all channels starts a filter's motion anew
POSITION_S = 1.5  # a longer silence of the receiver is reported


@compiled
def reading(sample: FloatArray, channel: int) -> float:
    """The reading, or NaN where it is missing, infinite or unbelievable."""
    value = sample[channel]
    return value if abs(value) <= LIMITS[channel] else math.nan


@compiled
def rolling_speed(row: FloatArray, sample: FloatArray) -> float:
    """Second largest rolling speed [m/s] (two wheels may be locked, one may spin); NaN without any wheel."""
    first = second = math.nan
    for wheel in range(4):
        speed = row[P.RADIUS] * reading(sample, S.OMEGA + wheel)
        if math.isnan(speed):
            continue
        if math.isnan(first) or speed > first:
            first, second = speed, first
        elif math.isnan(second) or speed > second:
            second = speed
    return first if math.isnan(second) else second
