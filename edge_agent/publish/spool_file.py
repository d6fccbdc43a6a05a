"""SQLite file of an outbox (store of batches that no service has answered), opened exclusively by
one process. If the file is damaged, it is renamed, and its readable batches are copied to a new
file.

Each batch has a checksum of its identifier and payload, because SQLite itself does not detect
changed bits in its data.
"""

from __future__ import annotations

import logging
import sqlite3
import zlib
from collections.abc import Iterator, Sequence
from contextlib import closing, suppress
from pathlib import Path
from typing import Final

from edge_agent.publish import salvage
from schemas.errors import InputError
from schemas.runtime.durable import make_folder, sync_directory

log = logging.getLogger(__name__)
SCHEMA: Final = """
CREATE TABLE IF NOT EXISTS batch (
    id INTEGER PRIMARY KEY AUTOINCREMENT,
    vehicle TEXT NOT NULL, boot INTEGER NOT NULL, kind TEXT NOT NULL, region INTEGER NOT NULL,
    seq INTEGER NOT NULL, records INTEGER NOT NULL, payload BLOB NOT NULL, checksum INTEGER,
    UNIQUE (vehicle, boot, kind, region, seq)
);
CREATE INDEX IF NOT EXISTS batch_age ON batch (kind, id);
"""
NAME: Final = "vehicle, boot, kind, region, seq, records"
DAMAGED: Final = "damaged"  # suffix, before a number, of a damaged file that was set aside
_MAGIC: Final = b"SQLite format 3\0"
# Minimum number of bytes equal to _MAGIC in a damaged outbox. A file with fewer belongs to another
# program and is not changed.
_SIMILAR: Final = 12
# Types of the columns. The id is not checked, because SQLite stores it as the row number.
TYPES: Final = (
    object,
    str,
    int,
    str,
    int,
    int,
    int,
    bytes,
    int | None,
)
_CORRUPT: Final = (sqlite3.SQLITE_CORRUPT, sqlite3.SQLITE_NOTADB)

Row = tuple[object, ...]


class SpoolFile:
    """SQLite file of an outbox, as a table of batches. The key of a batch is its row number.

    Attributes:
        was_damaged: True if the file was found damaged when it was opened.

    Raises:
        InputError: the file belongs to another agent or is not an outbox, or the path cannot be
            used.
    """

    def __init__(self, path: Path) -> None:
        self._path = path
        self._database, aside = open_file(path)
        self.was_damaged = aside is not None

    def recover_content(self) -> None:
        """Replace a damaged file by a new one with the readable content of the old one. If an error
        occurs, the caller may call the method again.

        Raises:
            sqlite3.Error, OSError: the disk does not accept the write.
        """
        self._database.close()
        self._database, _ = recover_file(self._path)

    def begin_transaction(self) -> sqlite3.Connection:
        """Return a context manager for a database transaction. It commits the changes at the end of
        the `with` block, and undoes them after an error.
        """
        return self._database

    def list_batches(self) -> Iterator[tuple[int, tuple[str, int, str, int, int, int], int]]:
        """Yield each batch as (key, identifier, size of the payload [bytes]), oldest first. The
        identifier consists of vehicle, agent run, kind, region, sequence number and number of
        records.
        """
        rows = self._database.execute(f"SELECT id, {NAME}, LENGTH(payload) FROM batch ORDER BY id")
        for key, *name, size in rows:
            vehicle, boot, kind, region, seq, records = name
            yield key, (vehicle, boot, kind, region, seq, records), size

    def insert_row(self, name: Row, payload: bytes) -> int:
        """Insert a batch with its payload and its identifier `name` (see `list_batches`) into the
        outbox's file. Return the key (row number) of the new row.
        """
        cursor = self._database.execute(
            f"INSERT INTO batch ({NAME}, payload, checksum) VALUES (?, ?, ?, ?, ?, ?, ?, ?)",
            (*name, payload, batch_checksum(name, payload)),
        )
        if cursor.lastrowid is None:
            raise sqlite3.DatabaseError("an insert gave no row id")
        return cursor.lastrowid

    def delete_rows(self, keys: Sequence[int]) -> None:
        """Delete the batches with the row numbers `keys` from the outbox's file."""
        self._database.executemany("DELETE FROM batch WHERE id = ?", [(key,) for key in keys])

    def read_payload(self, key: int) -> bytes | None:
        """Return the payload of the batch with the row number `key`; None if the row is missing or
        damaged.
        """
        query = f"SELECT {NAME}, payload, checksum FROM batch WHERE id = ?"
        row = self._database.execute(query, (key,)).fetchone()
        if row is None:
            return None
        *name, found, checksum = row
        payload: bytes = found
        if checksum is not None and batch_checksum(tuple(name), payload) != checksum:
            return None
        return payload

    def close(self) -> None:
        """Close the file of the outbox and release its lock."""
        self._database.close()


def batch_checksum(name: Row, payload: bytes) -> int:
    """Return the checksum (CRC-32) of a batch: over its payload and its identifier `name` (vehicle,
    agent run, kind, region, sequence number, number of records).
    """
    return zlib.crc32(payload, zlib.crc32(repr(name).encode()))


def is_damage(error: sqlite3.Error) -> bool:
    """Return True if a database error indicates a damaged file, or a file that a failed recovery
    closed. Return False otherwise, for example if the disk is full or slow.
    """
    closed = isinstance(error, sqlite3.ProgrammingError)
    return closed or getattr(error, "sqlite_errorcode", 0) & 0xFF in _CORRUPT


