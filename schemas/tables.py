"""Every table of the contract: name, type, unit and meaning of each column, and the Arrow
schemas made from them.
"""

from __future__ import annotations

from typing import Final, NamedTuple

import pyarrow as pa

from schemas import grid, mugrid
from schemas.signals import CONTEXT_UNITS, UNITS, per_wheel
from schemas.thresholds import EXCITED_SHARE, SLIPPERY_MU


class Field(NamedTuple):
    """One column.

    Attributes:
        name, type, unit, meaning: of the column.
        step: the service keeps floats as multiples of it, where there is one. It is a power of two
            far below the value's own uncertainty; finer digits are noise, and a quarter of the
            bytes.
        range: least and largest value that a report may carry, where the table is reported; NaN is
            'absent'.
    """

    name: str
    type: pa.DataType
    unit: str
    meaning: str
    step: float | None = None
    range: tuple[float, float] | None = None


NS = pa.timestamp("ns", tz="UTC")
US = pa.timestamp("us", tz="UTC")  # what is kept on disk: Spark refuses nanoseconds in Parquet
US_STEP: Final = 1_000  # [ns]
LIKELIHOOD = pa.binary(mugrid.BINS)
F32 = pa.float32()
F64 = pa.float64()
I8 = pa.int8()
I32 = pa.int32()
I64 = pa.int64()

# the second is 13 mm
_MU_STEP = 2.0**-10
_DEGREE_STEP = 2.0**-23
_RADIAN_STEP = 2.0**-9
_SPEED_STEP = 2.0**-6
_MU_RANGE: Final = (0.0, 2.0)  # beyond what a road tyre reaches on any road
_SPEED_RANGE: Final = (-100.0, 100.0)
_MAX_I32: Final = 2**31 - 1

_MU = (
    Field(
        "mu", F32, "-", "peak adhesion coefficient, median; NaN where not said", _MU_STEP, _MU_RANGE
    ),
    Field("mu_lower", F32, "-", "5 % quantile of mu", _MU_STEP, _MU_RANGE),
    Field("mu_upper", F32, "-", "95 % quantile of mu", _MU_STEP, _MU_RANGE),
)
_POSE = (
    Field("latitude", F64, "deg", "WGS 84", _DEGREE_STEP, (-grid.MAX_LATITUDE, grid.MAX_LATITUDE)),
    Field("longitude", F64, "deg", "WGS 84", _DEGREE_STEP, (-180.0, 180.0)),
    Field(
        "position_std",
        F32,
        "m",
        "standard deviation of the position, each axis",
        2.0**-5,
        (0.0, 100.0),
    ),
    Field("yaw", F32, "rad", "counter-clockwise from east", _RADIAN_STEP, (-1000.0, 1000.0)),
)

