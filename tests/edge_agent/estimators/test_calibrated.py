"""Tests that a calibrated vehicle file narrows the estimator's priors of the calibrated states, and
changes nothing else.
"""

from __future__ import annotations

import numpy as np

from edge_agent.dynamics.parameters import Parameter
from edge_agent.estimators.friction_mixture.state.calibrated import LEARNED, spreads_of
from edge_agent.estimators.friction_mixture.state.constants import STATES, Constants, NodeState
from edge_agent.estimators.friction_mixture.state.design import nominal_states
from edge_agent.estimators.friction_mixture.state.memory import new_filters
from edge_agent.lab.simulation.presets import PRESETS
from schemas.vehicle import Calibration

CAR = PRESETS["sedan"].vehicle
NOMINAL = nominal_states(Constants())


def test_each_learned_quantity_narrows_its_state_and_a_vague_one_does_not() -> None:
    vague = Calibration.model_validate(
        {"drives": 1, **{quantity: (0.0, 10.0) for quantity, _ in LEARNED.values()}}
    )
    for state, (quantity, each_drive) in LEARNED.items():
        sharp = Calibration.model_validate({"drives": 1, quantity: (0.0, 1e-6)})
        plain, unsure, known = spreads_of(
            [CAR.model_copy(update={"calibration": one}) for one in (None, vague, sharp)],
            NOMINAL.std,
        )
        assert np.array_equal(plain, NOMINAL.std)
        assert np.array_equal(unsure, NOMINAL.std)
        assert np.flatnonzero(known != plain).tolist() == [state]
        assert known[state] == np.hypot(1e-6, each_drive)


def test_each_filter_of_a_bank_has_the_prior_of_its_own_vehicle() -> None:
    known = CAR.model_copy(update={"calibration": Calibration(drives=3, ax=(0.2, 0.05))})
    filters = new_filters(
        np.zeros((2, len(Parameter))), NOMINAL, NOMINAL.mean, spreads_of([CAR, known], NOMINAL.std)
    )
    spreads = filters["nominal"]["std"]
    assert spreads.shape == (2, STATES)
    assert spreads[0, NodeState.BIAS_X] == Constants().physical.offset_std
    assert spreads[1, NodeState.BIAS_X] < 0.6 * spreads[0, NodeState.BIAS_X]
    assert np.array_equal(filters["nominal"]["time"], np.stack([NOMINAL.time] * 2))
