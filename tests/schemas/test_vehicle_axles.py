"""Tests of the understeer of a vehicle, computed from the axles in its file. It must be unknown
without axle stiffness, and a calibrated value must replace it.
"""

from __future__ import annotations

import pytest

from edge_agent.dynamics.parameters import Parameter, parameter_row
from edge_agent.estimators.friction_mixture.state.calibrated import means_of, spreads_of
from edge_agent.estimators.friction_mixture.state.constants import Constants, NodeState
from edge_agent.estimators.friction_mixture.state.design import nominal_states
from edge_agent.lab.simulation.presets import PRESETS
from schemas.thresholds import GRAVITY
from schemas.vehicle import Calibration

CAR = PRESETS["sedan"].vehicle
LOADS = [
    0.5 * CAR.mass * GRAVITY * arm / (CAR.cg_to_front_axle + CAR.cg_to_rear_axle)
    for arm in (CAR.cg_to_rear_axle, CAR.cg_to_front_axle)
]
NOMINAL = nominal_states(Constants())


def test_understeer_is_unknown_without_axle_stiffness() -> None:
    assert CAR.understeer_per_g() is None
    assert (
        means_of([CAR], NOMINAL.mean)[0, NodeState.COMPLIANCE] == NOMINAL.mean[NodeState.COMPLIANCE]
    )


def test_soft_front_axle_is_compliance_of_the_prior() -> None:
    soft = CAR.model_copy(
        update={
            "cornering_stiffness_front": 12.5 * LOADS[0],
            "cornering_stiffness_rear": 25.0 * LOADS[1],
        }
    )
    assert soft.understeer_per_g() == pytest.approx(1.0 / 12.5 - 1.0 / 25.0)
    assert means_of([soft], NOMINAL.mean)[0, NodeState.COMPLIANCE] == pytest.approx(0.04)
    assert parameter_row(soft)[Parameter.SLOPE_Y] == pytest.approx(25.0)


def test_calibrated_understeer_counts_before_the_file() -> None:
    learned = CAR.model_copy(
        update={
            "steering_compliance": 0.01,
            "calibration": Calibration(drives=2, understeer=(0.002, 0.0001)),
        }
    )
    assert means_of([learned], NOMINAL.mean)[0, NodeState.COMPLIANCE] == pytest.approx(
        0.002 * GRAVITY
    )
    assert (
        spreads_of([learned], NOMINAL.std)[0, NodeState.COMPLIANCE]
        < NOMINAL.std[NodeState.COMPLIANCE]
    )