# What one vehicle learned about one cell in one visit.
OBSERVATION: Final = (
    Field("enter_time", NS, "ns since 1970, UTC", "first sample in the cell"),
    Field("leave_time", NS, "ns since 1970, UTC", "last sample in the cell"),
    Field("cell", I64, "quadint z21", "the cell"),
    Field(
        "sector",
        I8,
        "0 east, 1 north, 2 west, 3 south",
        "heading sector",
        range=(0, grid.SECTORS - 1),
    ),
    *_POSE,
    Field("yaw_std", F32, "rad", "standard deviation of yaw", 2.0**-12, (0.0, 10.0)),
    Field("speed", F32, "m/s", "mean speed over the visit", _SPEED_STEP, (0.0, 100.0)),
    *_MU,
    Field(
        "mu_utilised",
        F32,
        "-",
        "largest grip used in the visit, any wheel: mu is at least this",
        _MU_STEP,
        _MU_RANGE,
    ),
    Field(
        "log_likelihood",
        LIKELIHOOD,
        "1/16 nat below the maximum",
        "log p(measurements | mu) on the 32 bins of the friction grid; absent where the sender has "
        "none",
    ),
    Field("health", I32, "flags", "schemas.signals.Health", range=(0, _MAX_I32)),
    Field(
        "tyre_season",
        I8,
        "0 unknown, 1 summer, 2 winter, 3 all-season",
        "tyres of the vehicle",
        range=(0, 3),
    ),
    Field(
        "air_temperature", F32, "degC", "outside; NaN where not measured", 2.0**-4, (-90.0, 80.0)
    ),
    Field(
        "abs_active", I8, "-1 unknown, 0 no, 1 yes", "anti-lock braking intervened", range=(-1, 1)
    ),
    Field(
        "used_longitudinal",
        F32,
        "-",
        "part of mu_utilised along the vehicle, driving positive; NaN where not said",
        _MU_STEP,
        (-2.0, 2.0),
    ),
    Field(
        "used_lateral",
        F32,
        "-",
        "part of mu_utilised across the vehicle, to the left; NaN where not said",
        _MU_STEP,
        (-2.0, 2.0),
    ),
    Field(
        "esc_active", I8, "-1 unknown, 0 no, 1 yes", "stability control intervened", range=(-1, 1)
    ),
    Field(
        "tcs_active", I8, "-1 unknown, 0 no, 1 yes", "traction control intervened", range=(-1, 1)
    ),
    Field(
        "wiper",
        F32,
        "0 still … 1 wiping without a pause",
        "front wipers, mean over the visit; NaN where not known",
        2.0**-6,
        (0.0, 1.0),
    ),
)

# Where a vehicle was and how it moved.
STATE: Final = (
    Field("time", NS, "ns since 1970, UTC", "of the sample"),
    *_POSE,
    Field(
        "vx", F32, "m/s", "longitudinal speed at the centre of gravity", _SPEED_STEP, _SPEED_RANGE
    ),
    Field("vy", F32, "m/s", "lateral speed at the centre of gravity", _SPEED_STEP, _SPEED_RANGE),
    Field("yaw_rate", F32, "rad/s", "positive to the left", 2.0**-12, (-20.0, 20.0)),
    Field("sideslip", F32, "rad", "atan2(vy, vx)", 2.0**-12, (-4.0, 4.0)),
    *_MU,
    Field("health", I32, "flags", "schemas.signals.Health", range=(0, _MAX_I32)),
)

# Who sent a row: the identity of its batch. In the archive the vehicle is a keyed hash.
IDENTITY: Final = (
    Field("vehicle", pa.string(), "-", "enrolled name on the wire; keyed hash in the archive"),
    Field(
        "boot",
        I64,
        "-",
        "keyed hash of the agent's start, with the month's key; in archives of before, the start",
    ),
    Field("region", I64, "quadint z10", "region of the batch"),
    Field("seq", I64, "-", "dense from 1 per (boot, kind, region)"),
    Field("row", I32, "-", "place in the batch, from 0"),
    Field("first_held", I64, "-", "lowest seq still in the sender's spool"),
    Field("estimator", pa.string(), "-", "name of the estimator"),
)

# What the service adds when it keeps a row.
BOOKKEEPING: Final = (
    Field("received_at", NS, "ns since 1970, UTC", "clock of the service"),
    Field(
        "late",
        pa.bool_(),
        "-",
        "later than the lateness window: fused as old news where late_by says so",
    ),
    Field("weight", F32, "-", "weight of the vehicle's vote that was used"),
    Field(
        "late_by",
        I64,
        "ns",
        "how much later than leave_time a late row was fused; 0: in time, or not fused",
    ),
    Field("bias", F32, "-", "relative bias of the vehicle's values that was used"),
    Field("bias_std", F32, "-", "its standard deviation"),
    Field(
        "spread",
        F32,
        "-",
        "standard deviation of the vehicle's values over what it states that was used",
    ),
    Field(
        "slope",
        F32,
        "-",
        "how much too low the fleet's values are for each mu that was left unused, that was used",
    ),
)

