"""Position error of a visit (passage of a cell): probability that the vehicle was in the cell that
it reported. Vectorised, pure.

Legend
    σ      standard deviation of the position along the heading     (n,), m
    w      length of a cell along the heading                        (n,), m
    π      P(the vehicle was in the reported cell)                   (n,)
    G(x)   x·Φ(x) + φ(x), the integral of the normal distribution function

The true position is uniform over the reported cell (width w), plus a normal error. Integrated over
the cell this gives π = 2·σ/w · [G(w/σ) - G(0)] - 1.

A report counts only for the reported cell, with less weight if π is small. The rest of its weight
is not given to other cells in which the vehicle may have been. Vehicles report every cell of their
path, so these cells have reports of their own, and a second share of the reports of others would
only blur the borders of a surface.
"""

from __future__ import annotations

import math
from typing import Final

import numpy as np

from fleet_service.fusion import constants
from fleet_service.fusion.normal import normal_cdf
from schemas import grid
from schemas.numeric import Float32Array, FloatArray
from schemas.thresholds import EARTH_RADIUS_M

_EARTH_M: Final = 2.0 * math.pi * EARTH_RADIUS_M  # [m] circumference at the equator


def position_weights(
    latitude: FloatArray, yaw: FloatArray, position_std: FloatArray
) -> Float32Array:
    """Return the weight of n visits in the cells that they reported, (n,), from the latitude and
    yaw angle of the vehicle and the standard deviation of its position, each (n,).

    It is the probability π that the vehicle was in the cell, relative to the share 1 -
    CONTAMINATION that every report has. This share already allows for positions in the wrong cell,
    so the weight is 1 if π is larger. It is also 1 if the standard deviation is unknown.
    """
    heading = np.nan_to_num(yaw)
    steep = np.maximum(np.abs(np.cos(heading)), np.abs(np.sin(heading)))
    side = _EARTH_M / (1 << grid.CELL_ZOOM) * np.cos(np.radians(np.clip(latitude, -85.0, 85.0)))
    here = own_share(np.nan_to_num(position_std), side / steep)
    return np.minimum(here / (1.0 - constants.CONTAMINATION), 1.0).astype(np.float32)


def own_share(std: FloatArray, length: FloatArray) -> FloatArray:
    """Return the probabilities π that vehicles were in the cells that they reported, (n,). `std` is
    the position's standard deviation and `length` the cell length along the heading, both (n,) [m].
    """
    ratio = length / np.maximum(std, 1e-6 * length)
    return np.asarray(2.0 * (_cdf_integral(ratio) - _cdf_integral(0.0 * ratio)) / ratio - 1.0)


def _cdf_integral(x: FloatArray) -> FloatArray:
    return np.asarray(x * normal_cdf(x) + np.exp(-0.5 * np.square(x)) / np.sqrt(2.0 * np.pi))
