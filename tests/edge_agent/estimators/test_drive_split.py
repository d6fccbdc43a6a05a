"""Tests of the axle that is not driven: its wheels show the speed of an accelerating car, even if
the driven wheels spin.
"""

from __future__ import annotations

import math

import numpy as np
import pytest

from edge_agent.app.estimator_factory import bank_of
from edge_agent.dynamics.parameters import Parameter, parameter_row
from edge_agent.estimators.friction_mixture.block.drive_split import FIRST_ODDS, free_axle
from edge_agent.lab.simulation.presets import PRESETS
from schemas.signals import CHANNELS, S

VAN = PRESETS["van"].vehicle
FRONT = 0
REAR = 1
NONE = -1
PULLING = 1.0  # [m/s^2] acceleration at which the tyres certainly drive the car
RATE_HZ = 100


@pytest.mark.parametrize(
    ("front_share", "odds", "acceleration", "axle"),
    [
        (0.0, FIRST_ODDS, PULLING, FRONT),
        (1.0, FIRST_ODDS, PULLING, REAR),
        (0.5, FIRST_ODDS, PULLING, NONE),
        (math.nan, FIRST_ODDS, PULLING, NONE),
        (math.nan, (0.999, 0.0005, 0.0005), PULLING, FRONT),
        (math.nan, (0.0005, 0.0005, 0.999), PULLING, REAR),
        (math.nan, (0.0005, 0.999, 0.0005), PULLING, NONE),
        # The brakes act on all wheels.
        (0.0, FIRST_ODDS, -PULLING, NONE),
        (0.0, FIRST_ODDS, 0.0, NONE),
    ],
)
def test_free_axle_is_not_driven_and_not_braked(
    front_share: float, odds: tuple[float, float, float], acceleration: float, axle: int
) -> None:
    row = np.array(parameter_row(VAN))
    row[Parameter.DRIVE_FRONT] = front_share
    assert free_axle(row, np.array(odds), acceleration) == axle


def test_spinning_driven_wheels_do_not_hide_the_speed() -> None:
    time_s = np.arange(0.0, 10.0, 1.0 / RATE_HZ)
    speed = 2.0 + 0.9 * time_s
    spin = 1.0 + 0.2 * np.clip(np.sin(2.0 * np.pi * time_s), 0.0, None)
    signals = np.full((len(time_s), 1, len(CHANNELS)), np.nan)
    signals[..., S.DELTA : S.DELTA + 4] = 0.0
    signals[..., [S.AY, S.YAW_RATE]] = 0.0
    signals[:, 0, S.AX] = 0.9
    for wheel in range(4):
        driven = spin if wheel >= 2 else 1.0
        signals[:, 0, S.OMEGA + wheel] = speed * driven / VAN.wheel_radius
    bank = bank_of("aco-fckf", [VAN])
    estimates = bank.advance(time_s[:, None], signals)
    assert bank._filters["rolling"]["ahead"][0] == pytest.approx(speed[-1], rel=0.01)
    assert np.abs(estimates.vx[RATE_HZ:, 0] - speed[RATE_HZ:]).max() < 0.3
