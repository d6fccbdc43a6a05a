"""All tables of the contract: name, type, unit and meaning of each column, and the Arrow schemas of
the tables.
"""

from __future__ import annotations

from typing import Final, NamedTuple

import pyarrow as pa

from schemas import message_columns, mugrid
from schemas.signals import CONTEXT_UNITS, UNITS, per_wheel
from schemas.thresholds import EXCITED_SHARE, SLIPPERY_MU


class Field(NamedTuple):
    """One column of a table.

    Attributes:
        name, type, unit, meaning: name of the column, Arrow type, unit, and meaning in words.
        step: the service rounds stored values to multiples of this step; None: no rounding. The
            step is a power of two far below the value's uncertainty. Finer digits are noise and
            would take a quarter more bytes.
        range: smallest and largest value that a report may contain; NaN means 'absent'. None for
            columns that vehicles do not report.
    """

    name: str
    type: pa.DataType
    unit: str
    meaning: str
    step: float | None = None
    range: tuple[float, float] | None = None


NS = pa.timestamp("ns", tz="UTC")
# Resolution of archived times: Spark cannot read nanoseconds from Parquet.
US = pa.timestamp("us", tz="UTC")
LIKELIHOOD = pa.binary(mugrid.BINS)
F32 = pa.float32()
F64 = pa.float64()
I8 = pa.int8()
I32 = pa.int32()
I64 = pa.int64()

_ARROW: Final = {
    message_columns.TIME: NS,
    message_columns.LIKELIHOOD: LIKELIHOOD,
    message_columns.F32: F32,
    message_columns.F64: F64,
    message_columns.I8: I8,
    message_columns.I32: I32,
    message_columns.I64: I64,
}


def _make_field(column: message_columns.MessageColumn) -> Field:
    """Return the table column for a message's column: the same name, unit and meaning, with an
    Arrow type.
    """
    return Field(**column._asdict() | {"type": _ARROW[column.type]})


OBSERVATION: Final = tuple(_make_field(column) for column in message_columns.OBSERVATION)
STATE: Final = tuple(_make_field(column) for column in message_columns.STATE)

# Identity of the batch that a row came from. In the archive the vehicle name is a keyed hash.
IDENTITY: Final = (
    Field("vehicle", pa.string(), "-", "enrolled name in a message; keyed hash in the archive"),
    Field(
        "boot",
        I64,
        "-",
        "hash of the agent's start time, with the month's key; in older archives the start time",
    ),
    Field("region", I64, "quadint z10", "region to which the batch was sent"),
    Field("seq", I64, "-", "number of the batch: 1, 2, 3, … per (boot, kind, region)"),
    Field("row", I32, "-", "index of the row in its batch, from 0"),
    Field("first_held", I64, "-", "lowest seq that the sender still held when it sent the batch"),
    Field("estimator", pa.string(), "-", "name of the estimator"),
)

# Columns that the service adds when it stores a row.
BOOKKEEPING: Final = (
    Field("received_at", NS, "ns since 1970, UTC", "time of receipt, clock of the service"),
    Field(
        "late",
        pa.bool_(),
        "-",
        "true if not fused in time; fused as an old report if late_by > 0",
    ),
    Field("weight", F32, "-", "weight with which the fusion counted the row"),
    Field(
        "late_by",
        I64,
        "ns",
        "time from leave_time until a late row was fused; 0 if in time or not fused",
    ),
    Field("bias", F32, "-", "relative bias of the vehicle that the fusion corrected"),
    Field("bias_std", F32, "-", "standard deviation of bias"),
    Field(
        "spread",
        F32,
        "-",
        "factor on the standard deviation that the vehicle states, as used by the fusion",
    ),
    Field(
        "slope",
        F32,
        "-",
        "correction that the fusion used: error of mu per unit of grip left unused",
    ),
)

# True if mu was measured. Otherwise mu is mostly the prior and only `mu_utilised` is informative.
VALUE: Final = Field(
    "value",
    pa.bool_(),
    "-",
    f"true if mu was measured: at least {EXCITED_SHARE:g} of it was used; false: lower bound only",
)

