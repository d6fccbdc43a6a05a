"""Reader of a recorded drive: a Parquet signal log, delivered as blocks (consecutive samples) of
one vehicle.

Required columns: `t` [s] or `timestamp`; ax, ay, yaw_rate; the four omega; delta_fl or delta_fr.
Each of them must have at least one reading. The other channels may be missing, and NaN or null is a
missing reading in any column. A front wheel without a steering column gets the angle of the other
front wheel; for rear wheels without a column the angle is zero. Context signals
(`schemas.signals.CONTEXT`) are optional. `timestamp` is an Arrow timestamp, or a number: integer
[ns] or float [s] since 1970 UTC. Time may repeat (the estimator reports this in `health`) but not
go backwards. A position at exactly 0°, 0° is a missing reading.
"""

from __future__ import annotations

import shlex
from collections.abc import Collection, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq

from edge_agent.inputs.block import Block, to_utc_ns
from edge_agent.inputs.context import context_values
from edge_agent.inputs.log_columns import (
    FRONT_STEERING,
    GROUND,
    NEEDED,
    fill_steering,
    remove_null_positions,
)
from edge_agent.inputs.units import FIRST_DATE, LAST_DATE, TIME_UNITS
from schemas.errors import InputError
from schemas.numeric import FloatArray, IntArray
from schemas.signals import CHANNELS, CONTEXT
from schemas.thresholds import NS

# 2.4 MB of signals. This bounds the memory, and is long enough to make the cost per block
# negligible.
BLOCK_ROWS: Final = 16_384
# [ns] A log in ns has less than 3300 samples a second, and a log in us more than 3.
SHORTEST_STEP_NS: Final = 300_000
PARQUET: Final = b"PAR1"  # first bytes of a Parquet file
LONGEST_HEADER: Final = 4096  # [bytes] of the first line of a CSV file that are read


@dataclass(frozen=True)
class SignalLog:
    """A signal log in memory. `t` (T,) [s] are the times as recorded and `signals` (T, channels)
    the readings. `start_ns` is the time [ns UTC] of t = 0 if the log states it, else None.
    """

    t: FloatArray
    signals: FloatArray
    start_ns: int | None
    # speed over ground (T,) [m/s], if the log contains the speed of a position receiver
    ground: FloatArray | None = None
    # context signals (T, len(CONTEXT)), if the log has a column of them
    context: FloatArray | None = None
    # True if both front columns contain the one angle that was measured, the mean of both wheels
    has_one_front_angle: bool = False

    def blocks(self, start_ns: int, rows: int = BLOCK_ROWS) -> Iterator[Block]:
        """Yield the samples of the signal log in order, in blocks of at most `rows` samples.
        `start_ns` is the time [ns UTC] of t = 0.
        """
        for first in range(0, len(self.t), rows):
            t = self.t[first : first + rows, None]
            context = None if self.context is None else self.context[first : first + rows, None]
            yield Block(
                t, to_utc_ns(t, start_ns), self.signals[first : first + rows, None], context
            )


def read_log(path: Path) -> SignalLog:
    """Read and check a signal log.

    Raises:
        InputError: the log is not valid. The error names log, column (and row) and fix. Reasons:
            - The file is not a readable Parquet file, or has no rows.
            - A required column is missing, or has no reading.
            - A column is not numeric, or occurs twice.
            - A time is missing, or time goes backwards.
    """
    table = _read_table(path)
    if not table.num_rows:
        raise InputError("log", f"{path} has no rows", "give a log with at least one sample")
    try:
        return _parse_table(table)
    except InputError as error:
        raise InputError(error.field, f"{error.problem} ({path})", error.fix) from error


def _parse_table(table: pa.Table) -> SignalLog:
    t, start_ns = _read_time(table)
    signals = np.full((table.num_rows, len(CHANNELS)), np.nan)
    for index, name in enumerate(CHANNELS):
        if name in table.column_names:
            signals[:, index] = _float_column(table, name)
    signals[np.isinf(signals)] = np.nan
    _check_log(table, signals)
    has_one_front_angle = fill_steering(signals, table.column_names)
    remove_null_positions(signals)
    ground = _float_column(table, GROUND) if GROUND in table.column_names else None
    return SignalLog(t, signals, start_ns, ground, _read_context(table), has_one_front_angle)


