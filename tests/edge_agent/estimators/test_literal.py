"""Tests of the friction filters of papers 000 and 003, programmed as printed. They must reach the
errors that the papers print. Further tests check the effects of numerical precision and of the tyre
model.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from edge_agent.dynamics.chassis import DUGOFF, tyre_forces, wheel_inputs
from edge_agent.dynamics.parameters import Parameter, parameter_row
from edge_agent.estimators.literal import federated_friction, wheel_friction_ukf
from edge_agent.estimators.literal.given_motion import GivenMotion
from edge_agent.estimators.literal.wheel_forces import WheelForces
from edge_agent.estimators.literal.wheel_friction_ukf import AS_PRINTED, UKF, UKF_SINGLE
from edge_agent.lab.evaluation.batch import simulate_ideal
from edge_agent.lab.evaluation.papers.conditions import MATCHED, given_motion
from edge_agent.lab.simulation.presets import PRESETS
from schemas.numeric import FloatArray
from schemas.signals import CHANNELS, S

SHORT_S = 2.0


@pytest.fixture(scope="module")
def turn() -> tuple[GivenMotion, FloatArray]:
    """Return the true motion of a car in a turn on snow, and the true friction of its wheels (T,
    4).
    """
    spec = replace(MATCHED["003.turn"], duration_s=SHORT_S)
    batch = simulate_ideal(spec)
    return given_motion(batch, spec.vehicle), batch.mu_wheel[:, 0]


def one_sample(speed: float) -> GivenMotion:
    """Return one sample of a car's true motion at `speed` [m/s], with slip at all wheels, as input
    of the papers' filters.
    """
    signals = np.zeros((1, len(CHANNELS)))
    signals[0, [S.AX, S.AY, S.YAW_RATE]] = 1.0, 2.0, 0.2
    signals[0, S.DELTA : S.DELTA + 2] = 0.05
    signals[0, S.OMEGA : S.OMEGA + 4] = speed / PRESETS["sedan"].vehicle.wheel_radius * 1.01
    return GivenMotion(
        PRESETS["sedan"].vehicle, np.zeros(1), np.array([speed]), np.array([0.3]), signals
    )


@pytest.mark.parametrize("proportional", [False, True])
def test_tyres_are_those_of_the_compiled_model(proportional: bool) -> None:
    given = one_sample(15.0)
    row = parameter_row(given.vehicle)
    row[Parameter.PROPORTIONAL] = float(proportional)
    mu = np.array([0.3, 0.5, 0.7, 0.9])
    x = np.empty(4)
    y = np.empty(4)
    wheels = wheel_inputs(
        given.signals[0, S.DELTA : S.DELTA + 4], given.signals[0, S.OMEGA : S.OMEGA + 4]
    )
    tyre_forces(row, np.array([15.0, 0.3, 0.2, 1.0, 2.0]), wheels, mu, DUGOFF, (x, y))
    found = WheelForces.for_drive(given, proportional=proportional, single=False).tyre_forces(
        0, mu[None]
    )[0]
    assert found[:, 0] == pytest.approx(x, rel=1e-12)
    assert found[:, 1] == pytest.approx(y, rel=1e-12)


def test_turn_reaches_the_printed_error_and_three_signals_do_not(
    turn: tuple[GivenMotion, FloatArray],
) -> None:
    given, truth = turn
    found = wheel_friction_ukf.estimate(given, AS_PRINTED).mu
    assert np.abs(found[50:] - truth[50:]).mean() < 0.0011
    alone = wheel_friction_ukf.estimate(given, AS_PRINTED._replace(torque_rows=False)).mu
    assert np.abs(alone[50:] - truth[50:]).mean() > 0.05


def test_both_forms_agree_in_double_precision_alone(turn: tuple[GivenMotion, FloatArray]) -> None:
    given, truth = turn
    root, double, single = (
        wheel_friction_ukf.estimate(given, one) for one in (AS_PRINTED, UKF, UKF_SINGLE)
    )
    assert np.abs(root.mu - double.mu).max() < 1e-3
    assert double.lost == 0.0
    assert single.lost > 0.5
    assert np.abs(single.mu - truth).mean() > 5.0 * np.abs(double.mu - truth).mean()


def test_square_root_form_survives_single_precision(turn: tuple[GivenMotion, FloatArray]) -> None:
    given, truth = turn
    found = wheel_friction_ukf.estimate(given, AS_PRINTED._replace(single=True))
    assert found.lost == 0.0
    assert np.abs(found.mu[50:] - truth[50:]).mean() < 0.003


def test_alpha_of_the_sigma_points_does_not_change_the_result(
    turn: tuple[GivenMotion, FloatArray],
) -> None:
    given, _ = turn
    small, large = (
        wheel_friction_ukf.estimate(given, AS_PRINTED._replace(alpha=alpha)).mu
        for alpha in (1e-3, 1.0)
    )
    assert np.abs(small - large).max() < 1e-6


@pytest.mark.parametrize("proportional", [True, False])
def test_printed_tuning_finds_friction_only_of_the_printed_tyre(proportional: bool) -> None:
    spec = MATCHED["000.jump" if proportional else "000.jump.similarity"]
    spec = replace(spec, duration_s=5.0)
    batch = simulate_ideal(spec)
    setting = federated_friction.AS_PRINTED._replace(proportional=proportional)
    found = federated_friction.estimate(given_motion(batch, spec.vehicle), setting).mu.mean(axis=1)
    near = np.abs(found - batch.mu[:, 0]) < 0.1
    assert near[320:].all() == proportional
    if proportional:
        assert not near[:280].any()