# Whether what was said of mu is a value. Without it mu is mostly the prior, and only `mu_utilised`
# is known.
VALUE: Final = Field(
    "value",
    pa.bool_(),
    "-",
    f"mu is a value: {EXCITED_SHARE:g} of it was used; false: only a lower bound is known",
)

# Road weather of a region, as it came and as the map used it.
WEATHER: Final = (
    Field("region", I64, "quadint z10", "the region"),
    Field("time", NS, "ns since 1970, UTC", "from when it holds"),
    Field("air_temperature", F32, "degC", "NaN where unknown"),
    Field("road_temperature", F32, "degC", "of the surface; NaN where unknown"),
    Field("precipitation", F32, "mm/h", "as water; NaN where unknown"),
    Field(
        "prior",
        pa.list_(F32),
        "-",
        "probabilities of the 32 bins of the friction grid; null where there is none",
    ),
    Field("received_at", NS, "ns since 1970, UTC", "clock of the service"),
    Field(
        "acts_from",
        NS,
        "ns since 1970, UTC",
        "from when the map used it: nothing younger had been fused",
    ),
)

MAP_CELL: Final = (
    Field("cell", I64, "quadint z21", "the cell"),
    Field("sector", I8, "0 east, 1 north, 2 west, 3 south", "heading sector"),
    Field(
        "mu", F32, "-", "peak adhesion coefficient, median; null where only lower bounds are known"
    ),
    Field("mu_lower", F32, "-", "5 % quantile"),
    Field("mu_upper", F32, "-", "95 % quantile"),
    Field("p_slippery", F32, "-", f"P(mu < {SLIPPERY_MU})"),
    Field(
        "basis",
        pa.string(),
        "measured | bound | borrowed",
        "what the value rests on; bound: only lower bounds",
    ),
    Field("vehicles", I32, "-", "distinct vehicles"),
    Field("observations", I64, "-", "observations"),
    Field("first_time", NS, "ns since 1970, UTC", "first observation"),
    Field("last_time", NS, "ns since 1970, UTC", "last observation"),
    Field("age_s", F32, "s", "since the last observation, when the tile was made"),
    Field("latitude", F64, "deg", "middle of the cell"),
    Field("longitude", F64, "deg", "middle of the cell"),
    Field("west", F64, "deg", "border of the cell"),
    Field("south", F64, "deg", "border of the cell"),
    Field("east", F64, "deg", "border of the cell"),
    Field("north", F64, "deg", "border of the cell"),
    Field(
        "safe_deceleration",
        F32,
        "m/s^2",
        "what the road bears with 95 % probability, g mu_lower; level road",
    ),
)

# Parts of an hour's statistics of one cell and sector; those of the same hour are merged as each
# column says.
CELL_HOUR: Final = (
    Field("cell", I64, "quadint z21", "the cell"),
    Field("sector", I8, "0 east, 1 north, 2 west, 3 south", "heading sector"),
    Field("hour", US, "us since 1970, UTC", "begin of the hour of leave_time"),
    Field("observations", I64, "-", "count; add"),
    Field("late", I64, "-", "of them not fused; add"),
    Field(
        "vehicles", I64, "-", "distinct vehicles of this part; they do not add, see vehicle_bits"
    ),
    Field("vehicle_bits", I64, "64 bits", "or; distinct vehicles are about -64 ln(share of zeros)"),
    Field("mu_count", I64, "-", "observations that said mu; add"),
    Field("mu_sum", F64, "-", "sum of mu; add"),
    Field("mu_sum_squares", F64, "-", "sum of squares of mu; add"),
    Field("mu_min", F32, "-", "least mu; +inf where none was said; take the least"),
    Field("mu_max", F32, "-", "largest mu; -inf where none was said; take the largest"),
    Field("utilised_max", F32, "-", "largest grip used: mu was at least this; take the largest"),
    Field(
        "mu_histogram",
        pa.list_(I32),
        "-",
        "counts of mu on the 32 bins of the friction grid; add per bin",
    ),
    Field("value_count", I64, "-", "values: observations that used enough of mu to tell it; add"),
    Field("value_sum", F64, "-", "sum of mu of the values; add"),
    Field(
        "log_likelihood_sum",
        pa.list_(I32),
        "1/16 nat",
        "sum of log_likelihood on the 32 bins; add per bin",
    ),
)

