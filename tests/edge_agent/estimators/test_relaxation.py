"""Tests of the relaxation of the tyres: their force follows the slip over a distance."""

from __future__ import annotations

import math

import numpy as np
import pytest

from edge_agent.app.estimator_factory import bank_of
from edge_agent.estimators.friction_mixture.state.constants import Constants
from edge_agent.lab.simulation.presets import PRESETS
from schemas.numeric import FloatArray
from schemas.signals import CHANNELS, S

SEDAN = PRESETS["sedan"].vehicle
RATE_HZ = 100
SPUN_AT_S = 3.0
BLOCK_S = 0.05
LENGTH = Constants().physical.relaxation_length


def built_slip(speed: float, slip: float, blocks: int) -> FloatArray:
    """Return the slips (4,) that belong to the tyres' force in a car that rolls at `speed` [m/s].
    The left rear wheel has had the given `slip` for some `blocks` (0.05 s each).
    """
    t = np.arange(0.0, SPUN_AT_S + blocks * BLOCK_S + 1e-6, 1.0 / RATE_HZ)
    signals = np.full((len(t), 1, len(CHANNELS)), np.nan)
    signals[..., [S.AX, S.AY, S.YAW_RATE]] = 0.0
    signals[..., S.DELTA : S.DELTA + 4] = 0.0
    signals[..., S.OMEGA : S.OMEGA + 4] = speed / SEDAN.wheel_radius
    signals[t > SPUN_AT_S, 0, S.OMEGA + 2] *= 1.0 + slip
    bank = bank_of("aco-fckf", [SEDAN])
    bank.advance(t[:, None], signals)
    return np.asarray(bank.memory("built_along")[0])


@pytest.mark.parametrize("speed", [2.0, 5.0, 20.0])
@pytest.mark.parametrize("slip", [0.1, -0.1])
def test_slip_builds_up_over_the_relaxation_length(speed: float, slip: float) -> None:
    for blocks in (1, 3):
        rolled = speed * max(1.0 + slip, 1.0) * blocks * BLOCK_S
        expected = slip * -math.expm1(-rolled / LENGTH)
        built = built_slip(speed, slip, blocks)
        assert built[2] == pytest.approx(expected, abs=0.006)
        assert built[[0, 1, 3]] == pytest.approx(0.0, abs=0.006)
