"""HTTP routes of the page itself: its files, texts and settings, the base map, and health."""

from __future__ import annotations

from pathlib import Path
from typing import Final

from starlette.concurrency import run_in_threadpool
from starlette.requests import Request
from starlette.responses import JSONResponse, PlainTextResponse, Response

from fleet_service.page import colours, ogc, records, route
from fleet_service.page.files import Files
from fleet_service.page.ogc import FeatureRoutes
from fleet_service.page.sources import Handlers, Sources
from schemas.thresholds import REACTION_S

STATIC: Final = Path(__file__).with_name("static")


class SiteRoutes:
    """Request handlers for all routes that do not depend on the map: files, texts, settings, base
    map, health.
    """

    def __init__(self, sources: Sources, features: FeatureRoutes) -> None:
        self._of = sources
        self._features = features
        self._files = Files(STATIC)

    def paths(self) -> Handlers:
        """Return the request handlers by URL path."""
        return {
            "/": self.index,
            "/static/{name}": self.file,
            "/settings": self.settings,
            "/texts": self.texts,
            "/health": self.health,
            "/base/{z:int}/{x:int}/{y:int}": self.picture,
        }

    async def index(self, request: Request) -> Response:
        """Return the live page. A program gets the landing page of OGC API Features instead."""
        if ogc.wants_json(request):
            return await self._features.landing(request)
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
        """Return, as JSON, the constants and colours that the page's scripts need."""
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

    async def health(self, _: Request) -> Response:
        """Return, as JSON, the metrics of the fleet services and the state of this page:
        connection, browsers and requests.
        """
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