# Road weather of a region: as received, and as the map uses it.
WEATHER: Final = (
    Field("region", I64, "quadint z10", "region"),
    Field("time", NS, "ns since 1970, UTC", "start of validity"),
    Field("air_temperature", F32, "degC", "air temperature; NaN if unknown"),
    Field("road_temperature", F32, "degC", "temperature of the road surface; NaN if unknown"),
    Field("precipitation", F32, "mm/h", "precipitation as water; NaN if unknown"),
    Field(
        "prior",
        pa.list_(F32),
        "-",
        "prior probabilities of the 32 bins of the friction grid; null if none was given",
    ),
    Field("received_at", NS, "ns since 1970, UTC", "time of receipt, clock of the service"),
    Field(
        "acts_from",
        NS,
        "ns since 1970, UTC",
        "time from which the map used it; no later observation had been fused",
    ),
)

MAP_CELL: Final = (
    Field("cell", I64, "quadint z21", "map cell, about 19 m wide at the equator"),
    Field("sector", I8, "0 east, 1 north, 2 west, 3 south", "heading sector"),
    Field("mu", F32, "-", "peak adhesion coefficient, median; null if only lower bounds are known"),
    Field("mu_lower", F32, "-", "5 % quantile of mu"),
    Field("mu_upper", F32, "-", "95 % quantile of mu"),
    Field("p_slippery", F32, "-", f"P(mu < {SLIPPERY_MU})"),
    Field(
        "basis",
        pa.string(),
        "measured | bound | borrowed",
        "source of the value; bound: only lower bounds; borrowed: from neighbouring cells",
    ),
    Field("vehicles", I32, "-", "number of distinct vehicles"),
    Field("observations", I64, "-", "number of observations"),
    Field("first_time", NS, "ns since 1970, UTC", "time of the first observation"),
    Field("last_time", NS, "ns since 1970, UTC", "time of the last observation"),
    Field("age_s", F32, "s", "time from the last observation until the tile was made"),
    Field("latitude", F64, "deg", "latitude of the cell's centre"),
    Field("longitude", F64, "deg", "longitude of the cell's centre"),
    Field("west", F64, "deg", "western border of the cell"),
    Field("south", F64, "deg", "southern border of the cell"),
    Field("east", F64, "deg", "eastern border of the cell"),
    Field("north", F64, "deg", "northern border of the cell"),
    Field(
        "safe_deceleration",
        F32,
        "m/s^2",
        "deceleration that a level road allows with 95 % probability: g mu_lower",
    ),
)

# Statistics of one cell, sector and hour. Several rows of the same hour are merged; each column's
# meaning says how.
CELL_HOUR: Final = (
    Field("cell", I64, "quadint z21", "map cell, about 19 m wide at the equator"),
    Field("sector", I8, "0 east, 1 north, 2 west, 3 south", "heading sector"),
    Field("hour", US, "us since 1970, UTC", "start of the hour that contains leave_time"),
    Field("observations", I64, "-", "number of observations; add"),
    Field("late", I64, "-", "number of observations that were not fused in time; add"),
    Field("vehicles", I64, "-", "distinct vehicles of this row; cannot be added, see vehicle_bits"),
    Field(
        "vehicle_bits", I64, "64 bits", "vehicles, about -64 ln(share of zero bits); combine by OR"
    ),
    Field("mu_count", I64, "-", "number of observations with mu; add"),
    Field("mu_sum", F64, "-", "sum of mu; add"),
    Field("mu_sum_squares", F64, "-", "sum of squares of mu; add"),
    Field("mu_min", F32, "-", "smallest mu, +inf if there is none; take the minimum"),
    Field("mu_max", F32, "-", "largest mu, -inf if there is none; take the maximum"),
    Field("utilised_max", F32, "-", "largest grip used, so mu was at least this; take the maximum"),
    Field(
        "mu_histogram",
        pa.list_(I32),
        "-",
        "counts of mu on the 32 bins of the friction grid; add per bin",
    ),
    Field("value_count", I64, "-", "observations that used enough grip to measure mu; add"),
    Field("value_sum", F64, "-", "sum of mu of these observations; add"),
    Field(
        "log_likelihood_sum",
        pa.list_(I32),
        "1/16 nat",
        "sum of log_likelihood on the 32 bins; add per bin",
    ),
)

