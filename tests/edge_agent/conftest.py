"""Fixtures for tests that need a Zenoh router."""

from __future__ import annotations

from collections.abc import Iterator

import pytest

from tests.edge_agent.service import Router, Service


@pytest.fixture
def router() -> Iterator[Router]:
    """Yield a Zenoh router that runs for this test."""
    router = Router()
    yield router
    router.stop()


@pytest.fixture
def service(router: Router) -> Iterator[Service]:
    """Yield a simulated service that acknowledges every batch."""
    with Service(router) as service:
        yield service
