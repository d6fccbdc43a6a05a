"""Tests of trust in the vehicle model. The strain (deviation of the estimated vehicle states from
their prior) must separate cars that match their vehicle file from others. Contradictions between
model and measurements must be found per axle, and ice must cause none.
"""

from __future__ import annotations

from typing import cast

import numpy as np
import pytest

from edge_agent.adaptation.memberships import Memberships
from edge_agent.dynamics.parameters import parameter_table
from edge_agent.estimators import flags
from edge_agent.estimators.friction_mixture.bank import mixture_bank
from edge_agent.estimators.friction_mixture.block.block_features import strained_noise
from edge_agent.estimators.friction_mixture.mixture.trust import (
    FACTOR,
    axles_ratio,
    belief_strain,
    update_consistency,
    used_evidence_share,
)
from edge_agent.estimators.friction_mixture.state.constants import Constants, NodeState
from edge_agent.estimators.friction_mixture.state.design import design_of
from edge_agent.estimators.friction_mixture.state.memory import Trust
from schemas.numeric import BoolArray, FloatArray
from schemas.runtime.records import records
from schemas.signals import Health, S
from tests.edge_agent.estimators.drives import drive

CONSTANTS = Constants()


def believing(*, strained: float = 1.0, odd: float = 0.0) -> Trust:
    trust = records(Trust, 1)
    trust["strain"] = strained
    trust["odd"] = odd
    return cast(Trust, trust[0])  # a kernel gets one element of the record array


def after(
    signals: FloatArray, t: FloatArray, vehicle: object, *, adaptive: bool = True
) -> tuple[np.void, BoolArray]:
    bank = mixture_bank(
        parameter_table([vehicle]),  # type: ignore[list-item]
        design_of(Memberships(), adaptive=adaptive),
    )
    health = bank.advance(t[:, None], signals[:, None]).health[:, 0]
    return bank._filters["trust"][0], (health.astype(np.int64) & Health.CONTRADICTION) > 0


def test_strain_goes_from_one_to_chi_square_over_degrees_of_freedom() -> None:
    assert belief_strain(0.0, 0.0, 2.0) == 1.0
    assert belief_strain(5000.0, 5000.0, 2.0) == pytest.approx(2.0, rel=1e-3)
    assert belief_strain(0.0, 10.0, 2.0) < 0.2


def test_axles_are_more_certain_with_a_correct_vehicle_file() -> None:
    usual = CONSTANTS.chosen.strain_usual
    assert strained_noise(believing(strained=usual), CONSTANTS) == pytest.approx(1.0)
    noise = [
        strained_noise(believing(strained=share * usual), CONSTANTS)
        for share in (0.01, 0.8, 1.2, 100.0)
    ]
    assert noise == sorted(noise)
    assert (noise[0], noise[-1]) == (CONSTANTS.guards.strain_least, CONSTANTS.guards.strain_most)


def test_axles_of_a_strained_car_are_trusted_less() -> None:
    t, signals, vehicle = drive("slalom", 0.85, seconds=6.0)
    spread = []
    for strain in (0.3, 1.0, 3.0):
        bank = mixture_bank(parameter_table([vehicle]), design_of(Memberships(), adaptive=True))
        bank.advance(t[:500, None], signals[:500, None])
        bank._filters[0]["trust"]["strain"] = strain
        found = bank.advance(t[500:506, None], signals[500:506, None])
        spread.append(float(found.vy_std[-1, 0]))
    assert spread[0] < spread[1] < spread[2]


def test_innovations_as_stated_support_the_model_threefold_ones_do_not() -> None:
    assert axles_ratio(1.0) < 0.0 < axles_ratio(FACTOR)


def test_weight_of_evidence_falls_to_zero_at_the_limit() -> None:
    shares = [
        used_evidence_share(believing(odd=share * CONSTANTS.chosen.odd_least), CONSTANTS)
        for share in (0.0, 0.3, 0.8, 1.0, 2.0)
    ]
    assert shares[0] == 1.0
    assert shares[-2:] == [0.0, 0.0]
    assert shares == sorted(shares, reverse=True)


