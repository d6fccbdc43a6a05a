"""Reader of CAN logs (BLF, ASC, candump, TRC, bus-logging MF4); a CAN database decodes the frames
to series.

A frame's time is that of its arrival. It is counted from the log's first frame in whole
microseconds, so that a drive has the same times in every format. Buses are numbered as python-can
does. If several buses carry a message, the frames of the bus named in the profile are used; if it
names none, those of the bus with the most frames of the wanted messages.
"""

from __future__ import annotations

import logging
from collections import defaultdict
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Final, TypeAlias

import numpy as np

from edge_agent.inputs.readers.dbc import LONGEST, Bytes, CanMessage, Database
from edge_agent.inputs.recording import Recording, Series, import_optional
from schemas.errors import InputError
from schemas.numeric import FloatArray
from schemas.thresholds import NS

SUFFIXES: Final = (".blf", ".asc", ".log", ".trc")
MICRO: Final = 1_000_000
LONGEST_LINE: Final = 1024  # [bytes] of an ASC file
BLF_SIZE: Final = slice(16, 24)  # bytes of a BLF file that state its size, 0 if it was not finished
# The year 2000 [s UTC]. A smaller time counts from the start of the log.
DATED_S: Final = 946_684_800.0
Key: TypeAlias = tuple[int, int, bool]  # bus, identifier, extended


@dataclass
class Frames:
    """CAN frames of one identifier on one bus: times of arrival [s as logged], and data bytes. Each
    frame is padded to LONGEST bytes; `lengths` are the lengths before padding.
    """

    times: list[float] = field(default_factory=list)
    data: bytearray = field(default_factory=bytearray)
    lengths: list[int] = field(default_factory=list)

    def add(self, time: float, data: bytes | bytearray) -> None:
        """Append one received CAN frame with its time of arrival [s] and its data bytes."""
        self.times.append(time)
        self.lengths.append(len(data))
        self.data += data[:LONGEST].ljust(LONGEST, b"\0")

    def to_columns(self) -> tuple[FloatArray, Bytes]:
        """Return the times of arrival (n,) and the data bytes (n, LONGEST) of the CAN frames."""
        return np.array(self.times), np.frombuffer(bytes(self.data), np.uint8).reshape(-1, LONGEST)


Log: TypeAlias = dict[Key, Frames]


Taker: TypeAlias = Callable[[set[int]], tuple[Log, float]]
"""Function that returns the frames with the wanted identifiers, and the time of the log's first
frame [s since 1970 UTC, or since the start of the log].
"""


def decode_log(
    take: Taker,
    name: str,
    database: Database,
    requested_signals: Iterable[str],
    buses: dict[str, int] | None = None,
) -> Recording:
    """Return the signals of a CAN log by their full names `MESSAGE.SIGNAL`.

    Args:
        take: function that returns the log's frames with the wanted identifiers.
        name: name of the log.
        database: CAN database that decodes the frames.
        requested_signals: full names of signals; names that the database or the log does not have
            are left out.
        buses: bus number by message, where it is known.
    """
    messages: dict[str, list[str]] = defaultdict(list)
    for whole in requested_signals:
        message, _, signal = whole.partition(".")
        if message in database and signal in database[message].signals:
            messages[message].append(signal)
    log, first = take({database[message].identifier for message in messages})
    recording = Recording(name, {}, round(first * NS) if first > DATED_S else None)
    for message, key in _find_messages(
        log, [database[message] for message in messages], buses or {}
    ).items():
        times, data = log[key].to_columns()
        layout = database[message]
        lengths = np.array(log[key].lengths)
        names = [s for s in messages[message] if layout.signals[s].last_byte < lengths.max()]
        t = np.rint((times - first) * MICRO) / MICRO
        order = np.argsort(t, kind="stable")
        for signal, values in layout.decode(data, names).items():
            values[layout.signals[signal].last_byte >= lengths] = np.nan  # a frame that was cut
            recording.signals[f"{message}.{signal}"] = Series(
                t[order], values[order], layout.signals[signal].unit
            )
    return recording


