"""Every table of the contract: name, type, unit and meaning of each column, and the Arrow schemas made from them."""

from __future__ import annotations

from typing import Final, NamedTuple

import pyarrow as pa

from schemas import mugrid
from schemas.signals import UNITS, per_wheel


class Field(NamedTuple):
    """One column."""

    name: str
    type: pa.DataType
    unit: str
    meaning: str


NS = pa.timestamp("ns", tz="UTC")
LIKELIHOOD = pa.binary(mugrid.BINS)
F32, F64, I8, I32, I64 = pa.float32(), pa.float64(), pa.int8(), pa.int32(), pa.int64()

_MU = (
    Field("mu", F32, "-", "peak adhesion coefficient, median; NaN where not said"),
    Field("mu_lower", F32, "-", "5 % quantile of mu"),
    Field("mu_upper", F32, "-", "95 % quantile of mu"),
)
_POSE = (
    Field("latitude", F64, "deg", "WGS 84"),
    Field("longitude", F64, "deg", "WGS 84"),
    Field("position_std", F32, "m", "standard deviation of the position, each axis"),
    Field("yaw", F32, "rad", "counter-clockwise from east"),
)

# What one vehicle learned about one cell in one visit.
OBSERVATION: Final = (
    Field("enter_time", NS, "ns since 1970, UTC", "first sample in the cell"),
    Field("leave_time", NS, "ns since 1970, UTC", "last sample in the cell"),
    Field("cell", I64, "quadint z21", "the cell"),
    Field("sector", I8, "0 east, 1 north, 2 west, 3 south", "heading sector"),
    *_POSE,
    Field("yaw_std", F32, "rad", "standard deviation of yaw"),
    Field("speed", F32, "m/s", "mean speed over the visit"),
    *_MU,
    Field("mu_utilised", F32, "-", "largest grip used in the visit, any wheel: mu is at least this"),
    Field("log_likelihood", LIKELIHOOD, "1/16 nat below the maximum",
          "log p(measurements | mu) on the 32 bins of the friction grid; absent where the sender has none"),
    Field("health", I32, "flags", "schemas.signals.Health"),
    Field("tyre_season", I8, "0 unknown, 1 summer, 2 winter, 3 all-season", "tyres of the vehicle"),
    Field("air_temperature", F32, "degC", "outside; NaN where not measured"),
    Field("abs_active", I8, "-1 unknown, 0 no, 1 yes", "a slip controller intervened"),
)  # fmt: skip

# Where a vehicle was and how it moved.
STATE: Final = (
    Field("time", NS, "ns since 1970, UTC", "of the sample"),
    *_POSE,
    Field("vx", F32, "m/s", "longitudinal speed at the centre of gravity"),
    Field("vy", F32, "m/s", "lateral speed at the centre of gravity"),
    Field("yaw_rate", F32, "rad/s", "positive to the left"),
    Field("sideslip", F32, "rad", "atan2(vy, vx)"),
    *_MU,
    Field("health", I32, "flags", "schemas.signals.Health"),
)

# Who sent a row: the identity of its batch. In the archive the vehicle is a keyed hash.
IDENTITY: Final = (
    Field("vehicle", pa.string(), "-", "enrolled name on the wire; keyed hash in the archive"),
    Field("boot", I64, "-", "random, drawn at each start of the agent"),
    Field("region", I64, "quadint z10", "region of the batch"),
    Field("seq", I64, "-", "dense from 1 per (boot, kind, region)"),
    Field("row", I32, "-", "place in the batch, from 0"),
    Field("first_held", I64, "-", "lowest seq still in the sender's spool"),
    Field("estimator", pa.string(), "-", "name of the estimator"),
)

# What the service adds when it keeps a row.
BOOKKEEPING: Final = (
    Field("received_at", NS, "ns since 1970, UTC", "clock of the service"),
    Field("late", pa.bool_(), "-", "later than the lateness window: archived, not fused"),
    Field("weight", F32, "-", "weight of the vehicle's vote that was used"),
)

MAP_CELL: Final = (
    Field("cell", I64, "quadint z21", "the cell"),
    Field("sector", I8, "0 east, 1 north, 2 west, 3 south", "heading sector"),
    Field("mu", F32, "-", "peak adhesion coefficient, median"),
    Field("mu_lower", F32, "-", "5 % quantile"),
    Field("mu_upper", F32, "-", "95 % quantile"),
    Field("p_slippery", F32, "-", "P(mu < 0.4)"),
    Field("basis", pa.string(), "measured | bound | borrowed", "what the value rests on; bound: only lower bounds"),
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
    Field("safe_deceleration", F32, "m/s^2", "what the road bears with 95 % probability, g mu_lower; level road"),
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
        Field(f"{wheel}{end}", F64, "-", f"{what} of this wheel; null where the estimator has one mu")
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


def arrow_schema(*fields: Field) -> pa.Schema:
    """Arrow schema of columns, with unit and meaning in the field metadata."""
    return pa.schema([pa.field(f.name, f.type, metadata={"unit": f.unit, "meaning": f.meaning}) for f in fields])


MAP_SCHEMA: Final = arrow_schema(*MAP_CELL)
ESTIMATES_SCHEMA: Final = arrow_schema(*ESTIMATES)
OBSERVATION_ARCHIVE: Final = arrow_schema(*OBSERVATION, *IDENTITY, *BOOKKEEPING)
STATE_CELL: Final = Field("cell", I64, "quadint z21", "cell of the position")
STATE_ARCHIVE: Final = arrow_schema(*STATE, *IDENTITY, STATE_CELL, *BOOKKEEPING[:1])
