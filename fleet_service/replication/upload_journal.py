"""Journal of uploads: records which files of an archive are in its bucket copy, with their size and
time at the upload.

    ARCHIVE/copied      {"copy": URL}, then a line for each uploaded file, [name, bytes, time], and
                        for each deleted file, [name]

A line that is lost in a power failure is harmless: a file is uploaded once more, or a file that was
deleted locally is downloaded and deleted again. No file that is still needed is deleted because of
a lost line.
"""

from __future__ import annotations

import json
import os
from contextlib import suppress
from io import FileIO
from pathlib import Path
from threading import Lock
from typing import Final, NamedTuple

from schemas.runtime.durable import open_durably

NAME: Final = "copied"
# The journal is written again when it has more than twice as many lines as entries, and this many.
SPARE_LINES: Final = 10_000


class Stamp(NamedTuple):
    """Version of a file, identified by size [bytes] and time of the last write [ns]."""

    size: int
    time: int


def stamp_of(path: Path) -> Stamp:
    """Return the stamp (size and time of the last write) of a file.

    Raises:
        FileNotFoundError: the file no longer exists.
    """
    found = path.stat()
    return Stamp(found.st_size, found.st_mtime_ns)


class UploadJournal:
    """Upload journal (list of uploaded files) of one archive and its bucket copy at `url`. A
    journal that the archive has for another copy is replaced by an empty one.

    Args:
        root: folder of the archive.
        url: URL of the bucket copy.

    Raises:
        OSError: the journal can neither be read nor written.
    """

    def __init__(self, root: Path, url: str) -> None:
        self._path = root / NAME
        self._head = json.dumps({"copy": url})
        self._guard = Lock()
        self._stamps: dict[str, Stamp] = {}
        self._read_entries()
        self._file = self._write_entries()

    def _read_entries(self) -> None:
        """Read the entries of an earlier run, unless they belong to another copy. A later line
        about the same file replaces the earlier one; a line without a stamp removes it.
        """
        if not self._path.exists():
            return
        head, *lines = self._path.read_text(errors="replace").splitlines() or [""]
        if head != self._head:
            return
        for line in lines:
            with suppress(ValueError, TypeError, KeyError):  # a power loss cut off the line
                name, *stamp = json.loads(line)
                self._stamps.pop(name, None)
                if stamp:
                    self._stamps[name] = Stamp(*map(int, stamp))

    def _write_entries(self) -> FileIO:
        """Replace the file by one with a line for each entry; return the file, open for further
        lines.
        """
        with open_durably(self._path) as file:
            rest = [json.dumps([name, *stamp]) for name, stamp in self._stamps.items()]
            file.write("".join(f"{line}\n" for line in [self._head, *rest]).encode())
        written = self._path.open("ab", buffering=0)
        self._lines = len(rest)
        return written

    def copy_stamps(self) -> dict[str, Stamp]:
        """Return the stamp (size and time) at the upload of each file in the archive's copy, by
        name. Later uploads do not change the returned dictionary.
        """
        with self._guard:
            return dict(self._stamps)

    def find_stamp(self, name: str) -> Stamp | None:
        """Return the stamp (size and time) that a file had at its upload; None if it was not
        uploaded.
        """
        return self._stamps.get(name)

    def add(self, name: str, stamp: Stamp) -> None:
        """Record that the file `name` was uploaded to the bucket copy in the version `stamp`."""
        with self._guard:
            self._append_line([name, *stamp])
            self._stamps[name] = stamp

    def remove(self, name: str) -> None:
        """Record that a file was deleted from the archive's copy."""
        with self._guard:
            self._append_line([name])
            self._stamps.pop(name, None)

    def _append_line(self, entry: list[str | int]) -> None:
        self._file.write(f"{json.dumps(entry)}\n".encode())
        self._lines += 1

    def sync(self) -> None:
        """Write the recorded lines of the upload journal durably to disk (fsync). If most lines are
        out of date, write the whole file again. One thread at a time may call this.

        Raises:
            OSError: the disk is full or broken; the file stays as it is.
        """
        with self._guard:
            if self._lines > 2 * len(self._stamps) + SPARE_LINES:
                before = self._file
                self._file = self._write_entries()
                before.close()
                return
        os.fsync(self._file.fileno())

    def close(self) -> None:
        """Close the file of the upload journal."""
        self._file.close()


def last_copy_url(root: Path) -> str | None:
    """Return the URL of the bucket to which an archive was last copied; None if there is no
    readable upload journal.
    """
    with suppress(OSError, ValueError, KeyError, TypeError), (root / NAME).open() as file:
        return str(json.loads(file.readline())["copy"])
    return None
