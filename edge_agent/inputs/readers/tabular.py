"""Reader of tables (CSV and Parquet) with one row per sample; every numeric column becomes a
recorded signal.

The time column is `t` [s], `timestamp`, or a column with a name such as `time`. The name of a
column may contain its unit: `speed [km/h]`.
"""

from __future__ import annotations

import codecs
import re
from collections import Counter
from collections.abc import Sequence
from contextlib import suppress
from pathlib import Path
from typing import Any, Final, Literal

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc
import pyarrow.csv as pc_csv
import pyarrow.parquet as pq

from edge_agent.inputs.readers.racelogic import convert_vbo, has_vbo_columns
from edge_agent.inputs.recording import Recording, Series, foreign_errors
from edge_agent.inputs.units import FIRST_DATE, LAST_DATE, TIME_UNITS
from schemas.errors import InputError
from schemas.numeric import FloatArray
from schemas.thresholds import NS

SUFFIXES: Final = (".csv", ".tsv", ".txt", ".parquet")
TIMES: Final = (
    "t",
    "timestamp",
    "time",
    "time_s",
    "time_ms",
    "t_ms",
    "timestamp_ns",
    "zeit",
    "sec",
    "seconds",
)
UNIT_SPELLINGS: Final = {
    "s": ("s", "sec", "secs", "second", "seconds"),
    "ms": ("ms", "msec", "millisecond", "milliseconds"),
    "us": ("us", "usec", "\u00b5s", "\u03bcs", "microsecond", "microseconds"),
    "ns": ("ns", "nsec", "nanosecond", "nanoseconds"),
}
# [s] Time steps beyond these suggest that the unit of the numbers is not the assumed one.
LONGEST_STEP_S: Final = 2.0
SHORTEST_STEP_S: Final = 1e-4
DAY_BACK_S: Final = 43_200.0  # [s] a larger step back is midnight
MOST_NAMES: Final = 20  # maximum number of column names in an error message
MOST_LETTERS: Final = 60  # maximum length of one column name in an error message
RACECHRONO: Final = "racechrono"
LONGEST_PREAMBLE: Final = 50  # [lines] maximum length of the text before the table
_WORD: Final = re.compile(r"[a-z]+")
_UNIT: Final = re.compile(r"^(?P<name>.*)[\[(](?P<unit>[^\[\](]*)[\])]\s*$")


def read_table(path: Path, time: str | None = None, time_unit: str | None = None) -> Recording:
    """Return the columns of a CSV or Parquet table as a recording.

    Args:
        path: a CSV or Parquet file.
        time: name of the time column; by default it is found by its name.
        time_unit: unit of numbers in the time column: s, ms, us, ns; by default it follows from the
            column's name or from the size of the numbers.

    Raises:
        InputError: the file is broken or empty, has no time column, or its time goes backwards.
    """
    kind = "Parquet" if path.suffix.lower() == ".parquet" else "CSV"
    with foreign_errors(path, kind):
        return _read_recording(path, kind, time, time_unit)


def _read_recording(path: Path, kind: str, time: str | None, time_unit: str | None) -> Recording:
    table, notes = (pq.ParquetFile(path).read(), []) if kind == "Parquet" else _read_csv(path)
    if not table.num_rows:
        raise InputError(
            "source", f"{path} has no rows", "give a recording with at least one sample"
        )
    table = table.rename_columns(_make_distinct(table.column_names))
    numbers = {
        name: values
        for name in table.column_names
        if (values := _parse_numbers(table[name])) is not None
    }
    stripped = {name.strip(): values for name, values in numbers.items()}
    if has_vbo_columns(stripped):
        return convert_vbo(path, stripped, {})
    titles = _plain_names(table.column_names)
    column = _time_column(path, titles, time)
    title = titles[column]
    unit = time_unit or _unit_in(title) or None
    t, start_ns = _parse_seconds(table[title], column, unit)
    _check_order(column, t)
    time_type = table[title].type
    notes += [f"{path.name}: {doubt}" for doubt in _time_doubts(column, time_type, t, unit)]
    has_zone = pa.types.is_timestamp(time_type) and time_type.tz is not None
    recording = Recording(path.name, {}, start_ns, rows=True, notes=notes, has_zone=has_zone)
    left = []
    for name, title in titles.items():
        if name == column:
            continue
        if title in numbers:
            recording.signals[name] = Series(t, numbers[title], _unit_in(title))
        elif not pa.types.is_null(table[title].type):
            left.append(f"{name} ({_first_text(table[title])!r})")
    if not recording.signals:
        problem = f"{path} has no column of numbers except the time: {', '.join(left[:MOST_NAMES])}"
        raise InputError("source", problem, "write numbers with a decimal point, without units")
    if left:
        notes.append(f"{path.name}: left out, not only numbers: {', '.join(left[:MOST_NAMES])}")
    return recording