def open_file(path: Path) -> tuple[sqlite3.Connection, Path | None]:
    """Open an outbox's file, check it, and lock it for this process; return its database connection
    and None. If the file is damaged, rename it, copy its readable content to a new file, and return
    the connection of the new file and the path of the damaged one.

    Raises:
        InputError: the file belongs to another agent or is not an outbox, or the path cannot be
            used.
    """
    try:
        make_folder(path.parent)
        _complete_recovery(path)
        try:
            return _open_database(path), None
        except sqlite3.DatabaseError as error:
            if not is_damage(error) or not _is_outbox(path):
                raise
            log.warning(
                "the outbox %s is damaged (%s): it is set aside, and readable records are saved",
                path,
                error,
            )
            return recover_file(path)
    except (sqlite3.Error, OSError) as error:
        if isinstance(error, sqlite3.OperationalError) and "locked" in str(error):
            raise InputError(
                "spool", f"{path} is used by another agent", "give each agent its own outbox"
            ) from error
        problem = f"{path} cannot be opened ({error})"
        raise InputError(
            "spool", problem, "name a writable place, or move the file aside"
        ) from error


def recover_file(path: Path) -> tuple[sqlite3.Connection, Path]:
    """Copy the readable batches of a damaged file to a new file, rename the damaged file, and put
    the new file in its place. Return the database connection of the new file, and the path of the
    damaged one.

    After a crash or an error the damaged file is still in place, or `open_file` finds the complete
    new file.

    Raises:
        sqlite3.Error, OSError: the disk does not accept the write.
    """
    recovered = _recovered_path(path)
    for ending in ("", "-journal"):  # of an earlier attempt
        recovered.with_name(recovered.name + ending).unlink(missing_ok=True)
    with closing(sqlite3.connect(recovered)) as database, database:
        database.executescript(SCHEMA)
        rows = _readable_batches(path)
        database.executemany(
            f"INSERT OR IGNORE INTO batch (id, {NAME}, payload, checksum) VALUES (?, ?, ?, ?, ?, "
            "?, ?, ?, ?)",
            rows,
        )
    sync_directory(path.parent)
    names = (path.with_name(f"{path.name}.{DAMAGED}-{number}") for number in range(1, 10_000))
    aside = next(candidate for candidate in names if not candidate.exists())
    for ending in ("", "-wal", "-shm"):
        with suppress(FileNotFoundError):
            path.with_name(path.name + ending).rename(aside.with_name(aside.name + ending))
    _complete_recovery(path)
    log.warning("%d batches were saved from %s", len(rows), aside)
    return _open_database(path), aside


def _recovered_path(path: Path) -> Path:
    """Return the path of the new file that replaces a damaged outbox file at `path`."""
    return path.with_name(f"{path.name}.recovered")


def _complete_recovery(path: Path) -> None:
    """Rename the new file of a recovery to `path`, if the damaged file is no longer there."""
    recovered = _recovered_path(path)
    if path.exists() or not recovered.exists():
        return
    for ending in ("-wal", "-shm"):  # of the damaged file, after a crash
        path.with_name(path.name + ending).unlink(missing_ok=True)
    recovered.rename(path)
    sync_directory(path.parent)


def _open_database(path: Path) -> sqlite3.Connection:
    database = sqlite3.connect(path, timeout=0.0, check_same_thread=False)
    try:
        database.execute("PRAGMA locking_mode = EXCLUSIVE")
        database.execute("PRAGMA journal_mode = WAL")
        database.execute("PRAGMA synchronous = FULL")
        database.executescript(f"BEGIN EXCLUSIVE; {SCHEMA} COMMIT;")
        if "checksum" not in {row[1] for row in database.execute("PRAGMA table_info(batch)")}:
            database.execute("ALTER TABLE batch ADD COLUMN checksum INTEGER")
            database.commit()
        (verdict,) = database.execute("PRAGMA integrity_check(1)").fetchone()
        if verdict != "ok":
            error = sqlite3.DatabaseError(str(verdict).splitlines()[0])
            error.sqlite_errorcode = sqlite3.SQLITE_CORRUPT
            raise error
    except BaseException:
        database.close()
        raise
    return database


def _is_outbox(path: Path) -> bool:
    """Return True if a damaged file was an outbox: its first bytes resemble those of SQLite, or are
    all zero.
    """
    with path.open("rb") as file:
        begin = file.read(len(_MAGIC))
    return not any(begin) or sum(a == b for a, b in zip(begin, _MAGIC, strict=False)) >= _SIMILAR


def _readable_batches(path: Path) -> list[Row]:
    """Return the batches of a damaged file, oldest first, each once. A batch counts as readable if
    its checksum is correct, or if an old version wrote it without a checksum.
    """
    log_file = path.with_name(f"{path.name}-wal")
    log_bytes = log_file.read_bytes() if log_file.exists() else b""
    found: dict[int, Row] = {}
    for key, values in salvage.recover_rows(path.read_bytes(), log_bytes):
        padded = [*values, *[None] * (len(TYPES) - len(values))]  # an old version has no checksum
        if _is_intact_batch(padded):
            found.setdefault(key, (key, *padded[1:]))
    return [found[key] for key in sorted(found)]


def _is_intact_batch(values: Sequence[object]) -> bool:
    """Return True if a row of a damaged file has the types of a batch and, if it has a checksum,
    the correct one.
    """
    if len(values) != len(TYPES):
        return False
    if not all(isinstance(v, t) for v, t in zip(values[1:], TYPES[1:], strict=True)):
        return False
    payload = values[7]
    checksum = values[8]
    assert isinstance(payload, bytes)
    return checksum is None or checksum == batch_checksum(tuple(values[1:7]), payload)
