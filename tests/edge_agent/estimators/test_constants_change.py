"""Every other constant of the default's table is seen to matter: change it, and some estimate of some drive changes."""

from __future__ import annotations

from functools import cache

import numpy as np
import pytest

from edge_agent.adaptation.memberships import Memberships
from edge_agent.dynamics.parameters import parameter_table
from edge_agent.estimators.friction_mixture.bank import mixture_bank
from edge_agent.estimators.friction_mixture.constants import Constants
from edge_agent.estimators.friction_mixture.design import design_of
from schemas.numeric import FloatArray
from schemas.signals import S
from schemas.vehicle import Vehicle
from tests.edge_agent.estimators.drives import drive
from tests.edge_agent.estimators.test_constants import MOVES

SAMPLES = 400


@cache
def drives() -> tuple[FloatArray, FloatArray, list[Vehicle]]:
    """Turning, locking, spinning, creeping, unlike sides; without torque, without accelerations for a while.

    Then a stop of wheels that slip alike and stand, steering that nothing follows for a while, and unlike wheels.
    """
    chosen = [drive("j-turn", 0.4), drive("braking", 0.3), drive("acceleration", 0.3), drive("gaining-slalom", 0.9)]
    chosen += [drive("pulses", 0.6), drive("slalom", 0.3), drive("split-braking", None)]
    signals = np.stack([one[1][:SAMPLES] for one in chosen], axis=1).copy()
    signals[100:, 4, S.TORQUE : S.TORQUE + 4] = np.nan
    signals[150:250, 5, [S.AX, S.AY]] = np.nan
    chosen += [chosen[0], chosen[0], chosen[0]]
    signals = np.concatenate([signals, np.zeros_like(signals[:, :3])], axis=1)
    t = chosen[0][0][:SAMPLES]
    stopping, steering, unlike = signals[:, -3], signals[:, -2], signals[:, -1]
    stopping[:, S.AX] = np.where((t > 0.5) & (t < 2.4), -11.0, 0.3)
    stopping[:, S.OMEGA : S.OMEGA + 4] = np.clip(70.0 - 36.0 * np.clip(t - 0.5, 0.0, 3.0), 0.0, None)[:, None]
    steering[:, S.DELTA : S.DELTA + 2] = 0.2 * np.sin(6.0 * t)[:, None]
    steering[:, S.YAW_RATE], steering[:, S.AY] = 0.3 * np.sin(2.0 * t), 5.0 * np.sin(2.5 * t)
    steering[t > 1.0] = 0.0
    steering[:, S.OMEGA : S.OMEGA + 4] = 60.0
    unlike[:, S.OMEGA : S.OMEGA + 4] = (61.2, 58.8, 61.2, 58.8)
    unlike[:, S.AX], unlike[:, S.AY] = 0.5, 0.8
    return np.repeat(t[:, None], len(chosen), axis=1), signals, [one[2] for one in chosen]


@cache
def estimates(name: str | None) -> bytes:
    """What the filter reports of the drives, with constant `name` three times as large."""
    t, signals, vehicles = drives()
    constants = Constants()
    if name is not None:
        constants = constants._replace(**{name: 3.0 * getattr(constants, name)})
    bank = mixture_bank(parameter_table(vehicles), design_of(Memberships(), adaptive=True, constants=constants))
    found = bank.advance(t, signals)
    return b"".join(
        array.tobytes() for array in (found.vx, found.vx_std, found.vy_std, found.mu, found.mu_lower, found.mu_upper)
    )


@pytest.mark.parametrize("name", [name for name in Constants._fields if name not in MOVES])
def test_every_constant_changes_what_is_estimated(name: str) -> None:
    assert estimates(name) != estimates(None)
