"""The signals of a vehicle: names, order in an array, units, and health flags.

Signals are stored in blocks. A block is a float array (T, N, len(CHANNELS)) for T samples of N
vehicles; NaN is a missing reading. Axes are ISO 8855: x forward, y left, z up; yaw, steering and
lateral quantities are positive to the left.
"""

from __future__ import annotations

from enum import IntEnum, IntFlag
from typing import Final

WHEELS: Final = ("fl", "fr", "rl", "rr")


def per_wheel(name: str) -> tuple[str, ...]:
    """Return the four channel names of a quantity that each wheel has: `per_wheel("omega")` returns
    omega_fl, omega_fr, omega_rl, omega_rr.
    """
    return tuple(f"{name}_{wheel}" for wheel in WHEELS)


# Unit of each channel. The order is that of the last axis of a signal block.
UNITS: Final = {
    "ax": "m/s^2",
    "ay": "m/s^2",
    "yaw_rate": "rad/s",
    **dict.fromkeys(per_wheel("delta"), "rad at the road wheel"),
    **dict.fromkeys(per_wheel("omega"), "rad/s"),
    **dict.fromkeys(per_wheel("torque"), "N*m at the wheel, driving positive"),
    "latitude": "deg (WGS 84)",
    "longitude": "deg (WGS 84)",
    "yaw": "rad counter-clockwise from east",
}
CHANNELS: Final = tuple(UNITS)


# Context: flags and values that cars report in addition to the estimators' channels. A context
# block is a float array (T, N, len(CONTEXT)); NaN means unknown. Every value is optional.

# Flags of slip controllers: anti-lock brakes, stability control, traction control.
FLAGS: Final = (
    "abs_active",
    "esc_active",
    "tcs_active",
)
CONTEXT_UNITS: Final = {
    **dict.fromkeys(FLAGS, "0 no, 1 yes"),
    "air_temperature": "degC outside",
    "wiper": "0 off, 1 continuous",
}
CONTEXT: Final = tuple(CONTEXT_UNITS)


class C(IntEnum):
    """Index of a context signal (controller flags, air temperature, wiper) on the last axis of an
    array of context signals. The controller flags come first, in the order of FLAGS.
    """

    ABS = CONTEXT.index("abs_active")
    ESC = CONTEXT.index("esc_active")
    TCS = CONTEXT.index("tcs_active")
    AIR_TEMPERATURE = CONTEXT.index("air_temperature")
    WIPER = CONTEXT.index("wiper")


class S(IntEnum):
    """Index of a channel on the last axis of an array of signals. For a quantity with one channel
    per wheel, it is the index of the front left wheel (fl).
    """

    AX = CHANNELS.index("ax")
    AY = CHANNELS.index("ay")
    YAW_RATE = CHANNELS.index("yaw_rate")
    DELTA = CHANNELS.index("delta_fl")
    OMEGA = CHANNELS.index("omega_fl")
    TORQUE = CHANNELS.index("torque_fl")
    LATITUDE = CHANNELS.index("latitude")
    LONGITUDE = CHANNELS.index("longitude")
    YAW = CHANNELS.index("yaw")


class Health(IntFlag):
    """Reasons why a friction estimate is less reliable, as bit flags; 0 means that there is no such
    reason.
    """

    OK = 0
    NO_TORQUE = 1  # wheel torque is missing; the accelerometer alone gives the longitudinal force
    NO_WHEEL_SPEED = 2
    NO_INERTIAL = 4  # ax, ay or yaw rate is missing
    NO_STEERING = 8
    NO_POSITION = 16
    TIME_GAP = 32  # more than 0.5 s without a sample, or time did not increase
    OUTLIER = 64  # at least one reading was rejected
    SLIDING = 128  # a wheel is locked or spins: its slip is beyond the tyre's force peak
    RESET = 256  # the filter was reset
    # No friction value explains the measurements. The estimate is the prior, and the likelihood is
    # flat.
    CONTRADICTION = 512