def _read_csv(path: Path) -> tuple[pa.Table, list[str]]:
    """Return the table in a CSV file, and notes on rows that were left out.

    Raises:
        InputError: most rows have another number of columns than the first line.
    """
    with path.open("rb") as file:
        head = b"".join(file.readline(65_536) for _ in range(LONGEST_PREAMBLE))
    encoding = _guess_encoding(head)
    lines = head.decode(encoding, errors="replace").splitlines() or [""]
    if RACECHRONO in lines[0].lower():
        return _read_racechrono(path, lines), []
    mark = max(",;\t", key=lines[0].count)
    cut = []

    def skip_row(row: pc_csv.InvalidRow) -> Literal["skip"]:
        cut.append(row)
        return "skip"

    table = pc_csv.read_csv(
        path,
        read_options=pc_csv.ReadOptions(encoding=encoding),
        parse_options=pc_csv.ParseOptions(delimiter=mark, invalid_row_handler=skip_row),
        convert_options=pc_csv.ConvertOptions(strings_can_be_null=True),
    )
    if len(cut) > table.num_rows:
        raise InputError(
            "source",
            f"{path}: a row has {cut[0].actual_columns} columns, the first line has "
            f"{cut[0].expected_columns}",
            "export it with the column names in the first line",
        )
    if mark != ",":
        table = _convert_decimal_commas(table)
    notes = [f"{path.name}: {len(cut)} incomplete rows left out"] if cut else []
    return table, notes


def _convert_decimal_commas(table: pa.Table) -> pa.Table:
    """Convert the text columns of a table that contain only numbers, or only times, with decimal
    commas.
    """
    for index, name in enumerate(table.column_names):
        if not pa.types.is_string(table[name].type):
            continue
        text = pc.replace_substring(table[name], ",", ".")
        for kind in (pa.timestamp("ns", "UTC"), pa.timestamp("ns"), pa.float64()):
            with suppress(pa.ArrowInvalid):
                table = table.set_column(index, name, pc.cast(text, kind))
    return table


def _guess_encoding(head: bytes) -> str:
    """Return the encoding of a text that begins with `head`: UTF-16 if it begins with the mark of
    this encoding, UTF-8 if it is valid, else that of Windows for western languages.
    """
    if head.startswith((codecs.BOM_UTF16_LE, codecs.BOM_UTF16_BE)):
        return "utf-16"
    try:
        head.decode("utf-8")
    except UnicodeDecodeError:
        return "cp1252"
    return "utf-8"


