"""Reader of Racelogic VBO files, and of tables with the same columns.

Both have these units:

    time        hhmmss.ss UTC of the day
    lat, long   minutes, west positive
    velocity    km/h
    heading     degrees, clockwise from north
"""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Final

import numpy as np

from edge_agent.inputs.recording import Recording, Series, foreign_errors
from schemas.errors import InputError
from schemas.numeric import FloatArray

SUFFIXES: Final = (".vbo",)
DAY_S: Final = 86_400.0
# VBO files contain positions in arc minutes, with longitude positive to the west
MINUTES: Final = 60.0
LARGEST_G: Final = 3.0  # an acceleration without a unit whose values stay below this limit is in g
UNITS: Final = {"velocity": "km/h", "heading": "deg", "height": "m"}
NAMES: Final = {"lat": "latitude", "long": "longitude", "velocity": "speed", "heading": "course"}


def is_vbo(path: Path) -> bool:
    """Return True if a file has the sections of a VBO file; its suffix does not matter."""
    with path.open("rb") as file:
        head = file.read(65_536).decode("utf-8", errors="replace").lower()
    return "[column names]" in head and ("[header]" in head or head.startswith("file created on"))


def has_vbo_columns(columns: Mapping[str, FloatArray]) -> bool:
    """Return True if a table has the columns of a VBO file, (T,) each. Columns with these names
    whose positions are in degrees are those of another logger.
    """
    lower = {name.lower(): values for name, values in columns.items()}
    for names in (("sats", "lat", "long"), ("satellites", "latitude", "longitude")):
        if {"time", *names} <= lower.keys():
            north, west = (np.abs(np.nan_to_num(lower[name])).max() for name in names[1:])
            return bool(north == 0.0 or north > 90.0 or west > 180.0)
    return False


def read_vbo(path: Path) -> Recording:
    """Return the columns of a VBO file as signals.

    Raises:
        InputError: a section is missing, no row is complete, or the time cannot be read.
    """
    with foreign_errors(path, "VBO"):
        sections = _read_sections(path)
        names = " ".join(sections.get("column names", [])).replace(",", " ").split()
        rows = [line.replace(",", " ").split() for line in sections.get("data", [])]
        numbers = [[float(value) for value in row] for row in rows if len(row) == len(names)]
        if not names or not numbers:
            raise InputError("source", f"{path} has no column names or no data", "record it again")
        table = np.array(numbers)
        units = sections.get("channel units", [])
        own = names[len(names) - len(units) :] if len(units) <= len(names) else []
        return convert_vbo(
            path, {n: table[:, i] for i, n in enumerate(names)}, dict(zip(own, units, strict=False))
        )


def convert_vbo(
    path: Path, columns: Mapping[str, FloatArray], units: Mapping[str, str]
) -> Recording:
    """Return a recording of the columns of a VBO file, (T,) each, converted from the units of that
    format to those of the signal log. `units` are the stated units by column.
    """
    lower = {name.lower(): name for name in columns}
    clock = columns[lower["time"]]
    whole = np.floor(clock / 100.0)
    seconds = np.floor(whole / 100.0) * 3600.0 + np.mod(whole, 100.0) * 60.0 + np.mod(clock, 100.0)
    t = seconds + DAY_S * np.concatenate([[0.0], np.cumsum(np.diff(seconds) < -0.5 * DAY_S)])
    back = np.flatnonzero(~(np.diff(t) >= 0.0))
    if len(back) or not np.isfinite(t[0]):
        raise InputError(
            "time",
            f"{path} goes back at row {int(back[0]) + 1 if len(back) else 0}",
            "sort it by time",
        )
    recording = Recording(path.name, {}, rows=True)
    recording.notes.append(
        f"{path.name}: Racelogic columns: time as hhmmss, places in minutes, west positive"
    )
    for name, values in columns.items():
        short = name.lower()
        if short == "time":
            continue
        unit = units.get(name, UNITS.get(short, ""))
        if short in ("lat", "latitude", "long", "longitude"):
            values = values / (-MINUTES if short.startswith("long") else MINUTES)
            unit = "deg"
        elif "acc" in short and not unit and np.nanmax(np.abs(values)) < LARGEST_G:
            unit = "g"
            recording.notes.append(f"{path.name}: {name} has no unit; assumed to be in g")
        recording.signals[NAMES.get(short, name)] = Series(t - t[0], values, unit)
    return recording


def _read_sections(path: Path) -> dict[str, list[str]]:
    sections: dict[str, list[str]] = {}
    lines: list[str] = []
    for raw in path.read_bytes().decode("utf-8", errors="replace").splitlines():
        line = raw.strip()
        if line.startswith("[") and line.endswith("]"):
            lines = sections.setdefault(line[1:-1].lower(), [])
        elif line:
            lines.append(line)
    return sections
