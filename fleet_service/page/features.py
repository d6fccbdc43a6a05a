"""Documents of OGC API Features, Part 1: Core (OGC 17-069r4), with one collection `grip`: the map's
cells. Pure (no I/O).

A feature is one heading sector in one cell. Its geometry is the quarter of the cell on the side of
the heading. A feature with only a lower bound has no `mu`, and unknown values are null or absent.
The time of a feature is that of its newest observation.
"""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any, Final, NamedTuple

import pyarrow as pa

from schemas import grid, tables

COLLECTION: Final = "grip"
GEOJSON: Final = "application/geo+json"
JSON: Final = "application/json"
SCHEMA_JSON: Final = "application/schema+json"
OPENAPI: Final = "application/vnd.oai.openapi+json;version=3.0"
CRS84: Final = "http://www.opengis.net/def/crs/OGC/1.3/CRS84"
CONFORMANCE: Final = tuple(
    f"http://www.opengis.net/spec/ogcapi-features-1/1.0/conf/{name}" for name in ("core", "geojson")
)
# number of features in an answer: default, and largest
FEW = 1000
MOST = 10_000
TITLE: Final = "Grip of the road, measured by vehicles"
ABOUT: Final = (
    "Peak tyre-road friction per cell of some ten metres and heading, with its 5 % and 95 % "
    "quantiles. basis: "
    "measured, or bound where only a lower bound is known; a bound has no mu. A place that no "
    "vehicle visited has no feature: its grip is unknown, which does not mean dry. datetime: an "
    "instant is the map as it was then; an interval is the map as it was at its end, restricted "
    "to cells observed since its begin."
)
# Columns that are left out, because they repeat the geometry.
_PLACE: Final = ("latitude", "longitude", "west", "south", "east", "north")
COLUMNS: Final = tuple(field for field in tables.MAP_CELL if field.name not in _PLACE)
_TYPES: Final[dict[pa.DataType, dict[str, str]]] = {
    pa.string(): {"type": "string"},
    tables.NS: {"type": "string", "format": "date-time"},
    **{kind: {"type": "number"} for kind in (pa.float32(), pa.float64())},
    **{kind: {"type": "integer"} for kind in (pa.int8(), pa.int32(), pa.int64())},
}
Box = tuple[float, float, float, float]


class FeatureQuestion(NamedTuple):
    """Query for features.

    Attributes:
        boxes: west, south, east, north [deg] of each part of the area; None for everywhere.
        since: minimum time of the newest observation [ns]; 0 for no limit.
        at: time of the map [ns]; None for now.
        limit: maximum number of features.
        after: key (cell · 4 + sector) after which to continue.
    """

    boxes: tuple[Box | None, ...] = (None,)
    since: int = 0
    at: int | None = None
    limit: int = FEW
    after: int = -1


def feature_id(cell: int, sector: int) -> str:
    """Return the id of a feature (one heading in one cell) as text."""
    return f"{cell}-{sector}"


def _make_link(href: str, rel: str, kind: str, title: str) -> dict[str, str]:
    return {"href": href, "rel": rel, "type": kind, "title": title}


def landing_document(base: str) -> dict[str, Any]:
    """Return the landing page of the OGC API as a JSON document; `base` is the web address of this
    server without a final slash.
    """
    return {
        "title": "GripMap",
        "description": ABOUT,
        "links": [
            _make_link(f"{base}/?f=json", "self", JSON, "this document"),
            _make_link(f"{base}/", "alternate", "text/html", "the live page"),
            _make_link(f"{base}/api", "service-desc", OPENAPI, "the definition of this interface"),
            _make_link(f"{base}/conformance", "conformance", JSON, "conformance classes"),
            _make_link(f"{base}/collections", "data", JSON, "the collections"),
        ],
    }


def conformance_document() -> dict[str, Any]:
    """Return the list of the OGC conformance classes of the interface as a JSON document."""
    return {"conformsTo": list(CONFORMANCE)}


def collections_document(base: str, extent: Box | None) -> dict[str, Any]:
    """Return the list of the OGC API's collections, which has one entry, as a JSON document."""
    links = [_make_link(f"{base}/collections", "self", JSON, "this document")]
    return {"links": links, "collections": [collection_document(base, extent)]}


def collection_document(base: str, extent: Box | None) -> dict[str, Any]:
    """Return the description of the collection `grip` (the map's cells) as a JSON document;
    `extent` is the box of all cells, or None if there are none.
    """
    own = f"{base}/collections/{COLLECTION}"
    found: dict[str, Any] = {
        "id": COLLECTION,
        "title": TITLE,
        "description": ABOUT,
        "itemType": "feature",
        "crs": [CRS84],
        "links": [
            _make_link(own, "self", JSON, "this document"),
            _make_link(f"{own}/items", "items", GEOJSON, "the features"),
            _make_link(f"{own}/schema", "describedby", SCHEMA_JSON, "the columns"),
        ],
    }
    if extent is not None:
        found["extent"] = {"spatial": {"bbox": [list(extent)], "crs": CRS84}}
    return found