def require_steady_clock(path: Path, log: Log) -> Log:
    """Return the frames of a CAN log if the clock of its recorder was not set back.

    Frames in the order of their times then alternate between the parts of the log before and after
    this moment. Parts in a wrong order that do not overlap in time are no problem.

    Raises:
        InputError: the clock was set back, so that the true order of the frames is unknown.
    """
    for frames in log.values():
        order = np.argsort(frames.times, kind="stable")
        back = np.flatnonzero(np.diff(frames.times) < 0.0)
        if np.sum(np.diff(order) < 0) > len(back):
            raise InputError(
                "source",
                f"{path}: its clock was set back at {frames.times[back[0]]:.3f} s",
                "cut the log there",
            )
    return log


def no_database(path: Path) -> InputError:
    """Return the error that a log of CAN frames cannot be decoded without a CAN database."""
    return InputError(
        "dbc", f"{path} holds CAN frames", "name their database: --dbc, or dbc in the profile"
    )


def log_frames(path: Path, identifiers: set[int]) -> tuple[Log, float]:
    """Read a log of CAN frames with python-can. Return the frames whose identifier is in
    `identifiers`, and the time of the log's first frame [s].

    Raises:
        InputError: the log has no frame, or its clock was set back.
    """
    log: Log = defaultdict(Frames)
    first = np.inf
    # The library reports versions of traces at the levels INFO and WARNING.
    logging.getLogger("can").setLevel(logging.ERROR)
    with import_optional("can").LogReader(path) as reader:
        for message in _whole_messages(reader, path):
            time = message.timestamp
            first = min(first, time)
            if (
                message.arbitration_id in identifiers
                and not message.is_error_frame
                and not message.is_remote_frame
            ):
                log[bus_of(message.channel), message.arbitration_id, message.is_extended_id].add(
                    time, message.data
                )
    if not np.isfinite(first):
        raise InputError("source", f"{path} holds no CAN frame", "record it again")
    return require_steady_clock(path, log), float(first)


def _whole_messages(reader: Iterable[Any], path: Path) -> Iterator[Any]:
    """Yield the messages of a log without an incomplete last line, which the library python-can
    cannot read in an ASC file.
    """
    try:
        yield from reader
    except ValueError:
        file = getattr(reader, "file", None)
        if not _has_cut_line(path) or file is None or file.read(1):
            raise


def _has_cut_line(path: Path) -> bool:
    """Return True if an ASC file ends within a line."""
    if path.suffix.lower() != ".asc":
        return False
    with path.open("rb") as file:
        file.seek(max(0, path.stat().st_size - LONGEST_LINE))
        last = file.read().splitlines(keepends=True)[-1:]
    return bool(last) and not last[0].endswith((b"\n", b"\r")) and b"End" not in last[0]


def notes_if_cut(path: Path) -> list[str]:
    """Return a note if a BLF file is shorter than its header states, or an ASC file ends within a
    line, because it was truncated.
    """
    if _has_cut_line(path):
        return [f"{path.name}: cut off, its last line is incomplete"]
    if path.suffix.lower() != ".blf":
        return []
    with path.open("rb") as file:
        header = file.read(BLF_SIZE.stop)
    size = path.stat().st_size
    whole = int.from_bytes(header[BLF_SIZE], "little") if header.startswith(b"LOGG") else 0
    return [f"{path.name}: cut off, {size} of {whole} bytes are left"] if size < whole else []


def bus_of(channel: Any) -> int:  # noqa: ANN401 a number, a name or None
    """Return the number of a CAN bus from the name or number of its channel in a log: 1 for "can1"
    and for 1, 0 for a name without a number.
    """
    if isinstance(channel, int):
        return channel
    digits = "".join(c for c in str(channel or "") if c.isdigit())
    return int(digits[-3:]) if digits else 0


def _find_messages(log: Log, messages: list[CanMessage], buses: dict[str, int]) -> dict[str, Key]:
    """Return, for each of the `messages` that the log contains, the key (bus, identifier, extended)
    of its frames in the log, by message name.

    `buses` states the bus of some messages. For any other message the buses are searched, first the
    bus with the most frames of the `messages`.
    """
    counts: dict[int, int] = defaultdict(int)
    for message in messages:
        for (bus, identifier, extended), frames in log.items():
            if (identifier, extended) == (message.identifier, message.extended):
                counts[bus] += len(frames.times)
    likely = sorted(counts, key=lambda bus: (-counts[bus], bus))
    found: dict[str, Key] = {}
    for message in messages:
        candidates = [buses[message.name]] if message.name in buses else likely
        keys = [(bus, message.identifier, message.extended) for bus in candidates]
        present = [key for key in keys if key in log]
        if present:
            found[message.name] = present[0]
    return found
