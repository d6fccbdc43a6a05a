"""Position error of a visit (passage of a cell): it spreads the visit over the cells before and
behind. Vectorised, pure.

Legend
    σ      standard deviation of the position along the heading     (n,), m
    w      length of a cell along the heading                        (n,), m
    π_k    P(the measurement belongs to the k-th cell further on)    (n,)
    G(x)   x·Φ(x) + φ(x), the integral of the normal distribution function

The true position is uniform over the reported cell (width w), plus a normal error. Integrated over
the k-th cell this gives π_k = σ/w · [G((k+1)·w/σ) - 2·G(k·w/σ) + G((k-1)·w/σ)]. The sum over all k
is one.
"""

from __future__ import annotations

import math
from typing import Final

import numpy as np

from fleet_service.fusion import constants
from fleet_service.fusion.normal import normal_cdf
from schemas import grid
from schemas.numeric import Float32Array, FloatArray, IntArray
from schemas.thresholds import EARTH_RADIUS_M

_EARTH_M: Final = 2.0 * math.pi * EARTH_RADIUS_M  # [m] circumference at the equator
_STEPS: Final = np.array(
    [k for k in range(-constants.SPREAD_CELLS, constants.SPREAD_CELLS + 1) if k]
)
_BORDERS: Final = np.arange(
    -constants.SPREAD_CELLS - 1, constants.SPREAD_CELLS + 2
)  # k ± 1 of all steps k


def other_cells(
    cell: IntArray, latitude: FloatArray, yaw: FloatArray, position_std: FloatArray
) -> tuple[IntArray, Float32Array]:
    """Return the other cells in which the vehicles of n visits may have been, and the probability
    of each; both arrays are (n, 2·SPREAD_CELLS).

    An item is -1 with probability 0 in three cases: the probability is below SPREAD_LEAST; the yaw
    angle or the standard deviation is unknown; or the other cell lies in another region, which
    another service may own. The probabilities sum to at most 1. The reported cell gets the rest, so
    the effect of one visit is divided and not multiplied.
    """
    cosine = np.cos(np.nan_to_num(yaw))
    sine = np.sin(np.nan_to_num(yaw))
    steep = np.maximum(np.abs(cosine), np.abs(sine))
    side = _EARTH_M / (1 << grid.CELL_ZOOM) * np.cos(np.radians(np.clip(latitude, -85.0, 85.0)))
    share = cell_shares(np.nan_to_num(position_std), side / steep)
    x, y = grid.deinterleave(cell)
    n = 1 << grid.CELL_ZOOM
    ahead = np.rint(_STEPS * (cosine / steep)[:, None]), np.rint(_STEPS * (-sine / steep)[:, None])
    columns = (x[:, None] + ahead[0].astype(np.int64)) % n
    rows = y[:, None] + ahead[1].astype(np.int64)
    other = grid.interleave(columns, np.clip(rows, 0, n - 1))
    good = (share >= constants.SPREAD_LEAST) & np.isfinite(yaw)[:, None] & (rows >= 0) & (rows < n)
    good &= grid.region_of(other) == grid.region_of(cell)[:, None]
    return np.where(good, other, -1), np.where(good, share, 0.0).astype(np.float32)


def cell_shares(std: FloatArray, length: FloatArray) -> FloatArray:
    """Return the probabilities π that a visit was in a cell behind or ahead of the reported one,
    (n, 2·SPREAD_CELLS). `std` is the position's standard deviation and `length` the cell length
    along the heading, both (n,) [m].
    """
    ratio = (length / np.maximum(std, 1e-6 * length))[:, None]
    integral = _cdf_integral(_BORDERS * ratio)
    at = _STEPS - _BORDERS[0]
    return np.asarray((integral[:, at + 1] - 2.0 * integral[:, at] + integral[:, at - 1]) / ratio)


def _cdf_integral(x: FloatArray) -> FloatArray:
    return np.asarray(x * normal_cdf(x) + np.exp(-0.5 * np.square(x)) / np.sqrt(2.0 * np.pi))