ESTIMATES: Final = (
    Field("t", F64, "s", "of the sample"),
    Field("vx", F64, "m/s", "longitudinal speed at the centre of gravity"),
    Field("vy", F64, "m/s", "lateral speed at the centre of gravity"),
    Field("yaw_rate", F64, "rad/s", "positive to the left"),
    Field("sideslip", F64, "rad", "atan2(vy, vx)"),
    Field("vx_std", F64, "m/s", "standard deviation"),
    Field("vy_std", F64, "m/s", "standard deviation"),
    Field("yaw_rate_std", F64, "rad/s", "standard deviation"),
    Field("sideslip_std", F64, "rad", "standard deviation"),
    Field("mu", F64, "-", "median"),
    Field("mu_lower", F64, "-", "5 % quantile"),
    Field("mu_upper", F64, "-", "95 % quantile"),
    *(
        Field(
            f"{wheel}{end}", F64, "-", f"{what} of this wheel; null where the estimator has one mu"
        )
        for wheel in per_wheel("mu")
        for end, what in (("", "median"), ("_lower", "5 % quantile"), ("_upper", "95 % quantile"))
    ),
    Field("mu_utilised", F64, "-", "largest grip used in the last second, any wheel"),
    Field("innovation_nis", F64, "-", "normalised innovation squared over its degrees of freedom"),
    Field("adaptation", F64, "-", "factor on the measurement noise covariance"),
    Field("health", I32, "flags", "schemas.signals.Health"),
)

SIGNAL_LOG: Final = (
    Field("t", F64, "s", "of the sample, increasing"),
    *(Field(name, F64, unit, "null or NaN is a missing reading") for name, unit in UNITS.items()),
)
# Columns that a signal log may have beside these.
SIGNAL_LOG_CONTEXT: Final = tuple(
    Field(name, F64, unit, "null or NaN is unknown; the column may be missing")
    for name, unit in CONTEXT_UNITS.items()
)


def arrow_schema(*fields: Field) -> pa.Schema:
    """Return the Arrow schema of columns, with unit and meaning in the field metadata."""
    return pa.schema(
        [pa.field(f.name, f.type, metadata={"unit": f.unit, "meaning": f.meaning}) for f in fields]
    )


CELL_HOUR_SCHEMA: Final = arrow_schema(*CELL_HOUR)


def stored_columns(*fields: Field) -> tuple[Field, ...]:
    """Return columns as they are stored on disk: times in microseconds."""
    return tuple(
        f._replace(type=US, unit="us since 1970, UTC") if f.type == NS else f for f in fields
    )


MAP_SCHEMA: Final = arrow_schema(*MAP_CELL)
ESTIMATES_SCHEMA: Final = arrow_schema(*ESTIMATES)
MAP_KEPT: Final = stored_columns(*MAP_CELL, Field("snapshot_time", NS, "", "when the map was so"))
MAP_ARCHIVE: Final = arrow_schema(*MAP_KEPT)
OBSERVATION_KEPT: Final = stored_columns(*OBSERVATION, *IDENTITY, *BOOKKEEPING, VALUE)
OBSERVATION_ARCHIVE: Final = arrow_schema(*OBSERVATION_KEPT)
WEATHER_ARCHIVE: Final = arrow_schema(*stored_columns(*WEATHER))
STATE_CELL: Final = Field("cell", I64, "quadint z21", "cell of the position")
STATE_ARCHIVE: Final = arrow_schema(
    *stored_columns(*STATE, *IDENTITY, STATE_CELL, *BOOKKEEPING[:1])
)