def _read_racechrono(path: Path, lines: list[str]) -> pa.Table:
    """Return the data of a RaceChrono CSV file of version 3, whose lines are `lines`. It has a
    preamble, then one row each of names, units and sources, then the data.

    Raises:
        InputError: there is no row of names.
    """
    place = next((k for k, line in enumerate(lines) if line.lower().startswith("timestamp,")), None)
    if place is None or place + 2 >= len(lines):
        raise InputError(
            "source", f"{path} is RaceChrono's, but not of CSV version 3", "export it as CSV v3"
        )
    rows = [line.rstrip("\r\n").split(",") for line in lines[place : place + 3]]
    names = rows[0]
    units = rows[1]
    sources = rows[2]
    skipped = place + (3 if "unix time" in units or not _is_number(units[0]) else 1)
    titles: list[str] = []
    for k, name in enumerate(names):
        unit = units[k].strip() if k < len(units) else ""
        is_repeated = any(_plain_title(other) == name for other in titles)
        title = f"{name} {sources[k].strip()}" if is_repeated else name
        titles.append(f"{title} [{unit}]" if unit and unit != "unix time" else title)
    options = pc_csv.ReadOptions(skip_rows=skipped, column_names=_make_distinct(titles))
    return pc_csv.read_csv(path, read_options=options)


def _make_distinct(names: list[str]) -> list[str]:
    """Return the column names of a table, with a number appended to each repeated name."""
    return [name if name not in names[:k] else f"{name} {k}" for k, name in enumerate(names)]


def _plain_names(titles: Sequence[str]) -> dict[str, str]:
    """Return the titles of the columns by name. The name of a column is its title without the
    unit, or the whole title if other columns have the same name.
    """
    plain = [_plain_title(title) or title for title in titles]
    count = Counter(plain)
    return {
        name if count[name] == 1 else title: title
        for name, title in zip(plain, titles, strict=True)
    }


def _unit_in(title: str) -> str:
    """Return the unit that the title of a column states, "" if there is none."""
    found = _UNIT.match(title)
    return found["unit"] if found else ""


def _plain_title(title: str) -> str:
    return _UNIT.sub(r"\g<name>", title).strip()


def _is_number(text: str) -> bool:
    try:
        float(text)
    except ValueError:
        return False
    return True


def _first_text(column: Any) -> object:  # noqa: ANN401 Arrow columns are not generic
    """Return the first value of a column that is not a number; None if there is no such value."""
    values = (value.as_py() for value in column)
    return next((one for one in values if one is not None and not _is_number(str(one))), None)


def _time_column(path: Path, titles: dict[str, str], requested: str | None) -> str:
    if requested is not None:
        whole = next((name for name, full in titles.items() if requested in (name, full)), None)
        if whole is not None:
            return whole
        raise InputError(
            "time",
            f"{path} has no column {requested}",
            f"choose one of {', '.join(list(titles)[:MOST_NAMES])}",
        )
    lower = {name.lower(): name for name in reversed(titles)}
    for name in TIMES:
        if name in lower:
            return lower[name]
    for name in titles:  # take the first name with such a word, such as "INS_time_sec"
        if {"time", "timestamp", "datetime"} & set(_WORD.findall(name.lower())):
            return name
    if len(titles) == 1:
        problem = f"{path} has one column, {next(iter(titles))[:MOST_LETTERS]!r}"
        raise InputError("source", problem, "separate its columns by commas, semicolons or tabs")
    seen = ", ".join(list(titles)[:MOST_NAMES])
    raise InputError(
        "time",
        f"{path} has no time column; its columns are {seen}",
        'name it in the profile as "time"',
    )


def _parse_time_unit(column: str, stated: str) -> str:
    """Return the key in TIME_UNITS of the unit `stated` in the title of a time column.

    Raises:
        InputError: the unit is not known.
    """
    for unit, spellings in UNIT_SPELLINGS.items():
        if stated.strip().lower() in spellings:
            return unit
    raise InputError(
        column,
        f"has the unit {stated!r}, which is not a unit of time",
        'set "time_unit" in the profile to s, ms, us or ns',
    )


def _guess_time_unit(name: str, first: float, *, whole: bool) -> str:
    """Return the unit of a time column without a stated unit. It follows from the ending of the
    column's name, or from the size of the `first` number if it is a date. Other numbers are
    seconds, except for whole numbers in a column `timestamp`, which are nanoseconds.
    """
    small = ("ms", "us", "ns")
    ends = (unit for unit in small if name.lower().endswith(f"_{unit}"))
    dates = (unit for unit in small if FIRST_DATE < first * TIME_UNITS[unit] < LAST_DATE)
    if unit := next(ends, None) or next(dates, None):
        return unit
    return "ns" if whole and name.lower() == "timestamp" else "s"


