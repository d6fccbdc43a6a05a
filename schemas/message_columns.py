"""Columns of the messages: name, type, unit and meaning. `schemas.tables` builds its tables from
them.

The module does not import Arrow, because an agent that only sends messages does not need it.
"""

from __future__ import annotations

from typing import Final, NamedTuple

from schemas import grid
from schemas.thresholds import MU_RANGE, SLIPPERY_MU

# Types of columns. Types that NumPy has are called by their NumPy names.
TIME: Final = "time"  # a column of this type is int64 [ns] in a message
LIKELIHOOD: Final = "likelihood"  # a column of this type is uint8 (n, 32) in a message
F32: Final = "float32"
F64: Final = "float64"
I8: Final = "int8"
I32: Final = "int32"
I64: Final = "int64"


class MessageColumn(NamedTuple):
    """One column of a message. It has the attributes of `schemas.tables.Field` (name, unit, meaning
    and others). Its `type` is a type of this module instead of an Arrow type.
    """

    name: str
    type: str
    unit: str
    meaning: str
    step: float | None = None
    range: tuple[float, float] | None = None


# Steps to which a sender rounds values. 2^-23 degrees of latitude are 13 mm.
_MU_STEP = 2.0**-10
_DEGREE_STEP = 2.0**-23
_RADIAN_STEP = 2.0**-9
_SPEED_STEP = 2.0**-6
_SPEED_RANGE: Final = (-100.0, 100.0)
_MAX_I32: Final = 2**31 - 1

_MU = (
    MessageColumn(
        "mu", F32, "-", "peak adhesion coefficient, median; NaN if unknown", _MU_STEP, MU_RANGE
    ),
    MessageColumn("mu_lower", F32, "-", "5 % quantile of mu", _MU_STEP, MU_RANGE),
    MessageColumn("mu_upper", F32, "-", "95 % quantile of mu", _MU_STEP, MU_RANGE),
)
_POSE = (
    MessageColumn(
        "latitude", F64, "deg", "WGS 84", _DEGREE_STEP, (-grid.MAX_LATITUDE, grid.MAX_LATITUDE)
    ),
    MessageColumn("longitude", F64, "deg", "WGS 84", _DEGREE_STEP, (-180.0, 180.0)),
    MessageColumn(
        "position_std",
        F32,
        "m",
        "standard deviation of the position, each axis",
        2.0**-5,
        (0.0, 100.0),
    ),
    MessageColumn(
        "yaw", F32, "rad", "counter-clockwise from east", _RADIAN_STEP, (-1000.0, 1000.0)
    ),
)

# One visit: the passage of one vehicle through one cell.
OBSERVATION: Final = (
    MessageColumn("enter_time", TIME, "ns since 1970, UTC", "time of the first sample in the cell"),
    MessageColumn("leave_time", TIME, "ns since 1970, UTC", "time of the last sample in the cell"),
    MessageColumn("cell", I64, "quadint z21", "map cell, about 19 m wide at the equator"),
    MessageColumn(
        "sector",
        I8,
        "0 east, 1 north, 2 west, 3 south",
        "heading sector of the vehicle",
        range=(0, grid.SECTORS - 1),
    ),
    *_POSE,
    MessageColumn("yaw_std", F32, "rad", "standard deviation of yaw", 2.0**-12, (0.0, 10.0)),
    MessageColumn("speed", F32, "m/s", "mean speed over the visit", _SPEED_STEP, (0.0, 100.0)),
    *_MU,
    MessageColumn(
        "mu_utilised",
        F32,
        "-",
        "largest grip that any wheel used in the visit; mu is at least this",
        _MU_STEP,
        MU_RANGE,
    ),
    MessageColumn(
        "log_likelihood",
        LIKELIHOOD,
        "1/16 nat below the maximum",
        "log p(measurements | mu) on the 32 bins of the friction grid; absent if not sent",
    ),
    MessageColumn("health", I32, "flags", "bits of schemas.signals.Health", range=(0, _MAX_I32)),
    MessageColumn(
        "tyre_season",
        I8,
        "0 unknown, 1 summer, 2 winter, 3 all-season",
        "season of the vehicle's tyres",
        range=(0, 3),
    ),
    MessageColumn(
        "air_temperature", F32, "degC", "outside; NaN if not measured", 2.0**-4, (-90.0, 80.0)
    ),
    MessageColumn(
        "abs_active", I8, "-1 unknown, 0 no, 1 yes", "anti-lock braking intervened", range=(-1, 1)
    ),
    MessageColumn(
        "used_longitudinal",
        F32,
        "-",
        "longitudinal part of mu_utilised, positive when driving; NaN if unknown",
        _MU_STEP,
        (-2.0, 2.0),
    ),
    MessageColumn(
        "used_lateral",
        F32,
        "-",
        "lateral part of mu_utilised, positive to the left; NaN if unknown",
        _MU_STEP,
        (-2.0, 2.0),
    ),
    MessageColumn(
        "esc_active", I8, "-1 unknown, 0 no, 1 yes", "stability control intervened", range=(-1, 1)
    ),
    MessageColumn(
        "tcs_active", I8, "-1 unknown, 0 no, 1 yes", "traction control intervened", range=(-1, 1)
    ),
    MessageColumn(
        "wiper",
        F32,
        "0 off … 1 continuous",
        "front wipers, mean over the visit; NaN if unknown",
        2.0**-6,
        (0.0, 1.0),
    ),
)

# Position and motion of a vehicle.
STATE: Final = (
    MessageColumn("time", TIME, "ns since 1970, UTC", "time of the sample"),
    *_POSE,
    MessageColumn(
        "vx", F32, "m/s", "longitudinal speed at the centre of gravity", _SPEED_STEP, _SPEED_RANGE
    ),
    MessageColumn(
        "vy", F32, "m/s", "lateral speed at the centre of gravity", _SPEED_STEP, _SPEED_RANGE
    ),
    MessageColumn("yaw_rate", F32, "rad/s", "positive to the left", 2.0**-12, (-20.0, 20.0)),
    MessageColumn("sideslip", F32, "rad", "atan2(vy, vx)", 2.0**-12, (-4.0, 4.0)),
    *_MU,
    MessageColumn("health", I32, "flags", "bits of schemas.signals.Health", range=(0, _MAX_I32)),
    MessageColumn(
        "p_slippery",
        F32,
        "-",
        f"P(mu < {SLIPPERY_MU}); NaN if unknown",
        2.0**-10,
        (0.0, 1.0),
    ),
)
