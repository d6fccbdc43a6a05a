"""Tests that active alerts are published again, so that a client receives them after an outage of
the client or of its router.
"""

from __future__ import annotations

import pytest
import zenoh

from tests.fleet_service.app.test_service import Fleet, seconds
from tests.fleet_service.conftest import Running
from tests.fleet_service.examples import batch
from tests.waiting import PATIENCE_S


@pytest.fixture
def fleet(service: Running, session: zenoh.Session) -> Fleet:
    return Fleet(session).await_services()


def test_standing_alerts_are_repeated_and_cleared_ones_are_not(fleet: Fleet) -> None:
    moments = seconds()
    fleet.settle(*(batch(f"sim-{k:03}", 1, next(moments), [0.2]) for k in range(3)))
    raised = fleet.alerts.get(timeout=PATIENCE_S)
    late = Fleet(fleet.session)
    assert late.alerts.get(timeout=PATIENCE_S) == raised
    for k in range(10):
        fleet.settle(batch(f"sim-{100 + k}", 1, next(moments), [0.85]))
    assert not late.alerts.get(timeout=PATIENCE_S).raised
    before = late.repeated
    fleet.settle(batch("sim-200", 1, next(moments), [0.85]))
    assert late.repeated == before
