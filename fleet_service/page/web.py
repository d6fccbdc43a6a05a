"""Web application of the page: all HTTP routes, with limits, compression and security headers.

Every answer has headers that forbid inline scripts, content from other hosts, and framing.
"""

from __future__ import annotations

import contextlib
from collections.abc import AsyncIterator, Awaitable, Callable, Iterable
from typing import Any
from urllib.parse import urlsplit

from starlette.applications import Starlette
from starlette.middleware.gzip import GZipMiddleware
from starlette.requests import Request
from starlette.responses import PlainTextResponse, Response
from starlette.routing import Route
from starlette.types import ASGIApp, Message, Receive, Scope, Send

from fleet_service.page.map_routes import MapRoutes
from fleet_service.page.ogc import FeatureRoutes
from fleet_service.page.place_routes import PlaceRoutes
from fleet_service.page.site_routes import SiteRoutes
from fleet_service.page.sources import Handlers, Sources
from fleet_service.page.turns import RequestTurns
from fleet_service.page.watchers import Watchers
from schemas.errors import InputError, WireError


def make_application(
    sources: Sources, hosts: Iterable[str], lifespan: Callable[[Starlette], Any]
) -> ASGIApp:
    """Return the web application, with compression and security headers.

    Args:
        sources: data sources.
        hosts: accepted host names; if empty, any name is accepted.
        lifespan: context that runs as long as the application.
    """
    features = FeatureRoutes(sources.world, sources.reader)
    base = sources.base_map
    paths: Handlers = {
        **SiteRoutes(sources, features).paths(),
        **MapRoutes(sources).paths(),
        **PlaceRoutes(sources).paths(),
        **features.paths(),
    }
    turns = RequestTurns()
    app = Starlette(
        routes=[Route(path, with_turns(turns, answer)) for path, answer in paths.items()],
        lifespan=lifespan,
    )
    return Guarded(
        GZipMiddleware(app, minimum_size=2000, compresslevel=3),
        frozenset(hosts),
        base.address if base else None,
    )


def with_turns(
    turns: RequestTurns, answer: Callable[[Request], Awaitable[Response]]
) -> Callable[[Request], Awaitable[Response]]:
    """Return the request handler `answer` with a limit: the handler runs only when `turns`, which
    counts the requests of each client, allows another one. An invalid request is answered with the
    problem and the fix.
    """

    async def answer_or_refuse(request: Request) -> Response:
        try:
            async with turns.take(request.client.host if request.client else ""):
                if await request.is_disconnected():
                    return Response(status_code=408)
                return await answer(request)
        except (InputError, WireError) as error:
            return PlainTextResponse(f"{error}\n", 400)

    return answer_or_refuse


class Guarded:
    """Wrapper of the web application that adds security headers to every answer, and refuses
    foreign host names (against DNS rebinding).
    """

    def __init__(self, app: ASGIApp, hosts: frozenset[str], base_map: str | None) -> None:
        self._app = app
        self._hosts = hosts
        pictures = f"'self' data: {origin_of(base_map or '')}".rstrip()
        policy = (
            f"default-src 'none'; script-src 'self'; style-src 'self'; img-src {pictures}; "
            "connect-src 'self'; "
            "base-uri 'none'; form-action 'none'; frame-ancestors 'none'"
        )
        self._headers = [
            (b"content-security-policy", policy.encode()),
            (b"x-content-type-options", b"nosniff"),
            (b"referrer-policy", b"no-referrer"),
            (b"cross-origin-resource-policy", b"same-origin"),
            (b"x-frame-options", b"DENY"),
        ]

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Process a request to the page: refuse a foreign host name, otherwise forward the request
        and add the headers to the answer.
        """

        async def send_with_headers(message: Message) -> None:
            if message["type"] == "http.response.start":
                message["headers"] = [*message["headers"], *self._headers]
            await send(message)

        if scope["type"] == "http" and self._hosts and _host_name(scope) not in self._hosts:
            refusal = PlainTextResponse(
                "this page is not served under this host name; see --name\n", 421
            )
            await refusal(scope, receive, send_with_headers)
        else:
            await self._app(scope, receive, send_with_headers)


def _host_name(scope: Scope) -> str:
    named = next(
        (value.decode("latin-1") for name, value in scope["headers"] if name == b"host"), ""
    )
    with contextlib.suppress(ValueError):
        return urlsplit(f"//{named}").hostname or ""
    return ""


def origin_of(address: str) -> str:
    """Return scheme, host and port of a web address as text; "" if the address has no host and so
    refers to this server.
    """
    parts = urlsplit(address)
    return f"{parts.scheme}://{parts.netloc}" if parts.netloc else ""


@contextlib.asynccontextmanager
async def push_changes(watchers: Watchers) -> AsyncIterator[None]:
    """Send changes to the browsers while the block runs; then end all streams."""
    import asyncio

    task = asyncio.create_task(watchers.run())
    try:
        yield
    finally:
        watchers.close()
        task.cancel()
        with contextlib.suppress(asyncio.CancelledError):
            await task
