"""Process of the page: a Zenoh session in a thread and a web server, which run until a signal
arrives.
"""

from __future__ import annotations

import asyncio
import contextlib
import logging
import socket
import threading
from collections.abc import AsyncIterator, Callable, Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Final

import uvicorn
from starlette.applications import Starlette
from starlette.types import ASGIApp

from fleet_service.client.datex_feed import DatexFile
from fleet_service.client.watching import GATHER_S
from fleet_service.page import web
from fleet_service.page.basemap import BaseMap
from fleet_service.page.connections import BoundedProtocol, limit_messages, report_loop_error
from fleet_service.page.health import ServiceHealth
from fleet_service.page.map_mirror import MapMirror
from fleet_service.page.moments import Moments
from fleet_service.page.reader import Reader
from fleet_service.page.roads import RoadMap
from fleet_service.page.sources import Sources
from fleet_service.page.watchers import MOST, Watchers
from schemas.config import ZenohSettings
from schemas.errors import InputError

log = logging.getLogger(__name__)
LOOPBACK: Final = ("127.0.0.1", "localhost", "::1")
LEAVE_S: Final = 2
LOOK_S: Final = 0.1


@dataclass(frozen=True)
class PageSettings:
    """Settings of the page.

    Attributes:
        connection: connection settings for the router.
        host, port: listen address; port 0 selects a free port.
        names: host names under which browsers may request the page, for example the name of a
            proxy. Loopback names are then accepted too. If empty, a page on the loopback interface
            accepts only loopback names, and any other page accepts all names.
        archive: folder of a service's archive, from which the page shows maps of past moments; None
            without an archive.
        metrics: addresses at which services publish their metrics, for the health view.
        overlay: Parquet file of cell, sector and mu to draw over the map.
        base_map: tiles below the roads; None without a base map.
        roads: road lines along which coloured ribbons of friction are drawn; None to derive them
            from the cells.
        datex: DATEX II publication to keep up to date and to serve; None without one.
        max_browsers: maximum number of browsers that receive live changes.
    """

    connection: ZenohSettings
    host: str = "127.0.0.1"
    port: int = 8080
    names: list[str] = field(default_factory=list)
    archive: Path | None = None
    metrics: list[str] = field(default_factory=list)
    overlay: Path | None = None
    base_map: BaseMap | None = None
    roads: RoadMap | None = None
    datex: DatexFile | None = None
    max_browsers: int = MOST


def run(settings: PageSettings, stop: threading.Event, log_line: Callable[[str], None]) -> None:
    """Serve the live page until `stop` is set; call `log_line` with `page: ADDRESS` when the server
    listens.

    Raises:
        InputError: the port is in use.
    """
    listening = open_socket(settings.host, settings.port)
    world = MapMirror()
    reader = Reader(settings.connection, world)

    def reader_state() -> dict[str, Any]:
        unserved = [region for region in reader.regions() if not region["served"]]
        return {"router": reader.is_connected, "served": reader.is_served, "away": unserved}

    watchers = Watchers(world, reader_state, settings.max_browsers)
    sources = Sources(
        world,
        reader,
        Moments(settings.archive, world.recent),
        ServiceHealth(settings.metrics),
        watchers,
        overlay=settings.overlay,
        base_map=settings.base_map,
        datex=settings.datex,
        roads=settings.roads,
    )
    hosts = [*settings.names, *(LOOPBACK if settings.host in LOOPBACK or settings.names else ())]

    @contextlib.asynccontextmanager
    async def lifespan(_: Starlette) -> AsyncIterator[None]:
        async with web.push_changes(watchers):
            yield

    app = web.make_application(sources, hosts, lifespan)
    listener = threading.Thread(target=reader.run, args=(stop,), name="reader", daemon=True)
    listener.start()
    if settings.datex is not None:
        threading.Thread(
            target=update_publication,
            args=(settings.datex, world, reader, stop),
            name="datex",
            daemon=True,
        ).start()
    try:
        asyncio.run(_serve_app(app, listening, stop, watchers, log_line))
    finally:
        stop.set()
        listener.join(LEAVE_S)


def update_publication(
    file: DatexFile, world: MapMirror, reader: Reader, stop: threading.Event
) -> None:
    """Keep the DATEX II publication in `file` consistent with the received alerts until `stop` is
    set.
    """
    seen = -1
    while not stop.wait(GATHER_S):
        if not reader.is_served or (world.alerts.received_count == seen and not file.is_due):
            # Without a service, no situation is ended. The publication time shows how old it is.
            continue
        seen = world.alerts.received_count
        try:
            file.keep_up(world.alerts.stretches(), reader.has_service)
        except InputError as error:  # clients still get the last publication
            log.warning("%s", error)


async def _serve_app(
    app: ASGIApp,
    listening: socket.socket,
    stop: threading.Event,
    watchers: Watchers,
    log_line: Callable[[str], None],
) -> None:
    config = uvicorn.Config(
        app,
        log_level="warning",
        access_log=False,
        server_header=False,
        lifespan="on",
        ws="none",
        timeout_graceful_shutdown=LEAVE_S,
        h11_max_incomplete_event_size=64 * 1024,
        http=BoundedProtocol,
    )
    limit_messages()
    asyncio.get_running_loop().set_exception_handler(report_loop_error)
    server = _Server(config)
    serving = asyncio.create_task(server.serve(sockets=[listening]))
    while not server.started and not serving.done():
        await asyncio.sleep(0.01)
    host, port = listening.getsockname()[:2]
    log_line(f"page: http://{f'[{host}]' if ':' in host else host}:{port}/")
    while not stop.is_set() and not serving.done():
        await asyncio.sleep(LOOK_S)
    watchers.close()
    server.should_exit = True
    await serving


class _Server(uvicorn.Server):
    """Web server of the page. It installs no signal handlers, because the command that starts it
    handles signals.
    """

    @contextlib.contextmanager
    def capture_signals(self) -> Iterator[None]:
        yield


def open_socket(host: str, port: int) -> socket.socket:
    """Return a TCP socket that is bound to an address, for the web server.

    The socket is created with the protocol TCP stated explicitly, because the event loop sets
    TCP_NODELAY only on such sockets. Without TCP_NODELAY, the body of an answer waits until the
    browser acknowledges the head: 40 ms on a connection in use.

    Raises:
        InputError: the address or port cannot be used.
    """
    family = socket.AF_INET6 if ":" in host else socket.AF_INET
    found = socket.socket(family, socket.SOCK_STREAM, socket.IPPROTO_TCP)
    found.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
    try:
        found.bind((host, port))
    except OSError as error:
        found.close()
        fix = "give another with --port, or 0 for a free one"
        raise InputError(
            "port", f"cannot listen on {host}:{port} ({error.args[-1]})", fix
        ) from error
    return found