ESTIMATES: Final = (
    Field("t", F64, "s", "time of the sample"),
    Field("vx", F64, "m/s", "longitudinal speed at the centre of gravity"),
    Field("vy", F64, "m/s", "lateral speed at the centre of gravity"),
    Field("yaw_rate", F64, "rad/s", "positive to the left"),
    Field("sideslip", F64, "rad", "atan2(vy, vx)"),
    Field("vx_std", F64, "m/s", "standard deviation of vx"),
    Field("vy_std", F64, "m/s", "standard deviation of vy"),
    Field("yaw_rate_std", F64, "rad/s", "standard deviation of yaw_rate"),
    Field("sideslip_std", F64, "rad", "standard deviation of sideslip"),
    Field("mu", F64, "-", "peak adhesion coefficient, median"),
    Field("mu_lower", F64, "-", "5 % quantile of mu"),
    Field("mu_upper", F64, "-", "95 % quantile of mu"),
    Field("p_slippery", F64, "-", f"P(mu < {SLIPPERY_MU})"),
    *(
        Field(
            f"{wheel}{end}",
            F64,
            "-",
            f"{statistic} of mu at this wheel; null if there is one mu for all",
        )
        for wheel in per_wheel("mu")
        for end, statistic in (
            ("", "median"),
            ("_lower", "5 % quantile"),
            ("_upper", "95 % quantile"),
        )
    ),
    Field("mu_utilised", F64, "-", "largest grip that any wheel used in the last second"),
    Field("innovation_nis", F64, "-", "normalised innovation squared over its degrees of freedom"),
    Field("adaptation", F64, "-", "factor on the measurement noise covariance, set by the filter"),
    Field("health", I32, "flags", "bits of schemas.signals.Health"),
)

SIGNAL_LOG: Final = (
    Field("t", F64, "s", "time of the sample, increasing"),
    *(Field(name, F64, unit, "null or NaN: missing reading") for name, unit in UNITS.items()),
)
# Optional additional columns of a signal log.
SIGNAL_LOG_CONTEXT: Final = tuple(
    Field(name, F64, unit, "null or NaN: unknown; the column may be missing")
    for name, unit in CONTEXT_UNITS.items()
)


def arrow_schema(*fields: Field) -> pa.Schema:
    """Return the Arrow schema of the given columns, with unit and meaning in the field metadata."""
    return pa.schema(
        [pa.field(f.name, f.type, metadata={"unit": f.unit, "meaning": f.meaning}) for f in fields]
    )


CELL_HOUR_SCHEMA: Final = arrow_schema(*CELL_HOUR)


def stored_columns(*fields: Field) -> tuple[Field, ...]:
    """Return the given columns with the types in which they are stored on disk: times in
    microseconds instead of nanoseconds, others unchanged.
    """
    return tuple(
        f._replace(type=US, unit="us since 1970, UTC") if f.type == NS else f for f in fields
    )


MAP_SCHEMA: Final = arrow_schema(*MAP_CELL)
ESTIMATES_SCHEMA: Final = arrow_schema(*ESTIMATES)
MAP_KEPT: Final = stored_columns(*MAP_CELL, Field("snapshot_time", NS, "", "time of the snapshot"))
MAP_ARCHIVE: Final = arrow_schema(*MAP_KEPT)
OBSERVATION_KEPT: Final = stored_columns(*OBSERVATION, *IDENTITY, *BOOKKEEPING, VALUE)
OBSERVATION_ARCHIVE: Final = arrow_schema(*OBSERVATION_KEPT)
WEATHER_ARCHIVE: Final = arrow_schema(*stored_columns(*WEATHER))
STATE_CELL: Final = Field("cell", I64, "quadint z21", "map cell that contains the position")
STATE_ARCHIVE: Final = arrow_schema(
    *stored_columns(*STATE, *IDENTITY, STATE_CELL, *BOOKKEEPING[:1])
)
