"""HTTP routes of the page: files, cells by tile, events, one cell, moments, a route, health.

Every answer has headers that forbid inline scripts, content from other hosts, and framing.
"""

from __future__ import annotations

import contextlib
from collections.abc import AsyncIterator, Awaitable, Callable, Iterable
from pathlib import Path
from typing import Any, Final, NamedTuple
from urllib.parse import urlsplit

from starlette.applications import Starlette
from starlette.concurrency import run_in_threadpool
from starlette.middleware.gzip import GZipMiddleware
from starlette.requests import Request
from starlette.responses import JSONResponse, PlainTextResponse, Response, StreamingResponse
from starlette.routing import Route
from starlette.types import ASGIApp, Message, Receive, Scope, Send

from fleet_service.client.datex_feed import DatexFile
from fleet_service.page import areas, colours, ogc, overlay, records, request_params, route
from fleet_service.page.basemap import BaseMap
from fleet_service.page.files import Files
from fleet_service.page.health import ServiceHealth
from fleet_service.page.map_mirror import MapMirror
from fleet_service.page.moments import Moments
from fleet_service.page.ogc import FeatureRoutes
from fleet_service.page.reader import Reader
from fleet_service.page.roads import RoadMap, learned_lines
from fleet_service.page.turns import RequestTurns
from fleet_service.page.watchers import TooManyWatchersError, Watchers
from schemas import grid, keys
from schemas.errors import InputError, WireError
from schemas.thresholds import NS, REACTION_S

STATIC: Final = Path(__file__).with_name("static")
BLOCKS: Final = "application/vnd.gripmap.blocks"


class Sources(NamedTuple):
    """Data sources from which the HTTP routes of the page take their answers."""

    world: MapMirror
    reader: Reader
    moments: Moments
    health: ServiceHealth
    watchers: Watchers
    overlay: Path | None = None
    base_map: BaseMap | None = None
    datex: DatexFile | None = None
    roads: RoadMap | None = None


