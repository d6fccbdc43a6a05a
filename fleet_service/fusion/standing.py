"""Standing of the vehicles from an epoch on: the weight of each one's votes. Pure."""

from __future__ import annotations

from typing import Final, NamedTuple

import numpy as np

from fleet_service.fusion import constants as c
from schemas.numeric import BoolArray, Float32Array, IntArray

# Columns of the archive for corrections of a vehicle's values, of which this fusion makes none.
UNCORRECTED: Final = {"bias": 0.0, "bias_std": c.BIAS_RELATIVE, "spread": 1.0, "slope": 0.0}


class Standing(NamedTuple):
    """Standing of the vehicles from an epoch on.

    Attributes:
        epoch: from which it acts; -1: from the beginning.
        weight: weight of each vehicle's votes, (V,); more than 1 after agreement with many others.
        initial: weight of a vehicle that is not among them.
        heeded: whether each vehicle's slip controllers may support an alert, (V,).
    """

    epoch: int
    weight: Float32Array
    initial: float
    heeded: BoolArray

    def weights(self, vehicle: IntArray) -> Float32Array:
        """Return the weights of vehicles (n,) by index."""
        known = np.append(self.weight, np.float32(self.initial))
        return np.asarray(known[np.minimum(vehicle, len(self.weight))])

    def heeds(self, vehicle: IntArray) -> BoolArray:
        """Return True for vehicles (n,) whose slip controllers may support an alert; also True for
        unknown vehicles.
        """
        known = np.append(self.heeded, True)
        return np.asarray(known[np.minimum(vehicle, len(self.heeded))])


def first_standing(initial: float) -> Standing:
    """Return the standing in a service that knows no vehicle."""
    return Standing(-1, np.zeros(0, np.float32), initial, np.zeros(0, np.bool_))
