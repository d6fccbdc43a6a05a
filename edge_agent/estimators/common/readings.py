"""Plausibility check of a sample's readings, and health flags for missing readings."""

from __future__ import annotations

import math

import numpy as np

from edge_agent.dynamics.parameters import Parameter
from edge_agent.estimators import flags
from schemas.numeric import FloatArray
from schemas.runtime.jit import compiled
from schemas.signals import S

# Number of channels before the position: ax, ay, yaw rate, steering, wheel speeds, torques
INPUTS = int(S.LATITUDE)
# Limits of readings: a larger one is a sensor error, because no car moves like that.
LIMITS = np.array(
    [40.0] * 2  # acceleration [m/s^2]
    + [6.0]  # yaw rate [rad/s]
    + [1.3] * 4  # steering angle [rad]
    + [500.0] * 4  # wheel speed [rad/s]
    + [50_000.0] * 4  # wheel torque [N m]
)
# Health flag of each channel if its reading is missing; steering of the rear wheels is optional.
MISSING = np.array(
    [flags.NO_INERTIAL] * 3
    + [flags.NO_STEERING] * 2
    + [0] * 2
    + [flags.NO_WHEEL_SPEED] * 4
    + [flags.NO_TORQUE] * 4
)
GAP_S = 0.5  # [s] after a longer gap of all channels, a filter restarts its motion
POSITION_S = 1.5  # [s] a longer gap of the position receiver is reported


@compiled
def read_plausible(sample: FloatArray, now: FloatArray) -> int:
    """Copy the plausible readings of a sample (18,) to `now` (15,), and return the health flags for
    missing and implausible readings.

    A reading that is missing, infinite or implausible becomes NaN in `now`.
    """
    odd = 0
    missing = 0
    for channel in range(INPUTS):
        value = sample[channel]
        is_present = value == value
        is_plausible = abs(value) <= LIMITS[channel]
        now[channel] = value if is_plausible else math.nan
        odd |= flags.OUTLIER if is_present and not is_plausible else 0
        missing |= 0 if is_plausible else MISSING[channel]
    return odd | missing


@compiled
def position_time(sample: FloatArray, time: float, last: float) -> float:
    """Return the time [s] of the last valid position: `time` if the sample (18,) has one, else
    `last`.
    """
    return (
        time if math.isfinite(sample[S.LATITUDE]) and math.isfinite(sample[S.LONGITUDE]) else last
    )


@compiled
def position_health(time: float, last: float) -> int:
    """Return the health flag NO_POSITION if, at `time` [s], the last position (time `last` [s]) is
    more than POSITION_S seconds old; else return 0.
    """
    return 0 if time - last <= POSITION_S else flags.NO_POSITION


@compiled
def rolling_speed(row: FloatArray, now: FloatArray) -> float:
    """Return the second largest rolling speed (radius times wheel speed) of the wheels [m/s].

    Two wheels may be locked and one may spin, so the second largest is the best guess of the
    vehicle's speed. If only one wheel has a reading, return the speed of this wheel. If no wheel
    has a reading, return NaN.
    """
    first = math.nan
    second = math.nan
    for wheel in range(4):
        speed = row[Parameter.RADIUS] * now[S.OMEGA + wheel]
        if math.isnan(speed):
            continue
        if math.isnan(first) or speed > first:
            first, second = speed, first
        elif math.isnan(second) or speed > second:
            second = speed
    return first if math.isnan(second) else second
