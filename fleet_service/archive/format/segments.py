"""Segments: admitted rows as Parquet files in the archive's inbox, written and read here.

    inbox/SHARD-EPOCH-SEQ.parquet          observations
    inbox/states/SHARD-EPOCH-SEQ.parquet   states

SHARD is the name of the service. EPOCH increases with every start of the service and SEQ with every
segment, so that a name is never used twice.
"""

from __future__ import annotations

import time
from pathlib import Path
from typing import Any, Final

import numpy as np
import pyarrow as pa
from numpy.typing import NDArray

from fleet_service.archive.format import layout
from fleet_service.archive.format.files import SEGMENT, write_table
from schemas import mugrid, tables
from schemas.numeric import BoolArray, Float32Array, IntArray
from schemas.runtime.durable import ENDING, sync_directory
from schemas.thresholds import EXCITED_SHARE, US_STEP
from schemas.wire import Kind
from schemas.wire.batches import ABSENT

SCHEMAS: Final = {Kind.OBSERVATION: tables.OBSERVATION_ARCHIVE, Kind.STATE: tables.STATE_ARCHIVE}
_FOLDERS: Final = {Kind.OBSERVATION: "inbox", Kind.STATE: "inbox/states"}

_TIMES: Final = ("enter_time", "leave_time", "time", "received_at")
_STEPS: Final = {f.name: f.step for f in (*tables.OBSERVATION, *tables.STATE) if f.step}

# Tolerance far below the columns' steps, so that rounding does not affect comparisons.
NEARLY: Final = 1e-6
Rows = dict[str, NDArray[Any]]


def segment_folder(root: Path, kind: Kind) -> Path:
    """Return the folder for segments (files of new rows) of a kind (observations or states)."""
    return root / _FOLDERS[kind]


def list_segments(root: Path, kind: Kind) -> list[Path]:
    """Return the segments of a kind, sorted from old to new by epoch and number."""
    return sorted(
        segment_folder(root, kind).glob("*.parquet"), key=lambda path: layout.age_key(path.name)
    )


class Writer:
    """Writer of segments during one run of one service.

    Args:
        root: folder of the archive.
        shard: name of the service.
        epoch: smallest allowed epoch, the number in segment names that increases with every start
            of a service. If services own the archive in turn by a lease, pass the epoch of the
            lease; without a lease pass 0.
    """

    def __init__(self, root: Path, shard: str, epoch: int = 0) -> None:
        self._root = root
        self._shard = shard
        self._seq = 0
        folders = [segment_folder(root, kind) for kind in SCHEMAS]
        for inbox in folders:
            inbox.mkdir(parents=True, exist_ok=True)
            # Drafts of an interrupted run contain no acknowledged rows.
            for draft in inbox.glob(f"*{ENDING}"):
                draft.unlink()
        # If a power loss removed one of these folders, its segments would be lost too.
        for parent in {root.parent, root, *folders}:
            sync_directory(parent)
        self._unsynced: set[Path] = set()
        # Compacted rows are identified by the names of their segments. So names of compacted
        # segments must not be used again either.
        used_paths = [
            path
            for kind in SCHEMAS
            for path in (*list_segments(root, kind), *layout.compacted_files(root, kind))
        ]
        used = [layout.age_key(path.name)[0] for path in used_paths]
        # A restart does not read segments that are older than a checkpoint. The run that saved it
        # may have had a clock that was ahead, and no rows.
        saved = (root / layout.CHECKPOINTS).glob("[0-9]*")
        used += [layout.term_of(f"{layout.CHECKPOINTS}/{path.name}") or 0 for path in saved]
        self._epoch = max([epoch or int(time.time()), *(one + 1 for one in used)])

    @property
    def newest(self) -> layout.Cut:
        """Return the position of the last written segment in the sequence of all segments."""
        return layout.Cut(self._epoch, self._seq)

    def write(self, kind: Kind, rows: Rows) -> Path:
        """Write columns (n,) of new rows as one segment file; return its path. The file is durable
        only after `sync`.

        `log_likelihood` is (n, 32); `with_likelihood` (n,) is true for rows that have a likelihood.

        Raises:
            OSError: the file could not be written; no draft (unfinished file) is left.
        """
        self._seq += 1
        path = segment_folder(self._root, kind) / layout.segment_name(
            f"{self._shard}-{self._epoch:010d}", self._seq
        )
        write_table(table_of(kind, rows), path, SEGMENT, named=False)
        self._unsynced.add(path.parent)
        return path

    def sync(self) -> None:
        """Make the names of the written segments durable. If this fails, call it again; the
        segments need not be written again.

        Raises:
            OSError: a folder cannot be synced.
        """
        for inbox in sorted(self._unsynced):
            sync_directory(inbox)
            self._unsynced.discard(inbox)


