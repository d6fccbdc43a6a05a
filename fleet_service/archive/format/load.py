"""Reading and verification of one file of the archive.

The result has the columns that this version knows: a missing column is null, and an unknown column
is ignored. A file counts as damaged if a checksum or digest does not match, or a text is not valid
UTF-8. The service that writes the archive, and its compaction, rename a damaged file so that it is
not read again. Readers skip it with a warning and change nothing.
"""

from __future__ import annotations

import logging
from collections.abc import Callable, Iterator, Sequence
from contextlib import suppress
from pathlib import Path
from typing import Any, Final, NamedTuple

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq

from fleet_service.archive.format.row_filter import Where, filter_table, matching_row_groups
from fleet_service.archive.format.segments import is_value
from fleet_service.archive.format.version import (
    DamagedError,
    Version,
    check_version,
    entries_of,
    is_newer,
)
from schemas import tables
from schemas.errors import InputError

log = logging.getLogger(__name__)
BAD: Final = ".bad"
# Rows in memory while a file is read in parts. A whole row group takes ten times as much.
BATCH_ROWS: Final = 1 << 14
BUFFER_BYTES: Final = 1 << 16  # [bytes] read buffer per column in this case

# Columns without which a row is not valid in any version.
NEEDED: Final = frozenset(
    {
        "leave_time",
        "time",
        "cell",
        "sector",
        "latitude",
        "longitude",
        "vehicle",
        "boot",
        "region",
        "seq",
        "row",
    }
    | {"received_at", "hour", "acts_from", "enter_time", "first_held", "late", "weight"}
)

Damaged = Callable[[Path, str], None]


def skip_damaged(path: Path, problem: str) -> None:
    """Log a warning about a damaged file and leave it in place; programs that only read an archive
    use this.
    """
    log.warning("%s is damaged and is ignored: %s", path, problem)


def set_aside(path: Path, problem: str) -> None:
    """Rename a damaged file so that it is not read again, and log a warning. Only the service that
    writes the archive may do this.
    """
    log.warning("%s is damaged and was set aside: %s", path, problem)
    # Another thread may have renamed the file already.
    with suppress(FileNotFoundError):
        path.rename(path.with_name(path.name + BAD))


def count_set_aside(root: Path) -> int:
    """Return the number of damaged files of an archive that were renamed so that they are not read
    again. This scans the whole archive.
    """
    return sum(1 for _ in root.rglob(f"*{BAD}"))


class Content(NamedTuple):
    """Complete content of a file: rows with all columns of the file, its format version, and the
    key-value pairs of its footer.
    """

    table: pa.Table
    version: Version
    entries: dict[str, str]


def load_rows(
    path: Path,
    schema: pa.Schema,
    columns: Sequence[str] | None = None,
    where: Where | None = None,
    *,
    whole: bool = False,
    damaged: Damaged = skip_damaged,
) -> pa.Table | None:
    """Return the rows of one file; None if it is damaged.

    Args:
        path: path of the file.
        schema: the columns that this version knows.
        columns: columns to return; None for all known ones.
        where: filter on returned columns; row groups without a matching row are skipped.
        whole: True to verify every column, not only the returned ones.
        damaged: called with a damaged file.

    Raises:
        FileNotFoundError: the file no longer exists.
        InputError: the file has a newer major version.
        OSError: the file cannot be read.
    """
    known = schema if columns is None else pa.schema([schema.field(name) for name in columns])

    def read_rows(file: pq.ParquetFile) -> pa.Table:
        names = None if whole else [name for name in known.names if name in file.schema_arrow.names]
        if where is not None and file.metadata.num_row_groups > 1:
            return _read_row_groups(file, names, where)
        return file.read(names)  # takes half the time of `read_table` for small files

    found = _read_verified(path, read_rows, damaged)
    if found is None:
        return None
    table = conform_columns(found.table, schema if whole else known)
    return (table if where is None else filter_table(table, where)).select(known.names)


