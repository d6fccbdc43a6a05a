"""Which files of an archive are in its copy, and as which they were put: a journal beside them.

    ARCHIVE/copied      {"copy": URL}, then a line for each put, [name, bytes, time], and for each delete, [name]

A line that is lost costs a put, or brings a file back that is then removed again; it never removes one.
"""

from __future__ import annotations

import json
import os
from contextlib import suppress
from pathlib import Path
from threading import Lock
from typing import Final, NamedTuple

from schemas.runtime.durable import written

NAME: Final = "copied"


class Stamp(NamedTuple):
    """Tells a file from what it was before: bytes, and when it was written [ns]."""

    size: int
    time: int


def stamp_of(path: Path) -> Stamp:
    """Of a file, now.

    Raises:
        FileNotFoundError: it is gone.
    """
    found = path.stat()
    return Stamp(found.st_size, found.st_mtime_ns)


class Copied:
    """The journal of one archive and one copy; one of another copy counts for nothing.

    Args:
        root: of the archive.
        url: of the copy.

    Raises:
        OSError: it can neither be read nor written.
    """

    def __init__(self, root: Path, url: str) -> None:
        path, head = root / NAME, json.dumps({"copy": url})
        self._guard = Lock()
        self._stamps: dict[str, Stamp] = {}
        lines = path.read_text(errors="replace").splitlines() if path.exists() else []
        for line in lines[1:] if lines[:1] == [head] else []:
            with suppress(ValueError, TypeError, KeyError):  # of a line that power loss cut
                name, *stamp = json.loads(line)
                self._stamps.pop(name, None)
                if stamp:
                    self._stamps[name] = Stamp(*map(int, stamp))
        with written(path) as file:
            rest = [json.dumps([name, *stamp]) for name, stamp in self._stamps.items()]
            file.write("".join(f"{line}\n" for line in [head, *rest]).encode())
        self._file = path.open("ab", buffering=0)

    def all(self) -> dict[str, Stamp]:
        """Names of what is in the copy, and as what it was put; as it is now."""
        with self._guard:
            return dict(self._stamps)

    def of(self, name: str) -> Stamp | None:
        """As what a file was put; None: it was not."""
        return self._stamps.get(name)

    def add(self, name: str, stamp: Stamp) -> None:
        """Note a put."""
        with self._guard:
            self._file.write(f"{json.dumps([name, *stamp])}\n".encode())
            self._stamps[name] = stamp

    def remove(self, name: str) -> None:
        """Note a delete."""
        with self._guard:
            self._file.write(f"{json.dumps([name])}\n".encode())
            self._stamps.pop(name, None)

    def sync(self) -> None:
        """Make the notes durable."""
        os.fsync(self._file.fileno())

    def close(self) -> None:
        """Leave the journal."""
        self._file.close()


def copy_of(root: Path) -> str | None:
    """URL of the copy that an archive had last; None: it has none."""
    with suppress(OSError, ValueError, KeyError, TypeError), (root / NAME).open() as file:
        return str(json.loads(file.readline())["copy"])
    return None
