"""A session that waits for its router says why, in words of a user's world."""

from __future__ import annotations

import logging
import socket
import threading

import pytest

from schemas.config import ZenohSettings
from schemas.runtime import zenoh_session


def test_waiting_for_a_router_is_reported_once_without_build_paths(
    caplog: pytest.LogCaptureFixture, monkeypatch: pytest.MonkeyPatch
) -> None:
    tries, stop = list[int](), threading.Event()
    configured = zenoh_session.configuration

    def counted(settings: ZenohSettings, name: str = "") -> object:
        tries.append(1)
        if len(tries) == 3:
            stop.set()
        return configured(settings, name)

    monkeypatch.setattr(zenoh_session, "configuration", counted)
    with socket.create_server(("127.0.0.1", 0)) as taken:  # a port at which nobody listens any more
        endpoint = f"tcp/127.0.0.1:{taken.getsockname()[1]}"
    with caplog.at_level(logging.WARNING):
        assert zenoh_session.open_session(ZenohSettings(connect=[endpoint]), stop) is None
    (said,) = caplog.messages
    assert len(tries) == 3
    assert said.startswith(f"no session at {endpoint} yet: ")
    assert "/" not in said.replace("tcp/127.0.0.1", "")
