"""Tolerant parser of CAN databases (DBC), and decoder of frames, one signal for all frames at a
time.

Only `BO_` and `SG_` lines are read. Therefore names with blanks, duplicate messages and unknown
attributes, on which strict parsers fail, cause no error. Multiplexed signals are decoded only in
frames whose multiplexer value selects them. A little-endian signal counts up from the start bit. A
big-endian signal starts at its most significant bit and counts down within a byte, then continues
in the next byte.
"""

from __future__ import annotations

import re
from dataclasses import dataclass
from pathlib import Path
from typing import Final, TypeAlias

import numpy as np
from numpy.typing import NDArray

from edge_agent.inputs.profile import FOLDER, Profile
from schemas.errors import InputError
from schemas.numeric import FloatArray

EXTENDED: Final = 1 << 31  # flag in a DBC file of an identifier with 29 bits
LONGEST: Final = 64  # [byte] size of a CAN FD frame
MOST_BYTES: Final = 16_000_000  # size of a database; the largest public one has 2 MB

_MESSAGE: Final = re.compile(r"^\s*BO_\s+(\d+)\s+([^:\s]+)\s*:\s*(\d+)")
# No two neighbouring parts match the same characters. Therefore the time of a match is linear in
# the length of a line.
_SIGNAL: Final = re.compile(
    r"^\s*SG_\s(?P<label>[^:]+):\s*(?P<start>\d+)\|(?P<size>\d+)@(?P<order>[01])(?P<sign>[+-])"
    r"\s*\(\s*(?P<factor>[^,\s][^,]*),(?P<offset>[^)]+)\)\s*(?:\[[^\]]*\])?"
    r"\s*(?:\"(?P<unit>[^\"]*)\")?"
)
# Multiplexing mark of a signal: the last word after its name and before the colon.
_MULTIPLEXED: Final = re.compile(r"M|m\d+M?")
Bytes: TypeAlias = NDArray[np.uint8]


@dataclass(frozen=True)
class Signal:
    """Position of a signal in a CAN frame (start and size [bit], byte order), and its conversion to
    a physical value.
    """

    name: str
    start: int
    size: int
    little: bool
    signed: bool
    factor: float
    offset: float
    unit: str
    switch: int | None = None  # value of the multiplexer at which the signal is present

    def decode(self, data: Bytes) -> FloatArray:
        """Return the physical values (n,) of the signal in n CAN frames with the data bytes `data`
        (n, LONGEST).
        """
        raw = self._raw_values(data)
        number: NDArray[np.int64] | NDArray[np.uint64] = (
            raw.view(np.int64) if self.size < 64 or self.signed else raw
        )
        if self.signed and self.size < 64:
            top = np.int64(1) << np.int64(self.size - 1)
            number = (number ^ top) - top
        return np.asarray(number * self.factor + self.offset, dtype=np.float64)

    def _raw_values(self, data: Bytes) -> NDArray[np.uint64]:
        raw = np.zeros(len(data), np.uint64)
        if self.little:
            first = self.start // 8
            last = (self.start + self.size - 1) // 8
            for place, byte in enumerate(range(first, last + 1)):
                shift = 8 * place - self.start % 8
                part = data[:, byte].astype(np.uint64)
                raw |= part << np.uint64(shift) if shift >= 0 else part >> np.uint64(-shift)
        else:
            left = self.size
            byte = self.start // 8
            top = self.start % 8
            while left > 0:
                bits = min(left, top + 1)
                part = (data[:, byte] >> np.uint8(top + 1 - bits)) & np.uint8((1 << bits) - 1)
                raw = (raw << np.uint64(bits)) | part.astype(np.uint64)
                left = left - bits
                byte = byte + 1
                top = 7
        return raw if self.size == 64 else raw & np.uint64((1 << self.size) - 1)

    @property
    def last_byte(self) -> int:
        """Return the index of the last byte of the CAN frame that contains bits of the signal."""
        if self.little:
            return (self.start + self.size - 1) // 8
        return self.start // 8 + max(0, -(-(self.size - self.start % 8 - 1) // 8))