def require_log(path: Path) -> None:
    """Raise an error if `path` is no signal log. Commands call this before they look for the
    vehicle file next to a log.

    Raises:
        InputError: there is no such file, it is not a Parquet file, or it contains estimates.
    """
    if not path.exists():
        raise InputError("log", f"{path} does not exist", "give the path of a signal log")
    if path.is_dir():
        fix = f"name the logs in it, or convert a ROS bag with {conversion_command(path)}"
        raise InputError("log", f"{path} is a folder", fix)
    if not path.is_file():
        return
    try:
        with path.open("rb") as file:
            header = file.readline(LONGEST_HEADER)
        is_parquet = header.startswith(PARQUET)
        names = set(pq.read_schema(path).names) if is_parquet else _csv_names(header)
    except (OSError, pa.ArrowException) as error:
        raise _not_parquet(path, str(error).splitlines()[0]) from error
    require_no_estimates(path, names)
    if not is_parquet:
        raise _not_parquet(path, "its first bytes are not PAR1")


def require_no_estimates(path: Path, names: Collection[str]) -> None:
    """Raise an error if `names`, the columns of the file `path`, are those of estimates.

    Raises:
        InputError: the file was written by `edge-agent replay`.
    """
    if "mu_lower" in names and "ax" not in names:
        raise InputError(
            "log",
            f"{path} contains estimates, not signals",
            "give the signal log from which they were estimated",
        )


def conversion_command(path: Path) -> str:
    """Return the command that converts a recording to a signal log."""
    words = [str(path), "--out", str(path.with_suffix(".parquet"))]
    return f"edge-agent import {shlex.join(words)}"


def _not_parquet(path: Path, reason: str) -> InputError:
    problem = f"{path} is not a Parquet file ({reason})"
    if path.suffix == ".parquet":
        return InputError("log", problem, "copy it again, or import its recording again")
    return InputError("log", problem, f"convert it with {conversion_command(path)}")


def _csv_names(header: bytes) -> set[str]:
    """Return the column names in the first line of a CSV file."""
    return {name.strip(' "') for name in header.decode(errors="replace").strip().split(",")}


def _read_table(path: Path) -> pa.Table:
    require_log(path)
    try:
        with pq.ParquetFile(path) as file:
            names = file.schema_arrow.names
            used = [
                name for name in ("t", "timestamp", GROUND, *CHANNELS, *CONTEXT) if name in names
            ]
            for name in used:
                if names.count(name) > 1:
                    problem = f"{path} has this column {names.count(name)} times"
                    raise InputError(name, problem, "keep one of them")
            return file.read(columns=used)
    except (OSError, pa.ArrowException) as error:
        raise _not_parquet(path, str(error).splitlines()[0]) from error


def _read_context(table: pa.Table) -> FloatArray | None:
    """Return the context signals of a log (controller flags, air temperature, wiper), (T,
    len(CONTEXT)). Return None if the log has no context column.
    """
    if not set(CONTEXT) & set(table.column_names):
        return None
    context = np.full((table.num_rows, len(CONTEXT)), np.nan)
    for index, name in enumerate(CONTEXT):
        if name in table.column_names:
            context[:, index] = context_values(name, _float_column(table, name), None)
    return context


def _float_column(table: pa.Table, name: str) -> FloatArray:
    """Return the column `name` of a table as float64 (n,), with NaN for null.

    The result is a writable copy. Arrow's own array is read-only, and numba would compile a second
    version of each function for it. Only a column of another type is cast, because the first cast
    imports `pyarrow.compute`, a fifteenth of the time of a start.
    """
    values: Any = table[name]
    try:
        if values.type != pa.float64():
            values = values.cast(pa.float64())
    except pa.ArrowException as error:
        raise InputError(
            name, f"is {values.type}, not a number", "write the column as float64"
        ) from error
    return np.array(values.to_numpy(zero_copy_only=False), dtype=np.float64)