def make_application(
    sources: Sources, hosts: Iterable[str], lifespan: Callable[[Starlette], Any]
) -> ASGIApp:
    """Return the web application, with compression and security headers.

    Args:
        sources: data sources.
        hosts: accepted host names; if empty, any name is accepted.
        lifespan: context that runs as long as the application.
    """
    routes = Routes(sources)
    base = sources.base_map
    paths: dict[str, Callable[[Request], Awaitable[Response]]] = {
        "/": routes.index,
        "/static/{name}": routes.file,
        "/settings": routes.settings,
        "/texts": routes.texts,
        "/tiles": routes.tiles,
        "/blocks": routes.blocks,
        "/events": routes.events,
        "/cell/{cell}/{sector}": routes.cell,
        "/history/{cell}/{sector}": routes.history,
        "/moments": routes.times,
        "/route": routes.route,
        "/health": routes.health,
        "/overlay": routes.overlay,
        "/roads": routes.roads,
        "/areas": routes.areas,
        "/datex2/situation.xml": routes.situations,
        "/base/{z:int}/{x:int}/{y:int}": routes.picture,
        **routes.features.paths(),
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


class Routes:
    """Request handlers of the page, one method per route."""

    def __init__(self, sources: Sources) -> None:
        self._of = sources
        self._files = Files(STATIC)
        self.features = FeatureRoutes(sources.world, sources.reader)

    async def index(self, request: Request) -> Response:
        """Return the live page. A program gets the landing page of OGC API Features instead."""
        if ogc.wants_json(request):
            return await self.features.landing(request)
        found = self._files.answer("index.html", request, "Accept, Accept-Encoding")
        assert found is not None
        return found

    async def file(self, request: Request) -> Response:
        """Return the static file of the page that a request names."""
        found = self._files.answer(request.path_params["name"], request)
        return PlainTextResponse("no such file\n", 404) if found is None else found

    async def texts(self, request: Request) -> Response:
        """Return the texts of the page in the browser's language if available, else in English."""
        name = self._files.texts(request.headers.get("accept-language", ""))
        found = self._files.answer(name, request, "Accept-Encoding, Accept-Language")
        assert found is not None
        return found

    async def settings(self, _: Request) -> Response:
        """Return the constants and colours that the page's scripts need as JSON."""
        base = self._of.base_map
        return JSONResponse(
            {
                "colours": colours.as_json(),
                "reaction_s": REACTION_S,
                "sights_m": route.SIGHTS_M,
                "mu_steps": records.MU_STEPS,
                "share_steps": records.SHARE_STEPS,
                "overlay": self._of.overlay is not None,
                "base_map": base
                and {
                    "address": base.address,
                    "zooms": base.zooms,
                    "vector": base.is_vector,
                    "attribution": base.attribution,
                },
                "archive": self._of.moments.has_archive,
                "roads": self._of.roads is not None,
            }
        )

    async def roads(self, _: Request) -> Response:
        """Return the lines along which the page draws ribbons: from the operator's file, or derived
        from the cells.
        """
        if self._of.roads is not None:
            return JSONResponse(self._of.roads.as_json() | {"learned": False})
        lines = await run_in_threadpool(lambda: learned_lines(*self._of.world.places()))
        return JSONResponse(RoadMap(lines, []).as_json() | {"learned": True})

    async def areas(self, _: Request) -> Response:
        """Return the areas of the map that have cells, those with the most alerts first."""
        named = self._of.roads.places if self._of.roads is not None else []
        return JSONResponse(await run_in_threadpool(areas.found_in, self._of.world, named))

    async def picture(self, request: Request) -> Response:
        """Return a base map tile from the operator's file; status 204 without content if there is
        no such tile.
        """
        file = self._of.base_map and self._of.base_map.file
        if not file:
            return PlainTextResponse("this page serves no tiles; see --base-map\n", 404)
        found = await run_in_threadpool(
            file.picture, *(request.path_params[name] for name in "zxy")
        )
        headers = {"Cache-Control": "max-age=3600"}
        return Response(
            found, 200 if found else 204, headers, media_type=file.kind if found else None
        )

    async def tiles(self, request: Request) -> Response:
        """Return the numbers of the tiles that have cells, now or at the time `at`."""
        at = request_params.parse_moment(request)
        found = (
            self._of.world.tiles()
            if at is None
            else await run_in_threadpool(self._of.moments.tiles, at)
        )
        return JSONResponse(found)

    async def blocks(self, request: Request) -> Response:
        """Return the requested `tiles` as blocks (encoded records of their cells) at a zoom
        `level`, now or at the time `at`. With `borrowed`, cells estimated from neighbours are
        included.
        """
        wanted = request_params.parse_tiles(request)
        level = request_params.parse_level(request)
        at = request_params.parse_moment(request)
        if at is not None:
            made = await run_in_threadpool(
                lambda: [self._of.moments.encoded(at, tile, level) for tile in wanted]
            )
        elif "borrowed" in request.query_params:
            made = await run_in_threadpool(lambda: [self._borrowed_cells(tile) for tile in wanted])
        else:
            made = [self._of.world.encoded(tile, level) for tile in wanted]
        return Response(b"".join(made), media_type=BLOCKS, headers={"Cache-Control": "no-store"})

    def _borrowed_cells(self, tile: int) -> bytes:
        version = self._of.world.version(
            tile
        )  # a page passes over what is older than what it holds
        found = self._of.reader.ask(keys.map_key(tile), {"basis": "borrowed"})
        return b"".join(
            records.TileBlock(
                key, records.CELL_LEVEL, version, 0, 0.0, records.of_table(table)
            ).encoded()
            for key, table in found
        )

    async def events(self, request: Request) -> Response:
        """Return a stream of the changes in `bbox` at a zoom `level`, from now on."""
        try:
            stream = self._of.watchers.enter(
                request_params.parse_view(request), request.client.host if request.client else ""
            )
        except TooManyWatchersError:
            return PlainTextResponse(
                "too many live connections are open\n", 503, headers={"Retry-After": "10"}
            )
        headers = {"Cache-Control": "no-store", "X-Accel-Buffering": "no"}
        return StreamingResponse(stream, media_type="text/event-stream", headers=headers)

    async def cell(self, request: Request) -> Response:
        """Return the present values of the cell and heading sector that a request names."""
        cell, sector = request_params.parse_place(request)
        return JSONResponse(await run_in_threadpool(self._cell, cell, sector))

    def _cell(self, cell: int, sector: int) -> dict[str, Any] | None:
        box = ",".join(f"{side:.9f}" for side in (float(edge) for edge in grid.bounds(cell)))
        for _, table in self._of.reader.ask(keys.map_key(int(grid.tile_of(cell))), {"bbox": box}):
            for row in table.to_pylist():
                if row["cell"] == cell and row["sector"] == sector:
                    measured = row["basis"] == "measured"
                    speeds = route.safe_speeds(row["mu_lower"]) if measured else None
                    times = {name: row[name].value / NS for name in ("first_time", "last_time")}
                    return row | times | {"cell": str(cell), "safe_speed": speeds}
        return None

    async def history(self, request: Request) -> Response:
        """Return the belief (mu with its interval and P(slippery)) about a cell at each past moment
        of which the map is stored.
        """
        return JSONResponse(
            await run_in_threadpool(self._of.moments.history, *request_params.parse_place(request))
        )

    async def times(self, _: Request) -> Response:
        """Return the past moments of which the map is stored [s since 1970]."""
        return JSONResponse(await run_in_threadpool(self._of.moments.times))

    async def route(self, request: Request) -> Response:
        """Return the friction along the route that the parameter `points` describes."""
        points, text = request_params.parse_route(request)
        return JSONResponse(await run_in_threadpool(self._profile, points, text))

    def _profile(self, points: list[tuple[float, float]], text: str) -> dict[str, Any]:
        import pyarrow as pa

        from schemas.tables import MAP_SCHEMA

        replies = [
            table for _, table in self._of.reader.ask(f"{keys.ROOT}/map/**", {"route": text})
        ]
        return route.grip_profile(
            points, pa.concat_tables(replies) if replies else MAP_SCHEMA.empty_table()
        )

    async def health(self, _: Request) -> Response:
        """Return the health of the fleet services and of this page as JSON."""
        services = await run_in_threadpool(self._of.health.services)
        reader = self._of.reader
        watchers = self._of.watchers
        return JSONResponse(
            {
                "services": services,
                "names": reader.names("shard"),
                "vehicles": len(reader.names("alive")),
                "regions": reader.regions(),
                "router": reader.is_connected,
                "watchers": len(watchers),
                "reloads": watchers.reloads,
            }
        )

    async def situations(self, _: Request) -> Response:
        """Return the slippery stretches as a DATEX II publication: a message for road authorities
        with the complete current state (snapshot pull).
        """
        if self._of.datex is None:
            return PlainTextResponse("this page publishes no situations; see --datex\n", 404)
        if self._of.datex.document is None:
            message = "no service has answered yet; this does not mean that roads are dry\n"
            return PlainTextResponse(message, 503, headers={"Retry-After": "10"})
        return Response(
            self._of.datex.document,
            media_type="application/xml",
            headers={"Cache-Control": "no-store"},
        )

    async def overlay(self, _: Request) -> Response:
        """Return the cells of the additional map that is drawn over the live one, such as the true
        friction of a simulation; null if there is none.
        """
        return JSONResponse(await run_in_threadpool(overlay.read_overlay, self._of.overlay))


def with_turns(
    turns: RequestTurns, answer: Callable[[Request], Awaitable[Response]]
) -> Callable[[Request], Awaitable[Response]]:
    """Return the request handler `answer` with a limit: it runs only when `turns` allows another
    request of the client. An invalid request is answered with the problem and the fix.
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
