"""HTTP routes of OGC API Features, which make the map available to QGIS, ArcGIS and GDAL."""

from __future__ import annotations

import time
from collections.abc import Awaitable, Callable, Iterator
from datetime import UTC, datetime
from typing import Final
from urllib.parse import urlencode

import numpy as np
import pyarrow as pa
from starlette.concurrency import run_in_threadpool
from starlette.requests import Request
from starlette.responses import JSONResponse, PlainTextResponse, Response

from fleet_service.archive.export import extract
from fleet_service.archive.format import geo
from fleet_service.client import map_client
from fleet_service.page import features, request_params
from fleet_service.page.features import COLLECTION, GEOJSON, FeatureQuestion
from fleet_service.page.map_mirror import MapMirror
from fleet_service.page.reader import Reader
from fleet_service.page.turns import PastTurns, TooManyQuestionsError
from schemas import grid, keys
from schemas.tables import MAP_SCHEMA
from schemas.thresholds import NS

_OWN: Final = f"/collections/{COLLECTION}"


class FeatureRoutes:
    """Request handlers of OGC API Features, one method per route.

    Args:
        world: mirrored map, which knows the tiles that have cells now.
        reader: client that queries cells.
    """

    def __init__(self, world: MapMirror, reader: Reader) -> None:
        self._world = world
        self._reader = reader
        self._turns = PastTurns()

    def paths(self) -> dict[str, Callable[[Request], Awaitable[Response]]]:
        """Return the request handlers of the OGC API by URL path."""
        return {
            "/conformance": self.conformance,
            "/collections": self.collections,
            _OWN: self.collection,
            "/api": self.api,
            f"{_OWN}/schema": self.schema,
            f"{_OWN}/items": self.items,
            f"{_OWN}/items/{{feature}}": self.item,
        }

    async def landing(self, request: Request) -> Response:
        """Return the landing page of the OGC API, which lists its addresses for programs."""
        return JSONResponse(
            features.landing_document(_base_address(request)), headers={"Vary": "Accept"}
        )

    async def conformance(self, _: Request) -> Response:
        """Return the list of conformance classes of the OGC API."""
        return JSONResponse(features.conformance_document())

    async def collections(self, request: Request) -> Response:
        """Return the list of the OGC API's collections, which contains only `grip` (the cells of
        the map).
        """
        return JSONResponse(features.collections_document(_base_address(request), self._extent()))

    async def collection(self, request: Request) -> Response:
        """Return the description of the collection `grip`, the cells of the map."""
        return JSONResponse(features.collection_document(_base_address(request), self._extent()))

    async def schema(self, request: Request) -> Response:
        """Return a JSON Schema of the properties of a feature (one heading sector of a cell)."""
        return JSONResponse(
            features.feature_schema(_base_address(request)), media_type=features.SCHEMA_JSON
        )

    async def api(self, request: Request) -> Response:
        """Return the definition of the OGC API in the format OpenAPI."""
        return JSONResponse(
            features.api_definition(_base_address(request)), media_type=features.OPENAPI
        )

    async def items(self, request: Request) -> Response:
        """Return features (one heading sector of one cell each), ordered by key (cell · 4 +
        sector), from the key `after` on. The link `next` continues after the last key, even if
        features change meanwhile.
        """
        question = request_params.parse_features(request, time.time_ns())
        if not self._reader.is_served:
            message = "no service answers for the map; this is not the same as an empty map\n"
            return PlainTextResponse(message, 503, headers={"Retry-After": "10"})
        if question.at is None:
            return await run_in_threadpool(self._items, request, question)
        try:
            async with self._turns.take(request.client.host if request.client else ""):
                return await run_in_threadpool(self._items, request, question)
        except TooManyQuestionsError:
            message = "this client already has other queries about the past waiting\n"
            return PlainTextResponse(message, 429, headers={"Retry-After": "5"})

    def _items(self, request: Request, question: FeatureQuestion) -> Response:
        table = self._cells(question)
        has_more = table.num_rows > question.limit
        table = table.slice(0, question.limit)
        address = f"{_base_address(request)}{_OWN}/items"
        last = ""
        if table.num_rows:
            last = features.feature_id(table["cell"][-1].as_py(), table["sector"][-1].as_py())
        parameters = {
            name: value for name, value in request.query_params.items() if name != "after"
        }
        stamp = (
            datetime.fromtimestamp((question.at or time.time_ns()) / NS, UTC)
            .isoformat()
            .replace("+00:00", "Z")
        )
        answer = features.page_of(
            features.with_identity(extract.geojson_features(geo.with_cells(table))),
            has_more,
            str(request.url),
            f"{address}?{urlencode(parameters | {'after': last})}",
            stamp,
        )
        return JSONResponse(answer, media_type=GEOJSON, headers={"Cache-Control": "no-store"})

    async def item(self, request: Request) -> Response:
        """Return the feature (one heading in one cell) whose id the request names, with its present
        values.
        """
        place = request_params.parse_feature_id(request.path_params["feature"])
        table = await run_in_threadpool(
            self._cells, FeatureQuestion((_place_box(place),), after=place - 1, limit=1)
        )
        cell, sector = divmod(place, grid.SECTORS)
        table = table.filter(
            (pa.compute.field("cell") == cell) & (pa.compute.field("sector") == sector)
        )
        for found in features.with_identity(extract.geojson_features(geo.with_cells(table))):
            links = [
                {
                    "href": f"{_base_address(request)}{_OWN}",
                    "rel": "collection",
                    "type": features.JSON,
                }
            ]
            return JSONResponse({**found, "links": links}, media_type=GEOJSON)
        return PlainTextResponse("no vehicle has visited this place: its grip is unknown\n", 404)

    def _cells(self, question: FeatureQuestion) -> pa.Table:
        """Return the requested cells, ordered by key (cell · 4 + sector). If there are more cells
        than the limit, one additional row is returned, which shows that a next page exists.

        Raises:
            InputError: a service refused the query.
        """
        found = [MAP_SCHEMA.empty_table()]
        rows = 0
        for table in self._tiles(question):
            place = table["cell"].to_numpy() * grid.SECTORS + table["sector"].to_numpy()
            newest = table["last_time"].cast(pa.int64()).to_numpy()
            _, order = np.unique(place, return_index=True)  # two boxes may share cells
            order = order[(place[order] > question.after) & (newest[order] >= question.since)]
            found.append(table.take(order))
            rows += len(order)
            if rows > question.limit:
                break
        return pa.concat_tables(found).slice(0, question.limit + 1)

    def _tiles(self, question: FeatureQuestion) -> Iterator[pa.Table]:
        """Yield the requested map cells as tables, one tile at a time, ordered by tile."""
        if question.at is not None:  # one query for all tiles, so a past map is rebuilt only once
            at = {"at": datetime.fromtimestamp(question.at / NS, UTC).isoformat()}
            parts: dict[int, list[pa.Table]] = {}
            for box in question.boxes:
                for tile, table in self._reader.ask(
                    map_client.EVERYWHERE, at | _box_parameter(box)
                ):
                    parts.setdefault(tile, []).append(table)
            yield from (pa.concat_tables(parts[tile]) for tile in sorted(parts))
            return
        first = int(grid.tile_of(question.after // grid.SECTORS)) if question.after >= 0 else 0
        for tile in sorted(tile for tile in self._world.tiles() if tile >= first):
            area = grid.bounds(tile, grid.TILE_ZOOM)
            tables = [
                table
                for box in question.boxes
                if box is None or bool(grid.touches(box, area))
                for _, table in self._reader.ask(keys.map_key(tile), _box_parameter(box))
            ]
            if tables:
                yield pa.concat_tables(tables)

    def _extent(self) -> features.Box | None:
        return features.extent_of(self._world.tiles())


def wants_json(request: Request) -> bool:
    """Return True if the request comes from a program, which gets the landing page of the OGC API
    instead of the live page.
    """
    form = request.query_params.get("f")
    if form is not None:
        return form == "json"
    accepted = request.headers.get("accept", "*/*")
    return "json" in accepted and "text/html" not in accepted


def _box_parameter(box: features.Box | None) -> dict[str, str]:
    """Return the parameter `bbox` of a map query for a box; without a box, no parameter."""
    return {} if box is None else {"bbox": ",".join(f"{side:.9f}" for side in box)}


def _base_address(request: Request) -> str:
    return str(request.base_url).rstrip("/")


def _place_box(place: int) -> features.Box:
    west, south, east, north = (float(side) for side in grid.bounds(place // grid.SECTORS))
    return west, south, east, north
