"""Fixtures of the rim's tests."""

from __future__ import annotations

from collections.abc import Iterator

import pytest

from tests.edge_agent.service import Router, Service


@pytest.fixture
def router() -> Iterator[Router]:
    """A router of this test."""
    router = Router()
    yield router
    router.stop()


@pytest.fixture
def service(router: Router) -> Iterator[Service]:
    """A service that acknowledges."""
    with Service(router) as service:
        yield service
