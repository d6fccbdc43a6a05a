"""Tables of the tyre curve (force over slip): force, slope, slip at a given force, and the
difference in shape between tyres.

Legend
    theta    normalised slip, see edge_agent.dynamics.tyres           [1]
    f        force over mu*F_z, peak 1                                  [1]
    shape    change of f if the tyre is sharper by one standard deviation of shape. The deviation is
             half of the difference between a sharp and a round tyre. Up to the peak of f the change
             is positive; far beyond the peak it is negative, because a sharp curve falls faster [1]
    u        theta/(1 + theta); the tables over theta are equidistant in u [1]
    t        sqrt(1 - f); the inverse curve is smooth in t up to the peak  [1]
"""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Annotated, Final, NamedTuple, TypeAlias

import numpy as np

from schemas.numeric import FloatArray
from schemas.runtime.jit import inlined
from schemas.runtime.lanes import any_lane, floor, gather_pair, inverse_root_of, select

# Number of cells of a table. Linear interpolation in a cell errs by less than 1e-6 of the force.
CELLS: Final = 1024
# (C, E) of the Magic Formula for a sharp and a round tyre. Tyres of passenger cars lie between
# them; the brush model lies two standard deviations beyond the round tyre.
SHARP: Final = (1.60, -0.45)
ROUND: Final = (1.33, 0.05)


class TyreCurve(NamedTuple):
    """Tables of the tyre's force curve at CELLS + 1 points, for interpolation."""

    ratio: Annotated[FloatArray, CELLS + 1]  # f/theta as a function of u
    slope: Annotated[FloatArray, CELLS + 1]  # slope of f as a function of u
    shape: Annotated[FloatArray, CELLS + 1]  # as a function of u
    inverse: Annotated[FloatArray, CELLS + 1]  # theta of the rising branch as a function of t


def magic_formulas(theta: FloatArray, c: float, e: float) -> FloatArray:
    """Return the Magic Formula force (peak 1) at an array of normalised slips `theta` of any shape,
    with slope 1 at zero slip.
    """
    b = theta / c
    return np.asarray(np.sin(c * np.arctan(b - e * (b - np.arctan(b)))))


Curve: TypeAlias = Callable[[FloatArray], FloatArray]
"""Tyre curve: force over mu*F_z as a function of normalised slips theta >= 0. Its slope is 1 at
theta = 0 and its peak is 1; beyond the peak it is constant or falls.
"""


def check_curve(curve: Curve) -> Curve:
    """Return the tyre curve if it is valid; otherwise raise ValueError with the reason."""
    theta = np.linspace(0.0, 10.0, 10_001)
    f = np.asarray(curve(theta), dtype=np.float64)
    if f.shape != theta.shape or not np.isfinite(f).all():
        raise ValueError("does not give one finite force for each slip")
    if abs(f[0]) > 1e-9 or abs(f[1] / theta[1] - 1.0) > 0.01:
        raise ValueError(f"begins with slope {f[1] / theta[1]:.3g} at {f[0]:.3g}, not with 1 at 0")
    if abs(f.max() - 1.0) > 1e-3 or f.min() < 0.0:
        raise ValueError(f"goes from {f.min():.3g} to {f.max():.3g}, not from 0 to 1")
    if (np.diff(f[: int(np.argmax(f)) + 1]) <= 0.0).any():
        raise ValueError("does not increase up to its peak")
    return curve


def curve_tables(curve: Curve) -> TyreCurve:
    """Return the tables of a tyre curve. They include the force differences of tyres whose curve is
    sharper or rounder.
    """
    u = np.linspace(0.0, 1.0, CELLS + 1)
    theta = u / np.maximum(1.0 - u, 1e-9)
    f = curve(theta)
    step = 1e-4 * (1.0 + theta)
    fine = np.linspace(0.0, 10.0, 200_001)
    rising = curve(fine)
    peak = int(np.argmax(rising))
    t = np.linspace(0.0, 1.0, CELLS + 1)
    return TyreCurve(
        ratio=np.divide(f, theta, out=np.ones_like(f), where=theta > 0.0),
        slope=(curve(theta + step) - curve(theta - step)) / (2.0 * step),
        shape=0.5 * (magic_formulas(theta, *SHARP) - magic_formulas(theta, *ROUND)),
        inverse=np.interp(1.0 - t * t, rising[: peak + 1], fine[: peak + 1]),
    )


@inlined
def interpolate_table(table: FloatArray, place: float) -> float:
    """Return the value of `table` at `place`, interpolated linearly. The points of the table are
    equidistant over [0, 1]. `place` is a number, or one number per node (friction hypothesis) of a
    group.
    """
    cells: int = table.shape[0] - 1
    scaled = place * cells
    cell = min(floor(scaled), cells - 1.0)
    first, second = gather_pair(table, cell)
    return first + (scaled - cell) * (second - first)


@inlined
def ratio_at(curve: TyreCurve, theta: float, place: float) -> float:
    """Return the tyre force over mu*F_z (friction times load), divided by the normalised slip
    `theta` >= 0. Beyond the end of the table the force is constant. `place` is theta/(1 + theta).
    """
    last = curve.ratio.shape[0] - 2
    ratio = interpolate_table(curve.ratio, place)
    if any_lane(theta >= last):
        ratio = select(theta >= last, curve.ratio[last] * last / theta, ratio)
    return ratio


@inlined
def theta_at(curve: TyreCurve, force: float) -> float:
    """Return the normalised slip on the rising branch of the tyre curve at a given force over
    mu*F_z (friction times load; 0 or more); infinite at and beyond the peak.
    """
    square = max(1.0 - force, 0.0)
    theta = interpolate_table(curve.inverse, square * inverse_root_of(square))
    return select(force >= 1.0, math.inf, theta)
