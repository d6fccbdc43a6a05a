"""Tests that a session which waits for its router prints the reason in plain words."""

from __future__ import annotations

import logging
import socket
import threading
from typing import Any

import pytest
import zenoh

from schemas import keys
from schemas.config import ZenohSettings
from schemas.errors import InputError
from schemas.runtime import zenoh_session


def test_a_time_limit_that_hides_the_second_endpoint_is_refused() -> None:
    two = ["quic/127.0.0.1:1", "tls/127.0.0.1:1"]
    limited = ZenohSettings(connect=two, config={"connect/timeout_ms": 5000})
    with pytest.raises(InputError, match="^zenoh.config.connect/timeout_ms: "):
        zenoh_session.configuration(limited)
    zenoh_session.configuration(ZenohSettings(connect=two))
    zenoh_session.configuration(limited.model_copy(update={"connect": two[:1]}))


@pytest.mark.parametrize(
    "endpoint",
    ["127.0.0.1:7447", "tcp/127.0.0.1", "tcp/127.0.0.1:", "tpc/127.0.0.1:7447", "http/host:80"],
)
def test_an_endpoint_that_never_connects_is_refused(endpoint: str) -> None:
    for connect in ([], [endpoint], ["tcp/127.0.0.1:1", endpoint]):
        with pytest.raises(InputError, match="^connect: .*; write PROTOCOL/HOST:PORT"):
            zenoh_session.configuration(ZenohSettings(connect=connect))


@pytest.mark.parametrize(
    "endpoint", ["tls/map.example:7447", "tcp/[::1]:1", "tcp/h:1#iface=lo", "unixsock-stream//a"]
)
def test_usual_endpoints_are_accepted(endpoint: str) -> None:
    zenoh_session.configuration(ZenohSettings(connect=[endpoint]))


def test_alerts_have_the_highest_priority_and_are_sent_at_once() -> None:
    first = zenoh_session.quality_of(keys.TOPICS["alert"])
    assert (first["priority"], first["express"]) == (zenoh.Priority.REAL_TIME, True)
    assert keys.TOPICS["obs"].block
    others = [
        zenoh_session.quality_of(topic) for name, topic in keys.TOPICS.items() if name != "alert"
    ]
    assert all(one["priority"] != first["priority"] for one in others)


def test_waiting_for_a_router_is_reported_once_without_build_paths(
    caplog: pytest.LogCaptureFixture, monkeypatch: pytest.MonkeyPatch
) -> None:
    tries = list[int]()
    stop = threading.Event()
    configured = zenoh_session.configuration

    def count_tries(settings: ZenohSettings, name: str = "") -> object:
        tries.append(1)
        if len(tries) == 3:
            stop.set()
        return configured(settings, name)

    monkeypatch.setattr(zenoh_session, "configuration", count_tries)
    # A port on which nothing listens after this block.
    with socket.create_server(("127.0.0.1", 0)) as taken:
        endpoint = f"tcp/127.0.0.1:{taken.getsockname()[1]}"
    with caplog.at_level(logging.WARNING):
        assert zenoh_session.open_session(ZenohSettings(connect=[endpoint]), stop) is None
    (message,) = caplog.messages
    assert len(tries) == 3
    assert message.startswith(f"no session at {endpoint} yet: ")
    assert "/" not in message.replace("tcp/127.0.0.1", "")


class LentSession:
    """Session that another thread is closing, as Zenoh shows it to other threads."""

    @property
    def info(self) -> zenoh.SessionInfo:
        raise RuntimeError("Already mutably borrowed")


def test_session_that_another_thread_closes_has_no_routers() -> None:
    closing: Any = LentSession()
    assert zenoh_session.connected_routers(closing) == set()
