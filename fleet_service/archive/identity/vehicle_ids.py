"""Permanent vehicle numbers for the map: one number per vehicle for ever, although the vehicle's
pseudonym in the archive changes each month.

    keys/witness.key            secret key: a vehicle's number is the keyed hash of its name
    keys/2026-01.witnesses      number of each pseudonym of the month; removed with the secret key
                                of the month's pseudonyms
    keys/2026-01.TERM.witnesses the same for a service that owns the archive by a lease; each
                                service writes a file of its own

The map counts each vehicle as one independent source ("witness"). By its pseudonyms, a vehicle
would count as two sources after the end of a month; by its permanent number, it counts as one.

The archive contains only pseudonyms. A replay of the archive therefore reads the permanent numbers
from the files per month. If a line of these files is lost or damaged, a replay counts the vehicle
as two; there is no other effect. At its start, a service counts and removes damaged lines. The
vehicle's next batch (message with records) writes its line again.
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

from fleet_service.archive.format import layout
from fleet_service.archive.identity.pseudonyms import load_or_create_key
from schemas.numeric import IntArray
from schemas.runtime.durable import open_durably, sync_directory

ENDING: Final = ".witnesses"
_KEY: Final = "witness.key"
_LINE: Final = 24  # bytes per line: pseudonym, number, checksum
_SECRET: Final = 0o600
_MONTH: Final = re.compile(r"(\d{4}-\d{2})(\.\d{10})?")


class VehicleIds:
    """Permanent numbers of vehicles, by which the map distinguishes them.

    Args:
        folder: folder of the keys.
    """

    def __init__(self, folder: Path) -> None:
        self._folder = folder
        self._term = layout.read_epoch(folder.parent)
        self._key: bytes | None = None
        self._known: set[int] | None = None
        self._unsynced: set[Path] = set()

    def id_of(self, vehicle: str, month: str, pseudonym: int) -> int:
        """Return the permanent number of a vehicle and record it for the vehicle's pseudonym in the
        month `month` (2026-01). The record is durable after `sync`.

        Raises:
            OSError: the secret key can neither be read nor created, or the record cannot be
                written.
        """
        number = self.number_of(vehicle)
        if self._known is None:
            self._known = set(read_numbers(self._folder))
        if pseudonym not in self._known:
            path = self._folder / f"{layout.with_term(month, self._term)}{ENDING}"
            path.touch(_SECRET)
            self._unsynced.add(path)
            with path.open("r+b", buffering=0) as file:
                # Overwrite an incomplete line that a full disk has left.
                file.seek(file.seek(0, os.SEEK_END) // _LINE * _LINE)
                if file.write(_encode_line(pseudonym, number)) != _LINE:
                    raise OSError(errno.ENOSPC, "no space for another line", str(path))
            self._known.add(pseudonym)
        return number

    def number_of(self, vehicle: str) -> int:
        """Return the permanent number of a vehicle: the keyed hash (64 bits, signed) of its name.

        Raises:
            OSError: the secret key of the hash can neither be read nor created.
        """
        if self._key is None:
            self._key = load_or_create_key(self._folder / _KEY)
        return int.from_bytes(
            blake2b(vehicle.encode(), key=self._key, digest_size=8).digest(), signed=True
        )

    def sync(self) -> None:
        """Sync the new lines (pseudonym and number of a vehicle) to disk. The service calls this
        before it acknowledges any record of these vehicles.

        Raises:
            OSError: the disk is full or broken; the next call tries again.
        """
        for path in sorted(self._unsynced):
            if path.exists():  # unless the month has been erased
                with path.open("rb") as file:
                    os.fsync(file.fileno())
                sync_directory(self._folder)
            self._unsynced.discard(path)


def read_numbers(folder: Path) -> dict[int, int]:
    """Return a mapping from pseudonym to permanent number for all months; damaged lines are
    skipped.
    """
    return {
        pseudonym: number
        for path in _month_files(folder)
        for pseudonym, number in _undamaged_lines(path.read_bytes())
    }


def remove_damaged_lines(folder: Path) -> int:
    """Rewrite the files with the permanent vehicle numbers, so that only lines with a correct
    checksum stay; return the number of damaged lines. A file that cannot be written stays
    unchanged, because readers skip damaged lines.

    Raises:
        OSError: a file cannot be read.
    """
    damaged = 0
    for path in _month_files(folder):
        data = path.read_bytes()
        good = b"".join(_encode_line(*both) for both in _undamaged_lines(data))
        if len(good) < len(data):
            damaged += -(-(len(data) - len(good)) // _LINE)
            with suppress(OSError), open_durably(path, _SECRET) as file:
                file.write(good)
    return damaged


def _month_files(folder: Path) -> list[Path]:
    """Return the paths of the files with the permanent vehicle numbers of all months."""
    return [path for path in sorted(folder.glob(f"*{ENDING}")) if _MONTH.fullmatch(path.stem)]


def _undamaged_lines(data: bytes) -> Iterator[tuple[int, int]]:
    """Yield (pseudonym, permanent number) for each undamaged line of the content `data` of a file
    with permanent vehicle numbers.
    """
    for at in range(0, len(data) - _LINE + 1, _LINE):
        pseudonym = int.from_bytes(data[at : at + 8], signed=True)
        number = int.from_bytes(data[at + 8 : at + 16], signed=True)
        if data[at : at + _LINE] == _encode_line(pseudonym, number):
            yield pseudonym, number


def numbers_of(known: Mapping[int, int], pseudonyms: IntArray) -> IntArray:
    """Return the permanent numbers of vehicles (n,), given by pseudonyms (n,), according to the
    result of `read_numbers`. An unknown pseudonym is returned unchanged.
    """
    if not known or not len(pseudonyms):
        return pseudonyms
    distinct, index = np.unique(pseudonyms, return_inverse=True)
    return np.asarray(np.array([known.get(one, one) for one in distinct.tolist()], np.int64)[index])


def forget_vehicles(folder: Path, month: str, pseudonym: int | None = None) -> None:
    """Remove the line that links one vehicle's pseudonym of a month to its permanent number; if
    `pseudonym` is None, remove all lines of the month.
    """
    for path in _month_files(folder):
        if path.name.partition(".")[0] != month:
            continue
        if pseudonym is None:
            path.unlink()
            continue
        data = path.read_bytes()
        lines = [data[at : at + _LINE] for at in range(0, len(data), _LINE)]
        with open_durably(path, _SECRET) as file:
            file.write(
                b"".join(
                    line for line in lines if int.from_bytes(line[:8], signed=True) != pseudonym
                )
            )


def _encode_line(pseudonym: int, number: int) -> bytes:
    both = pseudonym.to_bytes(8, signed=True) + number.to_bytes(8, signed=True)
    return both + blake2b(both, digest_size=8).digest()
