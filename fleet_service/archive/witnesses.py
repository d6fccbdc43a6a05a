"""Who a vehicle is to the map: one number for ever, while the archive knows it by another name in each month.

    keys/witness.key            of the service: a vehicle's number is its name's keyed hash
    keys/2026-01.witnesses      which pseudonym of the month is whose number; goes with the month's key
    keys/2026-01.TERM.witnesses likewise, of a service that succeeds others: each writes into a file of its own

One car must not be two witnesses because a month ended, or because it says so. The second file is for restarts and
replays, which see pseudonyms; a line that is lost or damaged makes one vehicle two again there, and nothing else. So
a service looks through them when it starts, counts what is damaged and takes it out; the vehicle's next batch writes
its line again.
"""

from __future__ import annotations

import errno
import os
import re
from collections.abc import Iterator, Mapping
from contextlib import suppress
from hashlib import blake2b
from pathlib import Path
from typing import Final

import numpy as np

from fleet_service.archive import layout, terms
from fleet_service.archive.pseudonyms import kept_key
from schemas.numeric import IntArray
from schemas.runtime.durable import sync_directory, written

ENDING: Final = ".witnesses"
_KEY: Final = "witness.key"
_LINE: Final = 24  # bytes: pseudonym, number, check
_SECRET: Final = 0o600
_MONTH: Final = re.compile(r"(\d{4}-\d{2})(\.\d{10})?")


class Witnesses:
    """Numbers of vehicles.

    Args:
        folder: where the keys lie.
    """

    def __init__(self, folder: Path) -> None:
        self._folder, self._term = folder, terms.of(folder.parent)
        self._key: bytes | None = None
        self._known: set[int] | None = None
        self._unsynced: set[Path] = set()

    def of(self, vehicle: str, month: str, pseudonym: int) -> int:
        """Number of a vehicle, which has this pseudonym in this month (2026-01); durable after `sync`.

        Raises:
            OSError: the key can neither be read nor written, or the line not be written.
        """
        if self._key is None or self._known is None:
            self._key = kept_key(self._folder / _KEY)
            self._known = set(read(self._folder))
        number = int.from_bytes(blake2b(vehicle.encode(), key=self._key, digest_size=8).digest(), signed=True)
        if pseudonym not in self._known:
            path = self._folder / f"{layout.with_term(month, self._term)}{ENDING}"
            path.touch(_SECRET)
            self._unsynced.add(path)
            with path.open("r+b", buffering=0) as file:
                file.seek(file.seek(0, os.SEEK_END) // _LINE * _LINE)  # over what a full disk left of a line
                if file.write(_line(pseudonym, number)) != _LINE:
                    raise OSError(errno.ENOSPC, "no room for a line", str(path))
            self._known.add(pseudonym)
        return number

    def sync(self) -> None:
        """Make the new lines durable: before anything of their vehicles is acknowledged.

        Raises:
            OSError: the disk is full or broken; it is tried again at the next call.
        """
        for path in sorted(self._unsynced):
            if path.exists():  # else the month was forgotten meanwhile
                with path.open("rb") as file:
                    os.fsync(file.fileno())
                sync_directory(self._folder)
            self._unsynced.discard(path)


def read(folder: Path) -> dict[int, int]:
    """Numbers by pseudonym, of all months; without lines that are damaged."""
    return {pseudonym: number for path in _files(folder) for pseudonym, number in _whole(path.read_bytes())}


def mend(folder: Path) -> int:
    """Take damaged lines out, and what is no line, where the disk lets it; returns how many there were.

    Raises:
        OSError: a file cannot be read.
    """
    damaged = 0
    for path in _files(folder):
        data = path.read_bytes()
        good = b"".join(_line(*both) for both in _whole(data))
        if len(good) < len(data):
            damaged += -(-(len(data) - len(good)) // _LINE)
            with suppress(OSError), written(path, _SECRET) as file:
                file.write(good)
    return damaged


def _files(folder: Path) -> list[Path]:
    """Of all months."""
    return [path for path in sorted(folder.glob(f"*{ENDING}")) if _MONTH.fullmatch(path.stem)]


def _whole(data: bytes) -> Iterator[tuple[int, int]]:
    """Pseudonym and number of every line that is as it was written."""
    for at in range(0, len(data) - _LINE + 1, _LINE):
        pseudonym, number = (int.from_bytes(data[at + k : at + k + 8], signed=True) for k in (0, 8))
        if data[at : at + _LINE] == _line(pseudonym, number):
            yield pseudonym, number


def numbers_of(known: Mapping[int, int], pseudonyms: IntArray) -> IntArray:
    """Numbers of pseudonyms (n,) by what `read` gave; one that is not known is its own."""
    if not known or not len(pseudonyms):
        return pseudonyms
    distinct, index = np.unique(pseudonyms, return_inverse=True)
    return np.asarray(np.array([known.get(one, one) for one in distinct.tolist()], np.int64)[index])


def forget(folder: Path, month: str, pseudonym: int | None = None) -> None:
    """Remove one vehicle's line of a month, or all of them."""
    for path in _files(folder):
        if path.name.partition(".")[0] != month:
            continue
        if pseudonym is None:
            path.unlink()
            continue
        data = path.read_bytes()
        lines = [data[at : at + _LINE] for at in range(0, len(data), _LINE)]
        with written(path, _SECRET) as file:
            file.write(b"".join(line for line in lines if int.from_bytes(line[:8], signed=True) != pseudonym))


def _line(pseudonym: int, number: int) -> bytes:
    both = pseudonym.to_bytes(8, signed=True) + number.to_bytes(8, signed=True)
    return both + blake2b(both, digest_size=8).digest()