def load_groups(
    path: Path,
    schema: pa.Schema,
    columns: Sequence[str],
    where: Where,
    take: Callable[[pa.Table], None],
    damaged: Damaged = skip_damaged,
) -> bool:
    """Read a file of the archive, and pass its rows that match `where` to `take`, one Parquet row
    group (part of the file) at a time.

    This saves memory: reading a complete file takes several times the memory of its rows. In a row
    group without a matching row, only the columns of `where` are read. The result is False if the
    file is damaged; the caller must then discard the rows passed to `take`.

    Raises:
        FileNotFoundError: the file no longer exists.
        InputError: the file has a newer major version.
        OSError: the file cannot be read.
    """
    known = pa.schema([schema.field(name) for name in columns])

    def read_matching(file: pq.ParquetFile) -> pa.Table:
        names = [name for name in columns if name in file.schema_arrow.names]
        own = [one for one in where if one.column in names]
        looked = list({one.column: None for one in own})
        for group in matching_row_groups(file.metadata, where):
            if own and not any(
                filter_table(part, own).num_rows for part in _read_batches(file, group, looked)
            ):
                continue
            parts = [
                filter_table(conform_columns(part, known), where)
                for part in _read_batches(file, group, names)
            ]
            if parts:  # there are none if the data of the file's only vehicle were erased
                take(pa.concat_tables(parts))
        return file.schema_arrow.empty_table().select(names)

    return _read_verified(path, read_matching, damaged, BUFFER_BYTES) is not None


def _read_batches(file: pq.ParquetFile, group: int, names: list[str]) -> Iterator[pa.Table]:
    for batch in file.iter_batches(BATCH_ROWS, [group], names, use_threads=False):
        table = pa.Table.from_batches([batch])
        table.validate(full=True)
        yield table


def _read_row_groups(file: pq.ParquetFile, names: list[str] | None, where: Where) -> pa.Table:
    """Return the rows of a Parquet file that match the filter `where`. Only Parquet row groups
    (parts of the file) that may contain such rows are read, one after the other.
    """
    own = file.schema_arrow
    known = [one for one in where if one.column in own.names]
    parts = [
        filter_table(file.read_row_group(group, names), known)
        for group in matching_row_groups(file.metadata, where)
    ]
    if parts:
        return pa.concat_tables(parts)
    return own.empty_table().select(own.names if names is None else names)


def read_content(path: Path, damaged: Damaged = skip_damaged) -> Content | None:
    """Return the complete content of a file, including unknown columns; None if the file is
    damaged.

    Raises:
        FileNotFoundError: the file no longer exists.
        InputError: the file has a newer major version.
        OSError: the file cannot be read.
    """
    return _read_verified(path, lambda file: file.read(), damaged)


def _read_verified(
    path: Path, read: Callable[[pq.ParquetFile], pa.Table], damaged: Damaged, buffer_bytes: int = 0
) -> Content | None:
    try:
        with pq.ParquetFile(
            path, page_checksum_verification=True, buffer_size=buffer_bytes
        ) as file:
            entries = entries_of(file.metadata.metadata)
            # Check this before reading, because a newer version may store the columns differently.
            if is_newer(entries):
                check_version(path, file.schema_arrow, entries)
            table = read(file)
            # The schema of a completely read table is available in a third of the time.
            whole = table.num_columns == file.metadata.num_columns
            version = check_version(path, table.schema if whole else file.schema_arrow, entries)
        table.validate(full=True)
        return Content(table, version, entries)
    except MemoryError:
        raise
    except (pa.ArrowException, OSError, UnicodeDecodeError, DamagedError) as error:
        if isinstance(error, OSError) and error.errno is not None:
            raise  # an error of the operating system, not of the file
        damaged(path, (str(error).splitlines() or [""])[0][:200])
        return None


def conform_columns(table: pa.Table, schema: pa.Schema) -> pa.Table:
    """Return a table of the archive with the columns of `schema`: null where the table has no such
    column, cast where the type differs.

    Raises:
        InputError: a value does not fit the type, or a required column is missing.
    """
    if table.schema.names == schema.names and table.schema.types == schema.types:
        return table
    return pa.Table.from_arrays([_convert_column(table, f) for f in schema], schema=schema)


def _convert_column(table: pa.Table, field: pa.Field[Any]) -> pa.ChunkedArray[Any]:
    if field.name not in table.column_names:
        if field.name in NEEDED:
            raise InputError(
                "archive",
                f"a file has no column {field.name}",
                "read it with the GripMap that wrote it",
            )
        # Files before format 1.2 lack this column.
        if field.name == tables.VALUE.name and {"mu", "mu_utilised"} <= set(table.column_names):
            mu = np.asarray(table["mu"].to_numpy(), np.float32)
            used = np.asarray(table["mu_utilised"].to_numpy(), np.float32)
            return pa.chunked_array([pa.array(is_value(mu, used))])
        return pa.chunked_array([pa.nulls(table.num_rows, field.type)])
    column = table.column(field.name)
    try:
        return column if column.type == field.type else column.cast(field.type)
    except (pa.ArrowInvalid, pa.ArrowNotImplementedError) as error:
        problem = f"column {field.name} is {column.type} and not {field.type}"
        raise InputError("archive", problem, "read it with the GripMap that wrote it") from error
