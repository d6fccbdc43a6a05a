"""Bounded queue of messages in a file, so that messages survive the end of the process."""

from __future__ import annotations

import sqlite3
import threading
from pathlib import Path
from typing import Final

from schemas.errors import InputError

MOST_WAITING: Final = 1000


class AlertQueue:
    """Queue of alert messages (texts) in an SQLite file; when it is full, the oldest texts are
    dropped.

    Args:
        path: path of the file, which is created if missing; this queue has exclusive use of it
            until `close`.
        most: maximum number of waiting messages.

    Raises:
        InputError: the file cannot be used, or another process uses it.
    """

    def __init__(self, path: Path, most: int = MOST_WAITING) -> None:
        self._most = most
        self._guard = threading.Lock()
        try:
            path.parent.mkdir(parents=True, exist_ok=True)
            self._file = sqlite3.connect(
                path, timeout=0.1, isolation_level=None, check_same_thread=False
            )
            self._file.execute("PRAGMA locking_mode = EXCLUSIVE")
            self._file.execute(
                "CREATE TABLE IF NOT EXISTS waiting (number INTEGER PRIMARY KEY AUTOINCREMENT, "
                "text TEXT)"
            )
            self._file.execute("BEGIN EXCLUSIVE")
            self._file.execute("COMMIT")
            self._file.execute("SELECT number, text FROM waiting LIMIT 1").fetchall()
        except (sqlite3.Error, OSError) as error:
            problem = f"{path} cannot be used ({error})"
            raise InputError(
                "webhook_queue", problem, "give another file; every watch needs its own file"
            ) from error

    def __len__(self) -> int:
        with self._guard:
            return int(self._file.execute("SELECT count(*) FROM waiting").fetchone()[0])

    def append(self, text: str) -> int:
        """Append an alert message; return the number of old messages that were dropped to make
        room.

        Raises:
            sqlite3.Error: the message cannot be stored.
        """
        with self._guard:
            self._file.execute("INSERT INTO waiting (text) VALUES (?)", (text,))
            keep = "SELECT number FROM waiting ORDER BY number DESC LIMIT ?"
            return self._file.execute(
                f"DELETE FROM waiting WHERE number NOT IN ({keep})", (self._most,)
            ).rowcount

    def read_first(self) -> tuple[int, str] | None:
        """Return (number, text) of the oldest waiting alert message; None if the queue is empty."""
        with self._guard:
            row = self._file.execute(
                "SELECT number, text FROM waiting ORDER BY number LIMIT 1"
            ).fetchone()
        return None if row is None else (int(row[0]), str(row[1]))

    def remove(self, number: int) -> bool:
        """Remove the alert message with this number; return False if it had already been
        dropped.
        """
        with self._guard:
            return (
                self._file.execute("DELETE FROM waiting WHERE number = ?", (number,)).rowcount > 0
            )

    def close(self) -> None:
        """Close the file of the alert queue, so that other processes can use it."""
        with self._guard:
            self._file.close()
