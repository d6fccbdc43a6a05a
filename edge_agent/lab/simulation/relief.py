"""Relief of the road: its slope as the gradient of a height over the plane, and the crossfall
(sideways slope) of its lanes.

Legend
    h       height [m] over x (east) and y (north) [m]
    ∇h      slope: rise per metre east and per metre north [1]
    c       crossfall of a lane: fall per metre to its right [1]
    b       banking of bends [m]: b times the curvature of a bend is the slope by which its inner
            side is lower

The slope of the road is the sum of waves, crossfall and banking. A wave contributes ∇h = a cos(2π
s/λ + φ) e. The unit vector e is the wave's direction, s = (x, y)·e the position along it, a the
steepest slope, λ the wavelength [m] and φ the phase. A wave of infinite length is a constant slope.

The sum is limited to STEEPEST. Positions are measured along the road, so that a metre of road on a
slope of 8 % counts as a metre, although it is .997 m on a map. The sizes are those of real roads:
standard deviation 3 %, hardly ever more than 8 %, crossfall 2.5 %.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from enum import IntEnum
from typing import Final

import numpy as np

from edge_agent.lab.simulation.counter_rng import checked_seed, key_of, normal, uniform
from edge_agent.lab.simulation.unevenness import (
    COBBLES,
    HeightWave,
    SurfaceColumn,
    uneven_surface,
)
from schemas.errors import InputError
from schemas.numeric import FloatArray
from schemas.runtime.jit import compiled

STEEPEST: Final = 0.08  # public roads are rarely steeper
RELIEF_STREAM: Final = 20


@dataclass(frozen=True)
class Wave:
    """A slope that varies between -peak and peak along the direction `towards` [rad,
    counter-clockwise from x].
    """

    peak: float
    length: float = math.inf  # [m] wavelength; infinite for a constant slope
    towards: float = 0.0
    phase: float = 0.0  # [rad] phase of the wave at the origin
    stepped: bool = False  # True: the slope jumps between the two values

    def __post_init__(self) -> None:
        if not (abs(self.peak) <= STEEPEST and self.length > 0.0):
            raise InputError(
                "slope", f"{self.peak} over {self.length} m", f"give at most {STEEPEST} either way"
            )


@dataclass(frozen=True)
class Relief:
    """Slopes of the roads in a scenario. They are the sum of three parts: the slopes `waves`, the
    `crossfall` (sideways slope) of every lane [1], and the sideways slope of bends, which is
    `banking` [m] times the curvature of the bend. The waves `surface` make the road uneven.
    """

    waves: tuple[Wave, ...] = ()
    crossfall: float = 0.0
    banking: float = 0.0
    surface: tuple[HeightWave, ...] = ()

    @property
    def table(self) -> FloatArray:
        """Return the relief as a table, from which the function `gradient` reads, shape (1 + waves,
        6). The first row has crossfall and banking, and each further row one wave (`WaveColumn`).
        """
        table = np.zeros((1 + len(self.waves), len(WaveColumn)))
        table[0, :2] = self.crossfall, self.banking
        for row, wave in zip(table[1:], self.waves, strict=True):
            number = 2.0 * math.pi / wave.length
            row[:] = (
                wave.peak,
                math.cos(wave.towards),
                math.sin(wave.towards),
                number,
                wave.phase,
                wave.stepped,
            )
        return table

    @property
    def surface_table(self) -> FloatArray:
        """Return the unevenness as a table, from which the function `load_swing` reads, shape
        (waves, 4).
        """
        return np.array(self.surface).reshape(-1, len(SurfaceColumn))


class WaveColumn(IntEnum):
    """Index of a column in the rows of the relief table that describe waves. A wave is a slope that
    varies along one direction.
    """

    PEAK = 0
    EAST = 1
    NORTH = 2
    NUMBER = 3  # [rad/m]
    PHASE = 4
    STEPPED = 5


@compiled
def cross_slope(table: FloatArray, curvature: float) -> float:
    """Return the cross slope [1] of a lane with this `curvature` [1/m], positive if the road rises
    to the left.

    The cross slope is the crossfall minus the banking of the bend. In a bend to the left it is
    therefore smaller than on a straight road.
    """
    return float(table[0, 0] - table[0, 1] * curvature)


@compiled
def gradient(
    table: FloatArray, place: tuple[float, float], heading: tuple[float, float], left: float
) -> tuple[float, float]:
    """Return the slope of the road at `place` (x, y) [m] as the gradient of its height: rise per
    metre east and per metre north [1]. `table` is the relief table. The lane's cross slope is
    `left` [1]: the rise to the left of the direction `heading` (cos, sin).
    """
    east = -left * heading[1]
    north = left * heading[0]
    for k in range(1, table.shape[0]):
        row = table[k]
        along = place[0] * row[WaveColumn.EAST] + place[1] * row[WaveColumn.NORTH]
        slope = math.cos(row[WaveColumn.NUMBER] * along + row[WaveColumn.PHASE])
        if row[WaveColumn.STEPPED] > 0.0:
            slope = 1.0 if slope >= 0.0 else -1.0
        east += row[WaveColumn.PEAK] * slope * row[WaveColumn.EAST]
        north += row[WaveColumn.PEAK] * slope * row[WaveColumn.NORTH]
    steep = math.hypot(east, north)
    if steep > STEEPEST:
        east = east * STEEPEST / steep
        north = north * STEEPEST / steep
    return east, north


@compiled
def slope_in_body(east: float, north: float, yaw: float) -> tuple[float, float]:
    """Return the slope of the road, given as rise per metre east and north, in a vehicle's axes:
    rise per metre ahead and to the left for the heading `yaw` [rad].
    """
    c = math.cos(yaw)
    s = math.sin(yaw)
    return c * east + s * north, c * north - s * east


LEVEL: Final = Relief()


def level_relief(_seed: int) -> Relief:
    """Return a relief (slopes of the road surface) without slope or crossfall."""
    return LEVEL


def rolling_relief(seed: int) -> Relief:
    """Return a relief with two waves along the road, 300 and 120 m long, whose slopes reach 3 %."""
    key = key_of(seed, RELIEF_STREAM)
    return Relief(
        tuple(
            Wave(0.03, length, 0.0, _random_turn(key, k)) for k, length in enumerate((300.0, 120.0))
        )
    )


def stepped_relief(seed: int) -> Relief:
    """Return a relief whose slope alternates between +4 % and -4 % every 60 m, with kinks
    between.
    """
    return Relief(
        (Wave(0.04, 120.0, 0.0, _random_turn(key_of(seed, RELIEF_STREAM), 0), stepped=True),)
    )


def banked_relief(_seed: int) -> Relief:
    """Return a relief with a crossfall of 4 % and no longitudinal slope."""
    return Relief(crossfall=0.04)


def hilly_relief(seed: int) -> Relief:
    """Return a random relief: a constant slope (2 %), waves (up to 3 %) that also tilt the road
    sideways, steps, and crossfall.
    """
    key = key_of(seed, RELIEF_STREAM)
    waves = [
        Wave(0.03 * uniform(key, 10 + k), length, 0.5 * normal(key, 20 + k), _random_turn(key, k))
        for k, length in enumerate((400.0, 150.0))
    ]
    steps = Wave(0.02 * uniform(key, 12), 200.0, 0.0, _random_turn(key, 2), stepped=True)
    lasting = Wave(min(max(0.02 * normal(key, 30), -STEEPEST), STEEPEST))
    return Relief((lasting, *waves, steps), crossfall=0.025 * uniform(key, 13))


def cobbled_relief(seed: int) -> Relief:
    """Return a level relief of cobbles, on which the wheel loads swing."""
    return Relief(surface=uneven_surface(COBBLES, seed))


ROADS: Final[dict[str, Callable[[int], Relief]]] = {
    "level": level_relief,
    "rolling": rolling_relief,
    "stepped": stepped_relief,
    "banked": banked_relief,
    "hilly": hilly_relief,
    "cobbled": cobbled_relief,
}
"""Functions that return the relief of a test track for a seed, by name."""


def road_named(name: str | Relief, seed: int, slope: float = 0.0) -> Relief:
    """Return the relief called `name`, or the given relief, with a constant `slope` [1] along the
    track added.

    Raises:
        InputError: there is no relief with that name, or the slope is too steep.
    """
    if isinstance(name, str):
        if name not in ROADS:
            raise InputError(
                "road", f"there is no road {name!r}", f"choose one of {', '.join(ROADS)}"
            )
        name = ROADS[name](checked_seed(seed))
    return replace(name, waves=(*name.waves, Wave(slope))) if slope else name


def _random_turn(key: np.uint64, number: int) -> float:
    return 2.0 * math.pi * uniform(key, number)
