"""Tests of the reset of the motion estimate to the speed of rolling wheels. A wrong estimate must
be reset. A slide on ice must not be, because a reset also forgets the friction.
"""

from __future__ import annotations

from typing import cast

import pytest

from edge_agent.adaptation.memberships import Memberships
from edge_agent.estimators import flags
from edge_agent.estimators.friction_mixture.restart import reset_to_wheel_speed
from edge_agent.estimators.friction_mixture.state.constants import NodeState
from edge_agent.estimators.friction_mixture.state.design import design_of
from edge_agent.estimators.friction_mixture.state.memory import MixtureMemory
from schemas.runtime.records import RecordArray, records

DESIGN = design_of(Memberships(), adaptive=True)
SPEED = 10.0  # [m/s]


def filter_at(vx: float, vy: float, vy_std: float) -> RecordArray:
    """Return the record of a filter that estimates the velocity (vx, vy) [m/s], with standard
    deviation `vy_std`. The wheels roll at SPEED and the rear axle follows.
    """
    memory = records(MixtureMemory, 1)
    memory["nominal"]["std"] = 1.0
    memory["rolling"]["ahead"] = SPEED
    memory["rolling"]["ahead_std"] = 0.1
    memory["rolling"]["left_std"] = 0.1
    memory["overall_mean"][0, NodeState.VX] = vx
    memory["overall_mean"][0, NodeState.VY] = vy
    memory["overall_covariance"][0, NodeState.VY, NodeState.VY] = vy_std**2
    return memory


def reset(memory: RecordArray) -> int:
    """Return the health flags of a test for a reset, which changes `memory`."""
    return reset_to_wheel_speed(cast(MixtureMemory, memory[0]), DESIGN)


@pytest.mark.parametrize(
    ("vx", "vy", "vy_std", "expected"),
    [
        (SPEED, 0.0, 0.4, False),  # estimate and wheels agree
        (SPEED, -2.5, 0.4, True),  # the lateral velocity has drifted away, and the filter knows it
        (SPEED, -2.5, 0.1, False),  # the car slides sideways, and the filter is sure of it
        (SPEED + 3.0, 0.0, 0.1, True),  # the wheels agree on another speed
    ],
)
def test_motion_is_reset_where_the_filter_is_unsure(
    vx: float, vy: float, vy_std: float, expected: bool
) -> None:
    assert reset(filter_at(vx, vy, vy_std)) == (flags.RESET if expected else 0)


def test_reset_forgets_the_slips_that_a_wrong_velocity_gave() -> None:
    memory = filter_at(SPEED + 3.0, 0.0, 0.1)
    memory["built_along"] = -0.3
    memory["built_across"] = 0.2
    reset(memory)
    assert not memory["built_along"].any()
    assert not memory["built_across"].any()