def feature_schema(base: str) -> dict[str, Any]:
    """Return the JSON Schema of a feature (map cell with its properties). GDAL needs it to know
    that `mu` is a number, even if the first features have no `mu`.
    """
    columns = {
        f.name: {**_TYPES[f.type], "description": f"{f.meaning} [{f.unit}]"} for f in COLUMNS
    }
    return {
        "$schema": "https://json-schema.org/draft/2020-12/schema",
        "$id": f"{base}/collections/{COLLECTION}/schema",
        "type": "object",
        "title": TITLE,
        "properties": {
            "type": {"type": "string"},
            "geometry": {"type": "object"},
            "properties": {"type": "object", "properties": columns},
        },
    }


def api_definition(base: str) -> dict[str, Any]:
    """Return the definition of the OGC API in the format OpenAPI 3.0."""
    query_parameters = (
        _describe_parameter(
            "bbox",
            "query",
            "west, south, east, north [deg]; west > east crosses the 180° meridian; heights, the "
            "third and the sixth of six numbers, are ignored",
            type="array",
            items={"type": "number"},
            minItems=4,
            maxItems=6,
        )
        | {"style": "form", "explode": False},
        _describe_parameter("datetime", "query", "instant or interval, RFC 3339", type="string"),
        _describe_parameter(
            "limit",
            "query",
            "maximum number of features in one answer",
            type="integer",
            minimum=1,
            maximum=MOST,
            default=FEW,
        ),
        _describe_parameter(
            "after",
            "query",
            "id after which the page of results begins; taken from a link",
            type="string",
        ),
    )
    one = _describe_parameter("featureId", "path", "CELL-SECTOR", type="string")
    collection_path = f"/collections/{COLLECTION}"
    return {
        "openapi": "3.0.3",
        "info": {"title": TITLE, "version": "1.0.0", "description": ABOUT},
        "servers": [{"url": base}],
        "paths": {
            "/": _describe_route("landing page"),
            "/conformance": _describe_route("conformance classes"),
            "/collections": _describe_route("the collections"),
            collection_path: _describe_route("the collection"),
            f"{collection_path}/schema": _describe_route("the columns"),
            f"{collection_path}/items": _describe_route("features", *query_parameters),
            f"{collection_path}/items/{{featureId}}": _describe_route("one feature", one),
        },
    }


def _describe_route(summary: str, *parameters: dict[str, Any]) -> dict[str, Any]:
    answers = {
        "200": {"description": "the document"},
        "400": {"description": "the problem and how to correct it"},
    }
    return {"get": {"summary": summary, "parameters": list(parameters), "responses": answers}}


def _describe_parameter(name: str, where: str, about: str, **form: object) -> dict[str, Any]:
    return {
        "name": name,
        "in": where,
        "required": where == "path",
        "description": about,
        "schema": form,
    }


def page_of(
    features: Iterable[dict[str, Any]], has_more: bool, address: str, following: str, stamp: str
) -> dict[str, Any]:
    """Return features (map cells) as one page of an answer (GeoJSON).

    Args:
        features: features with their ids.
        has_more: True if more features follow on a next page.
        address: address of this page.
        following: address of the next page.
        stamp: time of the data, ISO 8601.
    """
    found = list(features)
    links = [_make_link(address, "self", GEOJSON, "this document")]
    if has_more:
        links.append(_make_link(following, "next", GEOJSON, "next page"))
    return {
        "type": "FeatureCollection",
        "timeStamp": stamp,
        "numberReturned": len(found),
        "links": links,
        "features": found,
    }


def with_identity(features: Iterable[dict[str, Any]]) -> Iterable[dict[str, Any]]:
    """Yield the given features (GeoJSON objects, one per cell and heading) with their ids added.
    Properties that repeat the geometry are left out.
    """
    names = {field.name for field in COLUMNS}
    for feature in features:
        properties = {name: value for name, value in feature["properties"].items() if name in names}
        yield {
            **feature,
            "id": feature_id(properties["cell"], properties["sector"]),
            "properties": properties,
        }


def extent_of(tiles: Iterable[int]) -> Box | None:
    """Return the box (west, south, east, north [deg]) that encloses the given map tiles; None if
    there are no tiles.
    """
    sides = [grid.bounds(tile, grid.TILE_ZOOM) for tile in tiles]
    if not sides:
        return None
    west, south, east, north = ([float(one[k]) for one in sides] for k in range(4))
    return min(west), min(south), max(east), max(north)
