"""Fixtures for tests that need a Zenoh router."""

from __future__ import annotations

from collections.abc import Iterator

import pytest

from edge_agent.publish import publisher
from tests.edge_agent.service import Router, Service
from tests.waiting import PATIENCE_S


@pytest.fixture
def router(monkeypatch: pytest.MonkeyPatch) -> Iterator[Router]:
    """Yield a Zenoh router that runs for this test. Agents in the test's process wait until their
    sessions with it are closed, however busy the machine is.
    """
    monkeypatch.setattr(publisher, "CLOSE_GRACE_S", PATIENCE_S)
    router = Router()
    yield router
    router.stop()


@pytest.fixture
def service(router: Router) -> Iterator[Service]:
    """Yield a simulated service that acknowledges every batch."""
    with Service(router) as service:
        yield service
