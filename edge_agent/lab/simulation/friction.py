"""Friction of the road as a function of position and time: a background value, and rotated
rectangles (patches) that replace it.

Where patches overlap, the last one in the list counts. Each patch has its true friction (`mu`) and
the friction that a driver expects from its appearance (`looks`). Black ice looks like the road
around it, so drivers respond late.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from enum import IntEnum

import numpy as np

from schemas.errors import InputError
from schemas.numeric import FloatArray
from schemas.runtime.jit import compiled

# Friction of the surfaces in the scenarios: peak adhesion of a passenger car's tyre, middle of the
# usual ranges.
DRY = 0.90
WET = 0.60
SNOW = 0.35
ICE = 0.18


@dataclass(frozen=True)
class Patch:
    """A rectangular patch of road surface.

    `x, y` centre [m]; `length` along the direction `angle` [rad, counter-clockwise from x] and
    `width` across [m]; `mu` its friction; `looks` the friction that a driver expects from its
    appearance (None: that of the surface beneath); present for `start` <= t < `end` [s].
    """

    name: str
    x: float
    y: float
    length: float
    width: float
    mu: float
    angle: float = 0.0
    looks: float | None = None
    start: float = -math.inf
    end: float = math.inf

    def __post_init__(self) -> None:
        if not 0.0 < self.mu <= 2.0:
            raise InputError(
                "mu", f"patch {self.name} has friction {self.mu}", "give a number in (0, 2]"
            )
        if not (self.length > 0.0 and self.width > 0.0 and self.start < self.end):
            raise InputError(
                "patch",
                f"{self.name} covers no area or no time",
                "give positive sizes, and start before end",
            )


class PatchColumn(IntEnum):
    """Index of a column in the friction table, which has one row per patch of road surface."""

    X = 0
    Y = 1
    COS = 2
    SIN = 3
    HALF_LENGTH = 4
    HALF_WIDTH = 5
    START = 6
    END = 7
    MU = 8
    LOOKS = 9


def friction_table(background: float, patches: tuple[Patch, ...]) -> FloatArray:
    """Return the friction table, from which `look_up` reads: one row per patch, with the columns of
    `PatchColumn`, shape (1 + patches, 10). The first row is the friction `background`, a patch
    without limits.
    """
    everywhere = Patch("background", 0.0, 0.0, math.inf, math.inf, background, looks=background)
    table = np.empty((1 + len(patches), len(PatchColumn)))
    for row, p in zip(table, (everywhere, *patches), strict=True):
        looks = math.nan if p.looks is None else p.looks
        box = (p.x, p.y, math.cos(p.angle), math.sin(p.angle), p.length / 2, p.width / 2)
        row[:] = (*box, p.start, p.end, p.mu, looks)
    return table


@compiled
def look_up(table: FloatArray, column: int, t: float, x: float, y: float) -> float:
    """Return the value of `column`, MU (true friction) or LOOKS (friction that a driver expects),
    at (x, y) [m] and t [s]. The value comes from the last row of the table that covers the point at
    this time and is not NaN in this column.
    """
    for i in range(table.shape[0] - 1, 0, -1):
        row = table[i]
        if t < row[PatchColumn.START] or t >= row[PatchColumn.END] or math.isnan(row[column]):
            continue
        dx = x - row[PatchColumn.X]
        dy = y - row[PatchColumn.Y]
        along = dx * row[PatchColumn.COS] + dy * row[PatchColumn.SIN]
        across = dy * row[PatchColumn.COS] - dx * row[PatchColumn.SIN]
        if (
            abs(along) <= row[PatchColumn.HALF_LENGTH]
            and abs(across) <= row[PatchColumn.HALF_WIDTH]
        ):
            return float(row[column])
    return float(table[0, column])


@compiled
def look_up_many(
    table: FloatArray, column: int, t: FloatArray, x: FloatArray, y: FloatArray
) -> FloatArray:
    """Return the values of `column` (true or expected friction) in the friction table at many
    points, for arrays t [s], x, y [m] of equal length.
    """
    values = np.empty(x.size)
    for i in range(x.size):
        values[i] = look_up(table, column, t[i], x[i], y[i])
    return values
