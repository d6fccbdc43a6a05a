"""Highest speed at which a vehicle can stop within its sight distance. The module is pure
(no I/O).
"""

from __future__ import annotations

import numpy as np

from schemas.numeric import FloatArray
from schemas.thresholds import GRAVITY, REACTION_S


def stopping_speed(mu: FloatArray | float, sight_m: float) -> FloatArray:
    """Return the highest speed [m/s] from which a vehicle can stop within the sight distance
    `sight_m` [m] on a level road with friction `mu`. The driver reacts after REACTION_S seconds,
    and the deceleration is g·mu. The result is 0 if `mu` is 0.

    The speed v solves v·REACTION_S + v²/(2·g·mu) = sight_m.
    """
    grip = GRAVITY * np.asarray(mu, np.float64)
    during = grip * REACTION_S
    return np.asarray(np.sqrt(during**2 + 2.0 * grip * sight_m) - during)
