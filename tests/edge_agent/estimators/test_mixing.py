"""Tests of the end of a slide, when the belief changes from ice to another road. Only a wheel that
grips again under load may show that the ice has ended.
"""

from __future__ import annotations

from typing import cast

import pytest

from edge_agent.app.estimator_factory import bank_of
from edge_agent.estimators.friction_mixture.mixture.mixing import carried_degree
from edge_agent.estimators.friction_mixture.state.constants import Constants
from edge_agent.estimators.friction_mixture.state.memory import MixtureMemory
from schemas.runtime.records import records
from tests.edge_agent.estimators.drives import drive

SNOW = 0.3
# An upper end of the interval below this is a report of a slippery road.
SLIPPERY = 0.5


@pytest.mark.parametrize(
    ("demand", "degree"), [(0.0, 0.0), (0.4, 0.0), (0.6, 0.5), (0.8, 1.0), (1.5, 1.0)]
)
def test_carried_degree_rises_with_force_over_friction(demand: float, degree: float) -> None:
    memory = records(MixtureMemory, 1)
    memory["friction_left"]["median"] = 0.8
    memory["friction_right"]["median"] = 0.2  # the slippery side counts
    found = carried_degree(
        cast(MixtureMemory, memory[0]), Constants().replace_values(carried_share=0.4), 0.2 * demand
    )
    assert found == pytest.approx(degree)


def test_snow_stays_reported_between_pulses_of_the_brake() -> None:
    t, signals, vehicle = drive("pulses", SNOW)
    upper = bank_of("aco-fckf", [vehicle]).advance(t[:, None], signals[:, None]).mu_upper[:, 0]
    slippery = upper < SLIPPERY
    assert slippery[slippery.argmax() :].mean() > 0.99  # .973 if each end of a slide is the snow's
