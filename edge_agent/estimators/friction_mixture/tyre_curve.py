"""The tyre curve of the nodes as tables: force, slope, slip at a force, and how tyres differ in shape.

Legend
    theta    normalised slip, see edge_agent.dynamics.tyres           [1]
    f        force over mu*F_z, peak 1                                  [1]
    shape    half the difference between a sharp and a round tyre: one standard deviation of shape; it changes
             sign at the peak, for what rises steeply also falls steeply [1]
    u        theta/(1 + theta), where the tables of theta are even       [1]
    t        sqrt(1 - f), where the inverse is smooth up to the peak     [1]
"""

from __future__ import annotations

import math
from typing import Annotated, Final, NamedTuple

import numpy as np

from schemas.numeric import FloatArray
from schemas.runtime.jit import compiled

CELLS: Final = 1024  # linear between: errors below 1e-6 of the force
# (c, e) of the Magic Formula: tyres of passenger cars lie between, the brush model two spreads beyond the round one
SHARP: Final = (1.60, -0.45)
ROUND: Final = (1.33, 0.05)


class TyreCurve(NamedTuple):
    """Tables of CELLS + 1 values."""

    ratio: Annotated[FloatArray, CELLS + 1]  # f/theta over u
    slope: Annotated[FloatArray, CELLS + 1]  # f' over u
    shape: Annotated[FloatArray, CELLS + 1]  # over u
    inverse: Annotated[FloatArray, CELLS + 1]  # theta of the rising branch over t


def magic_formulas(theta: FloatArray, c: float, e: float) -> FloatArray:
    """Magic Formula of many slips, with slope 1 at none."""
    b = theta / c
    return np.asarray(np.sin(c * np.arctan(b - e * (b - np.arctan(b)))))


def curve_tables(c: float, e: float) -> TyreCurve:
    """Tables of the Magic Formula with shape c and curvature e, and of the spread of tyres about it."""
    u = np.linspace(0.0, 1.0, CELLS + 1)
    theta = u / np.maximum(1.0 - u, 1e-9)
    f = magic_formulas(theta, c, e)
    step = 1e-4 * (1.0 + theta)
    fine = np.linspace(0.0, 10.0, 200_001)
    rising = magic_formulas(fine, c, e)
    peak = int(np.argmax(rising))
    t = np.linspace(0.0, 1.0, CELLS + 1)
    return TyreCurve(
        ratio=np.divide(f, theta, out=np.ones_like(f), where=theta > 0.0),
        slope=(magic_formulas(theta + step, c, e) - magic_formulas(theta - step, c, e)) / (2.0 * step),
        shape=0.5 * (magic_formulas(theta, *SHARP) - magic_formulas(theta, *ROUND)),
        inverse=np.interp(1.0 - t * t, rising[: peak + 1], fine[: peak + 1]),
    )


@compiled
def interpolated(table: FloatArray, place: float) -> float:
    """Value of a table over [0, 1] at `place`, linear between its cells."""
    cells = table.shape[0] - 1
    scaled = place * cells
    cell = min(int(scaled), cells - 1)
    share = scaled - cell
    return float(table[cell] + share * (table[cell + 1] - table[cell]))


@compiled
def ratio_at(curve: TyreCurve, theta: float) -> float:
    """f/theta at theta >= 0; the curve is level beyond the table."""
    last = curve.ratio.shape[0] - 2
    if theta >= last:
        return float(curve.ratio[last] * last / theta)
    return interpolated(curve.ratio, theta / (1.0 + theta))


@compiled
def theta_at(curve: TyreCurve, force: float) -> float:
    """theta at 0 <= force over mu*F_z on the rising branch; infinite at and beyond the peak."""
    return math.inf if force >= 1.0 else interpolated(curve.inverse, math.sqrt(1.0 - force))