def round_to_steps(rows: Rows) -> Rows:
    """Return rows with floats rounded to multiples of their column's step (resolution in
    `schemas/tables.py`) and times rounded down to microseconds. The fusion of the rows into a map
    then uses exactly the values that are stored.
    """
    out = {
        name: np.rint(c / _STEPS[name]) * _STEPS[name] if name in _STEPS else c
        for name, c in rows.items()
    }
    return out | {name: out[name] // US_STEP * US_STEP for name in _TIMES if name in out}


def to_nanoseconds(times: pa.ChunkedArray[Any] | pa.Array[Any]) -> IntArray:
    """Return a time column of a stored table (µs) as integers in ns, (n,)."""
    return np.asarray(times.cast(tables.NS).cast(pa.int64()))


def table_of(kind: Kind, rows: Rows) -> pa.Table:
    """Return columns of rows as an Arrow table with the archive's schema for observations or
    states.
    """
    return pa.Table.from_arrays(
        [_make_column(f, rows) for f in SCHEMAS[kind]], schema=SCHEMAS[kind]
    )


def _make_column(f: pa.Field[Any], rows: Rows) -> pa.Array[Any]:
    values = (
        is_value(rows["mu"], rows["mu_utilised"]) if f.name == tables.VALUE.name else rows[f.name]
    )
    if f.type == tables.LIKELIHOOD:
        valid = np.packbits(rows["with_likelihood"], bitorder="little").tobytes()
        return pa.Array.from_buffers(
            f.type, len(values), [pa.py_buffer(valid), pa.py_buffer(values.tobytes())]
        )
    if f.type == tables.US:
        values = values // US_STEP
    column: pa.Array[Any] = pa.array(values).cast(f.type)
    return column


def is_value(mu: Float32Array, used: Float32Array) -> BoolArray:
    """Return a mask of rows (n,): True if the row gives a value of μ and not only a lower bound.
    That is so if the vehicle used at least the share EXCITED_SHARE of μ. The result for NaN is
    False.
    """
    return np.asarray(used.astype(np.float64) >= (EXCITED_SHARE - NEARLY) * mu.astype(np.float64))


def rows_of(table: pa.Table) -> Rows:
    """Return the columns of a table in the form that `Writer.write` takes. Times are int64 [ns],
    and null becomes the column's default.
    """
    rows: Rows = {}
    for f in table.schema:
        column = table.column(f.name).combine_chunks()
        if f.type == tables.LIKELIHOOD:
            rows["with_likelihood"] = np.asarray(column.is_valid())
            rows[f.name] = _read_likelihoods(column)
        elif f.type == tables.US:
            rows[f.name] = to_nanoseconds(column)
        else:
            rows[f.name] = _without_null(f, column).to_numpy(zero_copy_only=False)
    return rows


def _without_null(f: pa.Field[Any], column: pa.Array[Any]) -> pa.Array[Any]:
    """Return a stored column in which nulls are replaced; nulls occur in files of older versions.
    Floats get NaN, other types the column's default.
    """
    if not column.null_count or pa.types.is_floating(f.type):
        return column
    filled: pa.Array[Any] = column.fill_null(
        pa.scalar("" if pa.types.is_string(f.type) else ABSENT.get(f.name, 0)).cast(f.type)
    )
    return filled


def _read_likelihoods(column: pa.Array[Any]) -> NDArray[np.uint8]:
    """Return a column of log-likelihoods as an array (n, 32); rows without a likelihood are flat
    (zeros).
    """
    filled: pa.Array[Any] = column.fill_null(bytes(mugrid.BINS))
    data = np.frombuffer((filled.buffers()[1] or pa.py_buffer(b"")).to_pybytes(), np.uint8).reshape(
        -1, mugrid.BINS
    )
    return data[filled.offset : filled.offset + len(filled)]
