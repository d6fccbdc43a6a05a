"""Fixtures: a router in this process, a running service, a client, a bucket."""

from __future__ import annotations

import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

import pytest
import zenoh

from deploy.router import open_router
from fleet_service.app.service import Service
from schemas.config import ServiceConfig, ZenohSettings
from schemas.runtime.zenoh_session import open_session
from tests.buckets import BucketServer, bucket_server
from tests.event_lines import logger_into
from tests.waiting import PATIENCE_S, until

PUT_S = 0.1


@dataclass
class Running:
    """Service that runs in a thread of the test's process."""

    service: Service
    lines: list[str]
    thread: threading.Thread
    stop: threading.Event

    def end(self) -> None:
        self.stop.set()
        self.thread.join(PATIENCE_S)
        assert not self.thread.is_alive(), "the service does not leave"


@pytest.fixture(scope="session")
def router() -> Iterator[ZenohSettings]:
    """Yield the settings with which a Zenoh session connects to a router in this process."""
    session, endpoints = open_router(listen="tcp/127.0.0.1:0")
    with session:
        yield ZenohSettings(connect=endpoints)


@pytest.fixture
def session(router: ZenohSettings) -> Iterator[zenoh.Session]:
    """Yield the Zenoh session of a client."""
    opened = open_session(router)
    assert opened is not None
    with opened:
        yield opened


@contextmanager
def running(router: ZenohSettings, root: Path, **changed: object) -> Iterator[Running]:
    """Yield a running service on an archive, and stop it after the `with` block."""
    config = ServiceConfig(
        zenoh=router,
        put_s=PUT_S,
        segment_s=0.1,
        **changed,  # type: ignore[arg-type]
    )
    lines: list[str] = []
    service = Service(config, root, logger_into(lines))
    stop = threading.Event()
    thread = threading.Thread(target=service.run, args=(stop,))
    thread.start()
    run = Running(service, lines, thread, stop)
    try:
        until(lambda: any(line.startswith("ready") for line in lines))
        yield run
    finally:
        run.end()


@pytest.fixture
def service(router: ZenohSettings, tmp_path: Path) -> Iterator[Running]:
    """Yield a running service on an empty archive."""
    with running(router, tmp_path / "archive") as run:
        yield run


@pytest.fixture
def start(router: ZenohSettings) -> Callable[..., object]:
    """Return a function that starts a service on the archive in the folder `root`: `with
    start(root): ...`.
    """
    return lambda root, **changed: running(router, root, **changed)


@pytest.fixture
def bucket(tmp_path: Path) -> Iterator[BucketServer]:
    """Yield an S3 server that runs in a separate process."""
    pytest.importorskip("obstore", reason="pip install 'gripmap[objects]'")
    with bucket_server(tmp_path / "objects") as server:
        yield server
