"""Pseudonyms: keyed hashes of vehicle names, and of the identifiers of vehicle starts, with one key
per month.

Destroying a month's key makes the rows of this month anonymous. The hash of a vehicle start differs
per month too; otherwise a drive over the end of a month would link the pseudonyms of two months.
The month of the first record of a batch (message with records) selects the key, so that a repeated
batch has the same pseudonym.
"""

from __future__ import annotations

import errno
import secrets
from datetime import UTC, datetime
from functools import lru_cache
from hashlib import blake2b
from pathlib import Path
from typing import Final

import numpy as np
from numpy.typing import NDArray

from schemas.numeric import IntArray
from schemas.runtime.durable import open_durably, sync_directory

KEY_BYTES: Final = 32
# Number of months whose pseudonyms are cached. Records of other months are rare.
MONTHS_KNOWN: Final = 2
_DIGEST_BYTES: Final = 8  # 64 bits: a collision among 10⁶ vehicles has probability 3e-8
_DAY_NS: Final = 86_400_000_000_000


@lru_cache(1 << 16)
def pseudonym_number(pseudonym: str) -> int:
    """Return a pseudonym (hexadecimal text) as a signed 64-bit number."""
    return int.from_bytes(bytes.fromhex(pseudonym), signed=True)


def pseudonym_texts(numbers: IntArray) -> NDArray[np.bytes_]:
    """Return the pseudonyms (n,) as text from their numbers; the inverse of `pseudonym_number`."""
    return np.frombuffer(numbers.astype(">i8").tobytes().hex().encode(), f"S{2 * _DIGEST_BYTES}")


class Pseudonyms:
    """Mapping from vehicle names to pseudonyms.

    Args:
        folder: folder of the keys, one file of mode 600 per month; a missing key is created.
    """

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        self._keys: dict[str, bytes] = {}
        self._known: dict[str, dict[str, str]] = {}  # by month, then by vehicle
        self._month_of_day: dict[int, str] = {}

    def of(self, vehicle: str, time: int) -> str:
        """Return the pseudonym (16 hexadecimal digits) of a vehicle in the month of `time` [ns].

        Raises:
            OSError: the key of the month can neither be read nor created.
        """
        month = self._month(time // _DAY_NS)
        known = self._known.get(month)
        if known is None:
            known = {}
            self._known[month] = known
            if len(self._known) > MONTHS_KNOWN:
                del self._known[min(self._known)]
        pseudonym = known.get(vehicle)
        if pseudonym is None:
            digest = blake2b(vehicle.encode(), key=self._key(month), digest_size=_DIGEST_BYTES)
            pseudonym = digest.hexdigest()
            known[vehicle] = pseudonym
        return pseudonym

    def boot(self, vehicle: str, boot: int, time: int) -> int:
        """Return a pseudonym (number of 63 bits) for one start of a vehicle's agent. In the
        archive, it replaces `boot`, the number of this start in the vehicle's messages. The
        pseudonym is a keyed hash with the secret key of the month that contains `time` [ns].

        Raises:
            OSError: the key of the month can neither be read nor created.
        """
        text = f"{vehicle}/{boot}".encode()
        digest = blake2b(text, key=self._key(self.month(time)), digest_size=_DIGEST_BYTES).digest()
        return int.from_bytes(digest) >> 1

    def _month(self, day: int) -> str:
        month = self._month_of_day.get(day)
        if month is None:
            month = f"{datetime.fromtimestamp(day * 86400, UTC):%Y-%m}"
            self._month_of_day[day] = month
        return month

    def month(self, time: int) -> str:
        """Return the month (2026-01) that contains `time` [ns]; its key makes the pseudonyms."""
        return self._month(time // _DAY_NS)

    def _key(self, month: str) -> bytes:
        if month not in self._keys:
            self._keys[month] = load_or_create_key(self.folder / f"{month}.key")
        return self._keys[month]


def load_or_create_key(path: Path) -> bytes:
    """Return a secret key from a file of mode 600; create the file if it does not exist.

    Raises:
        OSError: the file can neither be read nor written, or is damaged.
    """
    if not path.exists():
        path.parent.mkdir(mode=0o700, parents=True, exist_ok=True)
        with open_durably(path, 0o600) as file:
            key = secrets.token_bytes(KEY_BYTES)
            file.write(key + _key_digest(key))
        # Without this, a power loss could remove the key, and acknowledged batches would be lost
        # with it.
        sync_directory(path.parent.parent)
    return _read_key(path)


def _read_key(path: Path) -> bytes:
    """Return a secret key from a file after verification; keys of an earlier version have no digest
    and are not verified.

    Raises:
        OSError: the key is damaged. With a wrong key all pseudonyms would differ, and every batch
            would be accepted again.
    """
    data = path.read_bytes()
    key = data[:KEY_BYTES]
    check = data[KEY_BYTES:]
    if len(key) < KEY_BYTES or (check and check != _key_digest(key)):
        raise OSError(errno.EIO, "the key is damaged; restore it from a backup", str(path))
    return key


def _key_digest(key: bytes) -> bytes:
    return blake2b(key, digest_size=_DIGEST_BYTES).digest()
