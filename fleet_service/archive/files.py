"""Files that survive power loss, and the lock of an archive."""

from __future__ import annotations

import fcntl
import os
from pathlib import Path
from typing import BinaryIO

import pyarrow as pa
import pyarrow.parquet as pq

from schemas.errors import InputError

# Dictionaries only where values repeat: everywhere else they cost size and time. Plain encodings and zstd are read by
# DuckDB, pandas, polars and every Spark in use; byte-stream-split is not.
_DICTIONARY = ("vehicle", "estimator", "boot", "region", "health", "received_at")


def sync_directory(folder: Path) -> None:
    """Make renames and new names in `folder` durable."""
    handle = os.open(folder, os.O_RDONLY | os.O_DIRECTORY)
    try:
        os.fsync(handle)
    finally:
        os.close(handle)


def write_table(table: pa.Table, path: Path) -> None:
    """Write a Parquet file that is whole and durable when this returns, or not there.

    Raises:
        OSError: the disk is full or read-only; nothing is left under `path`.
    """
    draft = path.with_name(path.name + ".tmp")
    columns = [name for name in _DICTIONARY if name in table.schema.names]
    try:
        with draft.open("wb") as file:
            pq.write_table(table, file, compression="zstd", compression_level=3, use_dictionary=columns)  # type: ignore[arg-type] # stub: bool only
            file.flush()
            os.fsync(file.fileno())
        draft.rename(path)
    except OSError:
        draft.unlink(missing_ok=True)
        raise
    sync_directory(path.parent)


def lock(root: Path) -> BinaryIO:
    """Take the archive for this process; it is free again when the file is closed, or the process is gone.

    Raises:
        InputError: another service holds it, or the folder cannot be made.
    """
    try:
        root.mkdir(parents=True, exist_ok=True)
        file = (root / "lock").open("ab")
    except OSError as error:
        raise InputError(
            "archive", f"cannot use {root} ({error.strerror})", "give a folder you may write to"
        ) from error
    try:
        fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except BlockingIOError as error:
        file.close()
        raise InputError(
            "archive", f"{root} belongs to a running service", "stop it, or give another folder"
        ) from error
    return file
