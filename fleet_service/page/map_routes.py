"""HTTP routes of the map: cells by tile, live changes, roads, areas, and the slippery stretches as
a DATEX II publication.
"""

from __future__ import annotations

from typing import Final

from starlette.concurrency import run_in_threadpool
from starlette.requests import Request
from starlette.responses import JSONResponse, PlainTextResponse, Response, StreamingResponse

from fleet_service.page import areas, overlay, records, request_params
from fleet_service.page.roads import RoadMap, learned_lines
from fleet_service.page.sources import Handlers, Sources
from fleet_service.page.watchers import TooManyWatchersError
from schemas import keys

BLOCKS: Final = "application/vnd.gripmap.blocks"


class MapRoutes:
    """Request handlers for the map as a whole, now or at a past time."""

    def __init__(self, sources: Sources) -> None:
        self._of = sources

    def paths(self) -> Handlers:
        """Return the request handlers by URL path."""
        return {
            "/tiles": self.tiles,
            "/blocks": self.blocks,
            "/events": self.events,
            "/overlay": self.overlay,
            "/roads": self.roads,
            "/areas": self.areas,
            "/datex2/situation.xml": self.situations,
        }

    async def tiles(self, request: Request) -> Response:
        """Return the numbers of the map tiles that have cells, now or at the past time `at`."""
        at = request_params.parse_moment(request)
        found = (
            self._of.world.tiles()
            if at is None
            else await run_in_threadpool(self._of.moments.tiles, at)
        )
        return JSONResponse(found)

    async def blocks(self, request: Request) -> Response:
        """Return the requested `tiles` as blocks (encoded records of their cells) at a zoom
        `level`, now or at the time `at`. With `borrowed`, the blocks also contain cells without
        visits, whose friction is estimated from neighbouring cells.
        """
        tiles = request_params.parse_tiles(request)
        level = request_params.parse_level(request)
        at = request_params.parse_moment(request)
        if at is not None:
            made = await run_in_threadpool(
                lambda: [self._of.moments.encoded(at, tile, level) for tile in tiles]
            )
        elif "borrowed" in request.query_params:
            made = await run_in_threadpool(lambda: [self._borrowed_cells(tile) for tile in tiles])
        else:
            made = [self._of.world.encoded(tile, level) for tile in tiles]
        return Response(b"".join(made), media_type=BLOCKS, headers={"Cache-Control": "no-store"})

    def _borrowed_cells(self, tile: int) -> bytes:
        # The page ignores an answer whose version is older than that of the tile it shows.
        version = self._of.world.version(tile)
        found = self._of.reader.ask(keys.map_key(tile), {"basis": "borrowed"})
        return b"".join(
            records.TileBlock(
                key, records.CELL_LEVEL, version, 0, 0.0, records.of_table(table)
            ).encoded()
            for key, table in found
        )

    async def events(self, request: Request) -> Response:
        """Return a stream of events: the changes of the map in the box `bbox`, at a zoom `level`,
        from now on.
        """
        try:
            stream = self._of.watchers.add_watcher(
                request_params.parse_view(request), request.client.host if request.client else ""
            )
        except TooManyWatchersError:
            return PlainTextResponse(
                "too many live connections are open\n", 503, headers={"Retry-After": "10"}
            )
        headers = {"Cache-Control": "no-store", "X-Accel-Buffering": "no"}
        return StreamingResponse(stream, media_type="text/event-stream", headers=headers)

    async def overlay(self, _: Request) -> Response:
        """Return the cells of the additional map that is drawn over the live map, such as the true
        friction of a simulation; null if there is none.
        """
        return JSONResponse(await run_in_threadpool(overlay.read_overlay, self._of.overlay))

    async def roads(self, _: Request) -> Response:
        """Return the road lines along which the page draws coloured ribbons of friction. They come
        from the operator's file, or are derived from the cells.
        """
        if self._of.roads is not None:
            return JSONResponse(self._of.roads.as_json() | {"learned": False})
        lines = await run_in_threadpool(lambda: learned_lines(*self._of.world.places()))
        return JSONResponse(RoadMap(lines, []).as_json() | {"learned": True})

    async def areas(self, _: Request) -> Response:
        """Return the areas of the map that have cells, those with the most alerts first."""
        named = self._of.roads.places if self._of.roads is not None else []
        return JSONResponse(await run_in_threadpool(areas.found_in, self._of.world, named))

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
