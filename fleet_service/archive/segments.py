"""The log: admitted rows as Parquet segments, and reading them back.

    inbox/SHARD-EPOCH-SEQ.parquet          observations
    inbox/states/SHARD-EPOCH-SEQ.parquet   states

EPOCH grows with every start of the service and SEQ with every segment, so that a name is never used twice.
"""

from __future__ import annotations

import time
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any, Final

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
from numpy.typing import NDArray

from fleet_service.archive.files import write_table
from schemas import mugrid, tables
from schemas.wire import Kind

SCHEMAS: Final = {Kind.OBSERVATION: tables.OBSERVATION_ARCHIVE, Kind.STATE: tables.STATE_ARCHIVE}
_FOLDERS: Final = {Kind.OBSERVATION: "inbox", Kind.STATE: "inbox/states"}

Rows = dict[str, NDArray[Any]]


def folder(root: Path, kind: Kind) -> Path:
    """Where the segments of a kind lie."""
    return root / _FOLDERS[kind]


def paths(root: Path, kind: Kind) -> list[Path]:
    """Segments of a kind, oldest first within a shard."""
    return sorted(folder(root, kind).glob("*.parquet"))


class Writer:
    """Writes the segments of one run of one service.

    Args:
        root: of the archive.
        shard: name of the service.
    """

    def __init__(self, root: Path, shard: str) -> None:
        self._root, self._shard, self._seq = root, shard, 0
        for kind in SCHEMAS:
            folder(root, kind).mkdir(parents=True, exist_ok=True)
            for draft in folder(root, kind).glob("*.tmp"):  # of a run that died while writing: never acknowledged
                draft.unlink()
        used = [int(path.stem.split("-")[-2]) for kind in SCHEMAS for path in paths(root, kind)]
        self._epoch = max([int(time.time()), *(epoch + 1 for epoch in used)])

    def write(self, kind: Kind, rows: Rows) -> Path:
        """Write one durable segment from columns (n,); `log_likelihood` is (n, 32) with the mask `told`.

        Raises:
            OSError: it could not be written; nothing is kept of it.
        """
        self._seq += 1
        path = folder(self._root, kind) / f"{self._shard}-{self._epoch:010d}-{self._seq:08d}.parquet"
        write_table(table_of(kind, rows), path)
        return path


def table_of(kind: Kind, rows: Rows) -> pa.Table:
    """Columns as an Arrow table of the archive's schema."""
    return pa.Table.from_arrays([_column(f, rows) for f in SCHEMAS[kind]], schema=SCHEMAS[kind])


def _column(f: pa.Field[Any], rows: Rows) -> pa.Array[Any]:
    values = rows[f.name]
    if f.type == tables.LIKELIHOOD:
        valid = np.packbits(rows["told"], bitorder="little").tobytes()
        return pa.Array.from_buffers(f.type, len(values), [pa.py_buffer(valid), pa.py_buffer(values.tobytes())])
    if f.type == pa.string():  # few distinct ones in a segment
        distinct, index = np.unique(values, return_inverse=True)
        return pa.array(distinct.tolist(), pa.string()).take(index)
    column: pa.Array[Any] = pa.array(values).cast(f.type)
    return column


def read(root: Path, kind: Kind, columns: Sequence[str] | None = None) -> Iterator[pa.Table]:
    """Every segment of a kind; a damaged file is set aside with the ending `.bad`, and reading goes on.

    Raises:
        OSError: the system cannot read (no memory, no handles, a failing disk).
    """
    for path in paths(root, kind):
        try:
            yield pq.read_table(path, columns=list(columns) if columns else None)
        except (pa.ArrowInvalid, OSError) as error:
            if isinstance(error, OSError) and error.errno is not None:
                raise  # the system's trouble, not the file's
            path.rename(path.with_name(path.name + ".bad"))


def rows_of(table: pa.Table) -> Rows:
    """Columns of a table as `Writer.write` takes them; times are int64."""
    rows: Rows = {}
    for f in table.schema:
        column = table.column(f.name).combine_chunks()
        if f.type == tables.LIKELIHOOD:
            rows["told"] = np.asarray(column.is_valid())
            rows[f.name] = _likelihoods(column)
        elif f.type == tables.NS:
            rows[f.name] = column.cast(pa.int64()).to_numpy()
        else:
            rows[f.name] = column.to_numpy(zero_copy_only=False)
    return rows


def _likelihoods(column: pa.Array[Any]) -> NDArray[np.uint8]:
    """Fixed-size binary as (n, 32); rows without one are flat."""
    filled: pa.Array[Any] = column.fill_null(bytes(mugrid.BINS))
    data = np.frombuffer((filled.buffers()[1] or pa.py_buffer(b"")).to_pybytes(), np.uint8).reshape(-1, mugrid.BINS)
    return data[filled.offset : filled.offset + len(filled)]
