"""Tests of the sessions of several vehicles: one that finds no router delays no other."""

from __future__ import annotations

import logging
import threading

import pytest

from edge_agent.publish.session_links import SessionLinks
from schemas.config import ZenohSettings
from tests.edge_agent.service import Router
from tests.waiting import until


def test_vehicle_without_a_router_delays_no_other(
    router: Router, caplog: pytest.LogCaptureFixture
) -> None:
    """The endpoint contains the vehicle's name, and only "localhost" is the name of a machine."""
    port = router.endpoint.rpartition(":")[2]
    endpoint = {"connect/endpoints": ["tcp/{name}:" + port]}
    opened: list[str] = []
    stop = threading.Event()
    links = SessionLinks(
        ["nowhere.invalid", "nowhere.invalid", "localhost"],
        ZenohSettings(config=endpoint),
        lambda name, _: opened.append(name),
        lambda *_: None,
        stop,
    )
    with caplog.at_level(logging.WARNING):
        links.start()
        until(lambda: opened and caplog.messages)
    stop.set()
    links.close()
    assert opened == ["localhost"]
    assert links.session_count == 1
    assert len([line for line in caplog.messages if line.startswith("no session at ")]) == 1
