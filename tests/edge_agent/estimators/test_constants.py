"""Every constant of the default's table is seen to matter: change it, and some estimate of some drive changes."""

from __future__ import annotations

from functools import cache

import numpy as np
import pytest

from edge_agent.adaptation.memberships import Memberships
from edge_agent.dynamics.parameters import parameter_table
from edge_agent.estimators.friction_mixture.bank import mixture_bank
from edge_agent.estimators.friction_mixture.constants import C, constant_row
from edge_agent.estimators.registry import design_of
from schemas.numeric import FloatArray
from schemas.signals import S
from schemas.vehicle import Vehicle
from tests.edge_agent.estimators.drives import drive

SAMPLES = 400


@cache
def drives() -> tuple[FloatArray, FloatArray, list[Vehicle]]:
    """Turning, locking, spinning, creeping, unlike sides; without torque, without accelerations for a while."""
    chosen = [drive("j-turn", 0.4), drive("braking", 0.3), drive("acceleration", 0.3), drive("gaining-slalom", 0.9)]
    chosen += [drive("pulses", 0.6), drive("slalom", 0.3), drive("split-braking", None)]
    signals = np.stack([one[1][:SAMPLES] for one in chosen], axis=1).copy()
    signals[100:, 4, S.TORQUE : S.TORQUE + 4] = np.nan
    signals[150:250, 5, [S.AX, S.AY]] = np.nan
    return np.repeat(chosen[0][0][:SAMPLES, None], len(chosen), axis=1), signals, [one[2] for one in chosen]


@cache
def said(place: int | None) -> bytes:
    """What the filter says of the drives, with the constant at `place` three times as large."""
    t, signals, vehicles = drives()
    row = constant_row()
    if place is not None:
        row[place] = 3.0 * row[place] if row[place] != 0.0 else 0.1
    bank = mixture_bank(parameter_table(vehicles), design_of(Memberships(), adaptive=True, constants=row))
    told = bank.advance(t, signals)
    return b"".join(
        array.tobytes() for array in (told.vx, told.vx_std, told.vy_std, told.mu, told.mu_lower, told.mu_upper)
    )


@pytest.mark.parametrize("constant", list(C), ids=lambda constant: constant.name)
def test_every_constant_changes_what_is_estimated(constant: C) -> None:
    assert said(int(constant)) != said(None)
