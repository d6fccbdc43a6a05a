"""Test of the computed stopping speed: a vehicle that drives at this speed must be able to stop
within the known distance.
"""

from __future__ import annotations

import numpy as np
import pytest

from schemas.stopping import stopping_speed
from schemas.thresholds import GRAVITY, REACTION_S


@pytest.mark.parametrize("sight", [50, 100])
def test_from_the_stopping_speed_one_stops_within_the_sight(sight: float) -> None:
    mu = np.array([0.05, 0.2, 0.8])
    speed = stopping_speed(mu, sight)
    assert speed * REACTION_S + speed**2 / (2 * GRAVITY * mu) == pytest.approx(np.full(3, sight))
    assert stopping_speed(0.0, sight) == 0.0
    assert np.isnan(stopping_speed(np.nan, sight))
