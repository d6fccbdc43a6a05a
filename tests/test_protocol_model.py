"""Exhaustive check of the protocol by which services take over an archive. Every reachable state of
its model must keep the promises. If any one rule of the protocol is removed, some state must break
a promise.
"""

from __future__ import annotations

import pytest

from tests.faults.protocol_model import BROKEN, Rules, explore_states


@pytest.mark.campaign
@pytest.mark.parametrize("lease", [(4, 4), (6, 2)])
def test_no_state_breaks_a_promise(lease: tuple[int, int]) -> None:
    found = explore_states(Rules(lease=lease), most_turn=1)
    assert found.violation is None
    assert found.states > 100


@pytest.mark.campaign
@pytest.mark.parametrize("rules", BROKEN.values(), ids=BROKEN)
def test_each_rule_is_needed(rules: Rules) -> None:
    found = explore_states(rules, most_turn=1)
    assert found.violation is not None
    assert found.violation.steps
