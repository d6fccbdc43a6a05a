"""Weight of each vehicle's votes (effects of its reports on beliefs), per epoch (minute). Pure (no
I/O).
"""

from __future__ import annotations

from typing import Final, NamedTuple

import numpy as np

from fleet_service.fusion import constants
from schemas.numeric import BoolArray, Float32Array, IntArray

# Archive columns for corrections of a vehicle's values, with the values of "no correction". This
# fusion corrects no value.
UNCORRECTED: Final = {"bias": 0.0, "bias_std": constants.BIAS_RELATIVE, "spread": 1.0, "slope": 0.0}


class VoteWeights(NamedTuple):
    """Weight of each vehicle's votes (effects of its reports on beliefs) from one epoch (minute)
    on.

    Attributes:
        epoch: first epoch in which the weights are used; -1: from the beginning.
        weight: weight of each vehicle's votes, (V,); more than 1 after agreement with many others.
        initial: weight of a vehicle that the service does not know yet.
        heeded: mask (V,), True if the vehicle's slip controllers may support an alert.
    """

    epoch: int
    weight: Float32Array
    initial: float
    heeded: BoolArray

    def weights(self, vehicle: IntArray) -> Float32Array:
        """Return the weights of the votes of vehicles, (n,), for their indices (n,); an unknown
        index gets the initial weight.
        """
        known = np.append(self.weight, np.float32(self.initial))
        return np.asarray(known[np.minimum(vehicle, len(self.weight))])

    def may_support_alerts(self, vehicle: IntArray) -> BoolArray:
        """Return a mask for vehicles (n,): True if the vehicle's slip controllers may support an
        alert. Unknown vehicles also get True.
        """
        known = np.append(self.heeded, True)
        return np.asarray(known[np.minimum(vehicle, len(self.heeded))])


def initial_vote_weights(initial: float) -> VoteWeights:
    """Return the vote weights of a service that knows no vehicle: each vehicle gets `initial`."""
    return VoteWeights(-1, np.zeros(0, np.float32), initial, np.zeros(0, np.bool_))
