"""From how fast one can stop within what one sees, on the lower end of what is known. Pure."""

from __future__ import annotations

import math
from typing import Final

from schemas.thresholds import GRAVITY, REACTION_S

SIGHTS_M: Final = (50, 100)


def safe_speed(mu_lower: float, sight_m: float) -> float:
    """Speed [m/s] from which one stops within a sight [m] on a level road, after the reaction, at g·mu_lower."""
    grip = GRAVITY * mu_lower
    return grip * (math.sqrt(REACTION_S**2 + 2.0 * sight_m / grip) - REACTION_S) if grip > 0.0 else 0.0