def _read_time(table: pa.Table) -> tuple[FloatArray, int | None]:
    """Return the times t (n,) [s] of a signal log, and the time of t = 0 [ns UTC]; the latter is
    None for a log that has only the column `t`.
    """
    name = next((name for name in ("t", "timestamp") if name in table.column_names), None)
    if name is None:
        raise InputError(
            "t", "the log has neither t nor timestamp", "add the time of each sample, t in seconds"
        )
    if name == "t":
        t = _float_column(table, name)
        start_ns = None
    else:
        t, start_ns = _seconds_from_first(table[name])
    bad = np.flatnonzero(~np.isfinite(t))
    if len(bad):
        raise InputError(name, f"row {bad[0]} has no time", "give every sample its time")
    back = np.flatnonzero(np.diff(t) < 0)
    if len(back):
        raise InputError(name, f"goes back at row {back[0] + 1}", "sort the log by time")
    return t, start_ns


# Arrow columns have no generic type.
def _seconds_from_first(column: Any) -> tuple[FloatArray, int | None]:  # noqa: ANN401
    """Convert the column `timestamp` of a signal log. Return the seconds (n,) since the first
    sample, and the time of that sample [ns UTC], or None if it is not finite.
    """
    if column.null_count:
        row = int(np.flatnonzero(column.is_null().to_numpy(zero_copy_only=False))[0])
        raise InputError("timestamp", f"row {row} has no time", "give every sample its time")
    kind = column.type
    if pa.types.is_timestamp(kind):
        column = column.cast(pa.timestamp("ns", tz=kind.tz)).cast(pa.int64())
    elif not pa.types.is_integer(kind) and not pa.types.is_floating(kind):
        raise InputError(
            "timestamp", f"is {kind}, not a time", "write an Arrow timestamp, or ns as int64"
        )
    values = np.asarray(column.to_numpy(zero_copy_only=False))
    if pa.types.is_floating(kind):
        first = float(values[0])
        t = np.asarray(values - first, dtype=np.float64)
        start_ns = round(first * NS) if np.isfinite(first) else None
    else:
        start_ns = int(values[0])
        _require_nanoseconds(values)
        t = (values - values[0]) / NS
    if start_ns is not None and abs(start_ns) > np.iinfo(np.int64).max:
        raise InputError(
            "timestamp", "is beyond the year 2262", "write ns as int64, or seconds as float64"
        )
    return t, start_ns


def _require_nanoseconds(values: IntArray) -> None:
    """Raise an InputError if the times (n,) of a log, taken as ns since 1970, are too dense, but
    begin with a date in a larger unit.
    """
    first = int(values[0])
    if int(values[-1]) - first >= SHORTEST_STEP_NS * (len(values) - 1):
        return
    for unit, factor in TIME_UNITS.items():
        is_date = FIRST_DATE < first * factor < LAST_DATE
        if is_date and unit != "ns":
            fix = f"multiply it by {round(factor * NS)}, or use edge-agent import"
            raise InputError("timestamp", f"is a date in {unit}, not in ns", fix)


def _check_log(table: pa.Table, signals: FloatArray) -> None:
    for name in NEEDED:
        if name not in table.column_names:
            raise InputError(
                name, "the log has no such column", "add it in SI units, or use edge-agent import"
            )
        if np.isnan(signals[:, CHANNELS.index(name)]).all():
            raise InputError(
                name, "has no reading in any row", "record the channel, or correct its conversion"
            )
    front = [name for name in FRONT_STEERING if name in table.column_names]
    if not front:
        raise InputError(
            FRONT_STEERING[0], "the log has no such column", f"add it or {FRONT_STEERING[1]} [rad]"
        )
    if all(np.isnan(signals[:, CHANNELS.index(name)]).all() for name in front):
        raise InputError(
            front[0], "has no reading in any row", "record the channel, or correct its conversion"
        )
