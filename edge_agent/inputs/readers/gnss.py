"""Reader of positions from a file with one NMEA 0183 sentence or gpsd JSON object per line. Broken
lines are left out and counted.

Of the NMEA sentences, RMC is used: time with date, position, speed, course. A sentence with a wrong
checksum is broken.
"""

from __future__ import annotations

import json
import math
from datetime import UTC, datetime
from pathlib import Path
from typing import Final, NamedTuple

import numpy as np

from edge_agent.inputs.recording import Recording, Series, foreign_errors
from schemas.errors import InputError
from schemas.thresholds import NS

SUFFIXES: Final = (".nmea", ".gpsd", ".jsonl", ".json")
LONGEST_LINE: Final = 100_000
KNOT: Final = 1852.0 / 3600.0  # one knot [m/s]
UNITS: Final = {"latitude": "deg", "longitude": "deg", "speed": "m/s", "course": "deg"}


class Fix(NamedTuple):
    """A position fix: time [ns UTC], latitude and longitude [deg], speed [m/s], course [deg
    clockwise from north]; NaN where not given.
    """

    time: int
    latitude: float
    longitude: float
    speed: float
    course: float


def parse_nmea(line: str) -> Fix | None:
    """Return the position fix in an NMEA line with an RMC sentence. Return None for any other
    sentence, or if the receiver has no position.

    Raises:
        ValueError: the sentence is broken.
    """
    line = line.strip()
    if not line.startswith("$") or line[3:6] != "RMC":
        return None
    body, star, checksum = line[1:].partition("*")
    total = 0
    for byte in body.encode("ascii", "replace"):
        total ^= byte
    if not star or int(checksum[:2], 16) != total:
        raise ValueError("wrong checksum")
    parts = body.split(",")
    if len(parts) < 10:
        raise ValueError("too short")
    if parts[2] != "A":
        return None
    clock = parts[1]
    day = parts[9]
    whole = datetime.strptime(day + clock[:6], "%d%m%y%H%M%S").replace(tzinfo=UTC)
    time = int(whole.timestamp()) * NS + round(float(f"0{clock[6:]}") * NS)
    latitude = _parse_degrees(parts[3], 2) * (-1.0 if parts[4] == "S" else 1.0)
    longitude = _parse_degrees(parts[5], 3) * (-1.0 if parts[6] == "W" else 1.0)
    return _check_position(
        Fix(time, latitude, longitude, _parse_number(parts[7]) * KNOT, _parse_number(parts[8]))
    )


def parse_gpsd(line: str) -> Fix | None:
    """Return the position fix in a TPV report of gpsd. Return None for any other JSON object, or if
    the report has no position.

    Raises:
        ValueError: the line is not a JSON object, or a field is not a number.
    """
    report = json.loads(line)
    if not isinstance(report, dict):
        raise ValueError("no object")
    mode = report.get("mode", 0)
    if not isinstance(mode, (int, float)):
        raise ValueError("mode is not a number")
    if report.get("class") != "TPV" or mode < 2 or "time" not in report:
        return None
    moment = datetime.fromisoformat(str(report["time"])).astimezone(UTC)
    since_epoch = moment - datetime(1970, 1, 1, tzinfo=UTC)
    time = (since_epoch.days * 86_400 + since_epoch.seconds) * NS + since_epoch.microseconds * 1_000
    place = (float(report.get(key, math.nan)) for key in ("lat", "lon", "speed", "track"))
    return _check_position(Fix(time, *place))


def _parse_degrees(text: str, whole: int) -> float:
    return float(text[:whole]) + float(text[whole:]) / 60.0


def _parse_number(text: str) -> float:
    return float(text) if text else math.nan


def _check_position(fix: Fix) -> Fix:
    if not (abs(fix.latitude) <= 90.0 and abs(fix.longitude) <= 180.0):
        raise ValueError("position out of range")
    return fix


def read_gnss(path: Path) -> Recording:
    """Return the signals latitude, longitude, speed and course from a file of NMEA sentences or
    gpsd reports.

    Raises:
        InputError: the file cannot be read, or contains no position with a time.
    """
    fixes: list[Fix] = []
    broken = 0
    with foreign_errors(path, "GNSS"), path.open("rb") as file:
        while line := file.readline(LONGEST_LINE):
            text = line.decode("ascii", errors="replace").strip()
            try:
                fix = parse_gpsd(text) if text.startswith("{") else parse_nmea(text)
            except (ValueError, RecursionError, OverflowError, TypeError):
                broken += 1
                continue
            if fix is not None and (not fixes or fix.time > fixes[-1].time):
                fixes.append(fix)
            elif fix is not None and fix.time < fixes[-1].time:
                broken += 1
    if not fixes:
        raise InputError(
            "source", f"{path} holds no position with a time", "record RMC sentences, or gpsd's TPV"
        )
    start = fixes[0].time
    t = np.array([(fix.time - start) / NS for fix in fixes])
    signals = {
        name: Series(t, np.array([getattr(fix, name) for fix in fixes]), unit)
        for name, unit in UNITS.items()
    }
    notes = (
        [f"{path.name}: {broken} lines left out: broken, or earlier than a line before"]
        if broken
        else []
    )
    return Recording(path.name, signals, start, notes=notes, has_zone=True)
