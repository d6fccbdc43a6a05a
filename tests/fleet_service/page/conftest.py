"""Fixtures: a live page in this process with a router and a service."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

import pytest
import zenoh

from fleet_service.page.server import PageSettings, run
from schemas.config import ZenohSettings
from tests.fleet_service.conftest import Running, running
from tests.fleet_service.page import street
from tests.waiting import PATIENCE_S, until


@dataclass
class RunningPage:
    """Running page: its address, the service behind it, and the folder of the service's archive."""

    address: str
    service: Running | None
    archive: Path


@contextmanager
def page_of(connection: ZenohSettings, **changed: object) -> Iterator[str]:
    """Yield the address of a page that runs in a thread of this process, and stop the page after
    the `with` block.
    """
    stop = threading.Event()
    lines = list[str]()
    settings = PageSettings(connection, port=0, **changed)  # type: ignore[arg-type]
    thread = threading.Thread(target=run, args=(settings, stop, lines.append))
    thread.start()
    try:
        until(lambda: lines and lines[-1].startswith("page: "))
        yield lines[-1].removeprefix("page: ")
    finally:
        stop.set()
        thread.join(PATIENCE_S)
        assert not thread.is_alive(), "the page does not leave"


@pytest.fixture(scope="module")
def bare(router: ZenohSettings) -> Iterator[str]:
    """Yield the address of a page whose router has no fleet service."""
    with page_of(router) as address:
        yield address


@pytest.fixture
def page(router: ZenohSettings, tmp_path: Path) -> Iterator[RunningPage]:
    """Yield a page, with a service that stores a snapshot of the map each second."""
    archive = tmp_path / "archive"
    with (
        running(router, archive, snapshot_s=1.0) as service,
        page_of(router, archive=archive) as address,
    ):
        yield RunningPage(address, service, archive)


Drive = Callable[..., None]


@pytest.fixture
def drive(session: zenoh.Session, page: RunningPage) -> Drive:
    """Return a function that lets the test's cars drive over named parts of the street crossing.
    The function returns when the service has acknowledged the cars' reports.
    """
    seq = 1

    def go(*parts: str) -> None:
        nonlocal seq
        assert page.service is not None
        before = page.service.service.engine.counts.observations
        named = parts or tuple(street.PARTS)
        seq = street.put(session, named, time.time_ns(), seq)
        wanted = before + street.count_known(*named) * len(street.CARS)
        until(lambda: page.service and page.service.service.engine.counts.observations >= wanted)

    return go
