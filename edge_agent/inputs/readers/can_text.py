"""Reader of CAN frames in two text formats that python-can does not read: the GVRET CSV of
SavvyCAN, and PCAN traces without a header.
"""

from __future__ import annotations

import csv
import re
from collections import defaultdict
from pathlib import Path
from typing import Final

from edge_agent.inputs.readers.can_log import Frames, Log, require_steady_clock
from schemas.errors import InputError

MICRO: Final = 1e-6
MILLI: Final = 1e-3
LONGEST_LINE: Final = 4096
_TRACE: Final = re.compile(
    r"^\s*\d+\)\s+(?P<time>\d+(?:\.\d+)?)\s+(?:(?P<bus>\d{1,2})\s+)?(?:(?:Rx|Tx|DT)\s+)?"
    r"(?P<id>[0-9A-Fa-f]{3,8})\s+(?:(?:Rx|Tx|-)\s+)?(?P<size>\d)\s+"
    r"(?P<data>(?:[0-9A-Fa-f]{2}\s*)*)$"
)


def is_gvret(path: Path) -> bool:
    """Return True if a CSV file has the header of SavvyCAN's native format."""
    with path.open("rb") as file:
        head = file.readline(LONGEST_LINE).decode("utf-8", errors="replace").lower()
    names = [name.strip() for name in head.split(",")]
    return {"time stamp", "id", "extended", "len", "d1"} <= set(names)


def is_bare_trace(path: Path) -> bool:
    """Return True if a PCAN trace (text file of CAN frames) lacks the header that states the
    version of its format.
    """
    with path.open("rb") as file:
        head = file.read(65_536).decode("utf-8", errors="replace")
    return "$FILEVERSION" not in head


def gvret_frames(path: Path, identifiers: set[int]) -> tuple[Log, float]:
    """Return the CAN frames of a GVRET CSV file whose identifier is in `identifiers`, and the time
    of the file's first frame [s].

    Raises:
        InputError: a row has another format; the error names the row.
    """
    log: Log = defaultdict(Frames)
    first = None
    with path.open(encoding="utf-8", errors="replace", newline="") as file:
        reader = csv.reader(file)
        places = {name.strip().lower(): place for place, name in enumerate(next(reader))}
        for number, row in enumerate(reader, 2):
            if not row:
                continue
            try:
                time = float(row[places["time stamp"]]) * MICRO
                identifier = int(row[places["id"]], 16)
                size = int(row[places["len"]])
                start = places["d1"]
                data = bytes(int(value, 16) for value in row[start : start + size])
                bus = int(row[places["bus"]]) if "bus" in places else 0
                extended = row[places["extended"]].strip().lower() in ("true", "1")
            except (ValueError, IndexError) as error:
                raise InputError(
                    "source",
                    f"{path} has no frame in line {number} ({error})",
                    "export the log again",
                ) from error
            first = time if first is None else first
            if identifier in identifiers:
                log[bus, identifier, extended].add(time, data)
    return require_steady_clock(path, log), first or 0.0


def trace_frames(path: Path, identifiers: set[int]) -> tuple[Log, float]:
    """Return the CAN frames of a PCAN trace without header whose identifier is in `identifiers`,
    and the time of the trace's first frame [s]. The trace itself has times in milliseconds.

    Raises:
        InputError: no line is a frame.
    """
    log: Log = defaultdict(Frames)
    first = None
    with path.open(encoding="utf-8", errors="replace") as file:
        for line in file:
            found = _TRACE.match(line)
            if found is None:
                continue
            time = float(found["time"]) * MILLI
            first = time if first is None else first
            identifier = int(found["id"], 16)
            if identifier in identifiers:
                data = bytes.fromhex(found["data"].replace(" ", ""))
                log[int(found["bus"] or 0), identifier, len(found["id"]) > 4].add(time, data)
    if first is None:
        raise InputError(
            "source",
            f"{path} holds no frame that can be read",
            "save the trace as PCAN 1.1 or later",
        )
    return require_steady_clock(path, log), first