def test_strain_is_high_only_with_tilted_or_turned_sensors() -> None:
    t, signals, vehicle = drive("slalom", 0.6, seconds=12.0)
    wrong = signals.copy()
    wrong[:, S.AX] += 0.5
    wrong[:, S.DELTA : S.DELTA + 2] += 0.012
    level, strained = (float(after(s, t, vehicle)[0]["strain"]) for s in (signals, wrong))
    assert level < CONSTANTS.chosen.strain_usual < 1.0 < strained


@pytest.mark.parametrize("manoeuvre", ["braking", "acceleration", "slalom", "pulses"])
def test_ice_that_explains_the_data_is_no_contradiction(manoeuvre: str) -> None:
    t, signals, vehicle = drive(manoeuvre, 0.15)
    trust, contradicts = after(signals, t, vehicle)
    assert not contradicts.any()
    assert trust["odd"] < CONSTANTS.chosen.odd_least


@pytest.mark.parametrize(("held", "grows"), [(0.0, True), (1.0, False)])
def test_a_slide_explains_the_errors_before_it_too(held: float, grows: bool) -> None:
    t, signals, vehicle = drive("slalom", 0.85, seconds=6.0)
    bank = mixture_bank(parameter_table([vehicle]), design_of(Memberships(), adaptive=True))
    bank.advance(t[:500, None], signals[:500, None])
    memory = bank._filters[0]
    memory["slip"]["held"] = held
    memory["trust"]["ratio"] = 2.0 * FACTOR
    before = float(memory["trust"]["odd"])
    update_consistency(memory, bank._contexts["design"][0], 0.05, 1.0, 0)
    assert (float(memory["trust"]["odd"]) > before) == grows


@pytest.mark.parametrize(
    ("speed", "held", "share"), [(20.0, 0.0, 0.5), (1.0, 0.0, 0), (20.0, 1.0, 0)]
)
def test_a_reset_counts_half_unless_it_is_explained(
    speed: float, held: float, share: float
) -> None:
    t, signals, vehicle = drive("slalom", 0.85, seconds=6.0)
    bank = mixture_bank(parameter_table([vehicle]), design_of(Memberships(), adaptive=True))
    bank.advance(t[:500, None], signals[:500, None])
    memory = bank._filters[0]
    memory["overall_mean"][NodeState.VX] = speed
    memory["slip"]["held"] = held  # a wheel slides
    memory["trust"]["odd"] = 0.0
    memory["trust"]["ratio"] = 0.0
    update_consistency(memory, bank._contexts["design"][0], 0.05, 0.0, flags.RESET)
    expected = share * CONSTANTS.chosen.odd_least
    assert float(memory["trust"]["odd"]) == pytest.approx(expected, rel=0.1, abs=0.01)


def test_unexplained_side_force_contradicts_until_patience_ends() -> None:
    vehicle = drive("straight", 0.85)[2]
    t = np.arange(0.0, 5.0 + CONSTANTS.chosen.patience, 0.01)
    signals = np.zeros((len(t), 18))
    signals[:, S.OMEGA : S.OMEGA + 4] = 60.0
    signals[:, S.AY] = np.where(t < 4.0, 3.0 * np.sin(2.0 * t), 0.0)
    contradicts = after(signals, t, vehicle)[1]
    began = t[contradicts.argmax()]
    ended = t[len(t) - 1 - contradicts[::-1].argmax()]
    assert 0.5 < began < 4.0
    assert ended - began == pytest.approx(CONSTANTS.chosen.patience, abs=0.2)


def test_filter_without_adaptation_has_no_strain_and_no_distrust() -> None:
    t, signals, vehicle = drive("slalom", 0.6, seconds=6.0)
    wrong = signals.copy()
    wrong[:, S.AX] += 0.5
    assert after(wrong, t, vehicle, adaptive=False)[0]["strain"] == 1.0
