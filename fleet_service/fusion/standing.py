"""What the fusion knows of its vehicles from an epoch on: trust, and the errors that are their own. Pure.

Legend
    r        weight: trust, more than 1 for who has agreed with many
    b, σ_b   relative bias of a vehicle's values, and how well it is known     [-]
    κ        spread: standard deviation of its values over what it states      [-]
    λ        slope: how much too low a value is for each μ that was left       [-]
"""

from __future__ import annotations

from typing import Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from fleet_service.fusion import constants as c
from schemas.numeric import Float32Array, IntArray

BIAS_STEP: Final = 1.0 / 400.0  # of a bias in eight bits; a bin is 3 % of a dry road
BIAS_STDS: Final = (0.03, 0.04, c.BIAS_RELATIVE, 0.07, 0.1)  # relative; the next larger one is taken
SPREADS: Final = (1.0, 1.25, 1.6, 2.0, 2.5, 3.2)  # the nearest one is taken
SLOPE_STEP: Final = 0.01
TYRES: Final = 4  # kinds: not told, summer, winter, all-season
ERRORS: Final = ("bias", "bias_std", "spread", "slope")  # columns of an error, by name
UNKNOWN: Final = (0.0, c.BIAS_RELATIVE, c.SPREAD_FIRST, c.SLOPE_PRIOR)  # b, σ_b, κ, λ of a vehicle that nobody met


class Standing(NamedTuple):
    """Standing of the vehicles from an epoch on.

    Attributes:
        epoch: from which it acts; -1: from the beginning.
        weight: r of each vehicle, (V,).
        error: b, σ_b, κ, λ of each, (V, 4).
        initial: weight of a vehicle that is not among them.
        initial_error: its error by the kind of its tyres, (TYRES, 4).
    """

    epoch: int
    weight: Float32Array
    error: Float32Array
    initial: float
    initial_error: Float32Array

    def weights(self, vehicle: IntArray) -> Float32Array:
        """Weights of vehicles (n,) by index."""
        inside = vehicle < len(self.weight)
        known = np.append(self.weight, np.float32(self.initial))
        return np.asarray(known[np.where(inside, vehicle, len(self.weight))])

    def errors(self, vehicle: IntArray, tyre: IntArray | NDArray[np.int8]) -> Float32Array:
        """Errors of vehicles (n,) by index, with tyres of a kind (n,), (n, 4)."""
        known = np.vstack([self.error, self.initial_error])
        return np.asarray(known[np.where(vehicle < len(self.error), vehicle, len(self.error) + tyre.astype(np.int64))])


def first_standing(initial: float) -> Standing:
    """That of a service that knows nobody."""
    return Standing(-1, np.zeros(0, np.float32), unknown(0), initial, unknown(TYRES))


def unknown(vehicles: int) -> Float32Array:
    """Errors of vehicles that nobody met, (V, 4)."""
    return np.tile(np.array(UNKNOWN, np.float32), (vehicles, 1))


def classes(error: Float32Array) -> NDArray[np.int8]:
    """Errors (n, 4) as kernels look them up, (n, 4) of eight bits: bias in steps, place in BIAS_STDS and in SPREADS,
    slope in steps."""
    out = np.empty(error.shape, np.int8)
    out[:, 0] = np.rint(np.clip(error[:, 0], -c.BIAS_MOST, c.BIAS_MOST) / BIAS_STEP)
    stretched = error[:, 1] / (1.0 - error[:, 3])  # a reading that stands for a road further off
    out[:, 1] = np.minimum(np.searchsorted(np.array(BIAS_STDS) + 1e-6, stretched), len(BIAS_STDS) - 1)
    middle = np.sqrt(np.array(SPREADS[1:]) * np.array(SPREADS[:-1]))
    out[:, 2] = np.searchsorted(middle, error[:, 2])
    out[:, 3] = np.rint(np.clip(error[:, 3], 0.0, c.SLOPE_MOST) / SLOPE_STEP)
    return out