@dataclass(frozen=True)
class CanMessage:
    """A message of a CAN database: identifier without the extended flag, length [byte], and signals
    by name.
    """

    name: str
    identifier: int
    extended: bool
    length: int
    signals: dict[str, Signal]
    multiplexer: str | None = None

    def decode(self, data: Bytes, names: list[str]) -> dict[str, FloatArray]:
        """Decode n CAN frames of this message with the data bytes `data` (n, LONGEST). Return the
        physical values (n,) of the signals `names`; NaN where a frame does not contain a
        multiplexed signal.
        """
        found = {name: self.signals[name].decode(data) for name in names}
        switched = [name for name in names if self.signals[name].switch is not None]
        if switched and self.multiplexer is not None:
            now = self.signals[self.multiplexer].decode(data)
            for name in switched:
                found[name][now != self.signals[name].switch] = np.nan
        return found


Database: TypeAlias = dict[str, CanMessage]


def read_dbc(path: Path) -> Database:
    """Read a CAN database file, and return its messages by name.

    Raises:
        InputError: the file cannot be read, is too large, or contains no message with a signal.
    """
    try:
        if path.stat().st_size > MOST_BYTES:
            raise InputError(
                "dbc", f"{path} has more than {MOST_BYTES} bytes", "name a CAN database"
            )
        text = path.read_bytes().decode("utf-8", errors="replace")
    except OSError as error:
        raise InputError(
            "dbc", f"cannot read {path} ({error.strerror})", "name a CAN database"
        ) from error
    database = parse_dbc(text)
    if not any(message.signals for message in database.values()):
        raise InputError(
            "dbc", f"{path} holds no message with signals", "name a CAN database (DBC)"
        )
    return database


def parse_dbc(text: str) -> Database:
    """Return the messages in the text of a CAN database, by name. Invalid lines are left out; of
    two messages with the same name, the last one is used.
    """
    database: Database = {}
    message: CanMessage | None = None
    for line in text.splitlines():
        if found := _MESSAGE.match(line):
            number = int(found[1])
            length = int(found[3])
            message = CanMessage(
                found[2], number & (EXTENDED - 1), bool(number & EXTENDED), length, {}
            )
            database[message.name] = message
        elif message is not None and (found := _SIGNAL.match(line)):
            signal, mux = _parse_signal(found)
            if signal is None or signal.last_byte >= min(max(message.length, 1), LONGEST):
                continue
            message.signals[signal.name] = signal
            if mux == "M":
                message = CanMessage(**{**vars(message), "multiplexer": signal.name})
                database[message.name] = message
        elif line.strip() and not line.lstrip().startswith("SG_"):
            message = None
    return database


def _parse_signal(found: re.Match[str]) -> tuple[Signal | None, str]:
    """Return the signal that a line of a CAN database defines, and its multiplexer mark ("" for a
    signal that every frame has). The signal is None if the line is invalid.
    """
    words = found["label"].split()
    mux = words.pop() if len(words) > 1 and _MULTIPLEXED.fullmatch(words[-1]) else ""
    try:
        signal = Signal(
            name=re.sub(r"\W", "_", " ".join(words)),
            start=int(found["start"]),
            size=int(found["size"]),
            little=found["order"] == "1",
            signed=found["sign"] == "-",
            factor=float(found["factor"]),
            offset=float(found["offset"]),
            unit=found["unit"] or "",
            switch=int(mux[1:].rstrip("M")) if mux.startswith("m") else None,
        )
    except ValueError:
        return None, mux
    is_valid = signal.name and 0 < signal.size <= 64 and signal.start < 8 * LONGEST
    return (signal if is_valid and np.isfinite([signal.factor, signal.offset]).all() else None), mux


def database_of(profile: Profile | None, folder: Path, given_file: Path | None) -> Database | None:
    """Return the CAN database to use: the file `given_file` on the command line, else the file that
    the profile names (in `folder`, or shipped with the package), else None.
    """
    if given_file is not None:
        return read_dbc(given_file)
    if profile is None or profile.dbc is None:
        return None
    local_file = folder / profile.dbc
    return read_dbc(
        local_file
        if local_file.exists() or not (FOLDER / profile.dbc).exists()
        else FOLDER / profile.dbc
    )