def _parse_seconds(
    column: Any,  # noqa: ANN401 Arrow columns are not generic
    name: str,
    unit: str | None,
) -> tuple[FloatArray, int | None]:
    """Convert the time column `column` of a table to seconds; `unit` is the unit of its numbers, if
    stated. Return the seconds (n,) since the first row, and the time of that row [ns UTC], or None
    if the column has no dates.
    """
    if pa.types.is_timestamp(column.type):
        ns = pc.cast(pc.cast(column, pa.timestamp("ns", tz=column.type.tz)), pa.int64())
        values = np.asarray(ns.to_numpy(zero_copy_only=False))
        if ns.null_count:
            raise InputError(name, "is missing in a row", "give every sample its time")
        return (values - values[0]) / NS, int(values[0])
    if not (pa.types.is_integer(column.type) or pa.types.is_floating(column.type)):
        problem = f"has the value {_first_text(column)!r}, which is not a time"
        raise InputError(name, problem, "write seconds or ISO 8601 times, and no row of units")
    raw = np.asarray(column.to_numpy(zero_copy_only=False))
    if not np.isfinite(raw[0]):
        raise InputError(name, "is missing at row 0", "give every sample its time")
    whole = pa.types.is_integer(column.type)
    if unit:
        unit = _parse_time_unit(name, unit)
    else:
        unit = _guess_time_unit(name, float(raw[0]), whole=whole)
    factor = TIME_UNITS[unit]
    first = float(raw[0]) * factor
    exact = (raw - raw[0]) * factor if factor != 1.0 or abs(first) > NS / 10 else raw * 1.0
    dated = FIRST_DATE < first < LAST_DATE
    start = int(raw[0]) if dated and unit == "ns" and whole else round(first * NS)
    t: FloatArray = np.asarray(exact, dtype=np.float64)
    return (t - t[0] if dated else t), start if dated else None


def _check_order(name: str, t: FloatArray) -> None:
    """Raise an InputError if a time in the column `name`, t (n,) [s], is missing or goes back."""
    back = np.flatnonzero(~((np.diff(t) >= 0.0) & np.isfinite(t[1:])))
    if not len(back):
        return
    row = int(back[0]) + 1
    if not np.isfinite(t[row]):
        raise InputError(name, f"is missing at row {row}", "give every sample its time")
    if t[row - 1] - t[row] > DAY_BACK_S:
        fix = "add 86400 s to the times after midnight"
    else:
        fix = "sort the recording by time"
    raise InputError(name, f"goes back at row {row}", fix)


def _time_doubts(name: str, kind: pa.DataType, t: FloatArray, unit: str | None) -> list[str]:
    """Return notes on times t (n,) [s] in the column `name` whose unit or zone was assumed. `unit`
    is the stated unit of numbers of the Arrow type `kind`, None if there is none.
    """
    if pa.types.is_timestamp(kind):
        return [f"{name} has no time zone; taken as UTC"] if kind.tz is None else []
    step = float(np.median(np.diff(t))) if len(t) > 1 else 1.0
    if unit is None and (step > LONGEST_STEP_S or 0.0 < step < SHORTEST_STEP_S):
        return [f'{name}: a row every {step:.3g} s; if not, set "time_unit" in the profile']
    return []


def _parse_numbers(column: Any) -> FloatArray | None:  # noqa: ANN401 Arrow columns are not generic
    if not (
        pa.types.is_integer(column.type)
        or pa.types.is_floating(column.type)
        or pa.types.is_boolean(column.type)
    ):
        return None
    values = pc.cast(column, pa.float64(), safe=False)  # a 64-bit counter loses its last bits
    return np.array(values.to_numpy(zero_copy_only=False), dtype=np.float64)
