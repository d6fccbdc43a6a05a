"""Test that bumps of the road reveal exchanged front and rear wheel signals, and that a smooth road
does not.
"""

from __future__ import annotations

import numpy as np
import pytest

from edge_agent.inputs.doctor.bumps import leading_axle
from edge_agent.lab.simulation.presets import PRESETS
from schemas.numeric import FloatArray
from schemas.signals import CHANNELS, S

CAR = PRESETS["sedan"].vehicle
WHEELBASE = CAR.cg_to_front_axle + CAR.cg_to_rear_axle
SPEED = 20.0


def uneven_drive(bumps: float) -> tuple[FloatArray, FloatArray]:
    """Return times (T,) and signals (T, 18) of a minute at 20 m/s on a road with bumps of size
    `bumps`. Both axles roll over the same bumps. Each wheel speed has its own noise.
    """
    rng = np.random.default_rng(4)
    t = np.arange(0.0, 60.0, 0.01)
    # Height of the road, one value every 5 cm.
    road = np.convolve(rng.normal(0.0, 1.0, 30_000), np.ones(12) / 12.0, "same")
    signals = np.full((len(t), len(CHANNELS)), np.nan)
    for wheel in range(4):
        place = 100.0 + SPEED * t - (0.0 if wheel < 2 else WHEELBASE)
        side = 1.0 if wheel % 2 else -1.0
        uneven = bumps * side * np.interp(place, 0.05 * np.arange(len(road)), road)
        signals[:, S.OMEGA + wheel] = (
            SPEED + uneven + rng.normal(0.0, 0.02, len(t))
        ) / CAR.wheel_radius
    return t, signals


@pytest.mark.parametrize(("bumps", "front_first"), [(0.1, 1), (0.0, 0)])
def test_bumps_distinguish_front_from_rear_and_a_smooth_road_does_not(
    bumps: float, front_first: int
) -> None:
    t, signals = uneven_drive(bumps)
    assert leading_axle(t, signals, CAR) == front_first
    exchanged = signals.copy()
    exchanged[:, S.OMEGA : S.OMEGA + 4] = signals[
        :, [S.OMEGA + 2, S.OMEGA + 3, S.OMEGA, S.OMEGA + 1]
    ]
    assert leading_axle(t, exchanged, CAR) == -front_first
