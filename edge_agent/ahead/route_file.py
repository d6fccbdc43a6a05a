"""Reader of route files: GPX (track, route or waypoints) and GeoJSON (a LineString, or an object
that contains one).

XML is parsed as a stream of events. A document with a document type declaration is rejected before
any of its entities is expanded, because a hostile file could expand them without limit.
"""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any, Final
from xml.parsers import expat

import numpy as np

from edge_agent.ahead.path import GivenRoute
from schemas.errors import InputError
from schemas.grid import MAX_LATITUDE

MOST_POINTS: Final = 100_000
MOST_BYTES: Final = 32 << 20
_POINTS: Final = ("trkpt", "rtept", "wpt")  # kinds of points in a GPX file, in order of preference


def read_route(path: Path) -> GivenRoute:
    """Return the route in a .gpx, .geojson or .json file.

    Raises:
        InputError: the file cannot be read, or contains no line of at least two valid points.
    """
    try:
        data = path.read_bytes()
    except OSError as error:
        raise InputError(
            "route", f"cannot read {path} ({error.strerror})", "give a GPX or GeoJSON file"
        ) from error
    if len(data) > MOST_BYTES:
        raise InputError("route", f"{path} has {len(data)} bytes", f"give at most {MOST_BYTES}")
    points = (
        _parse_gpx(data)
        if data.lstrip().startswith((b"<", b"\xef\xbb\xbf<"))
        else _parse_geojson(data)
    )
    return route_of(points)


def route_of(points: list[tuple[float, float]]) -> GivenRoute:
    """Return the route through a list of points, each (latitude, longitude) [deg].

    Raises:
        InputError: there are too few or too many points, or a point is out of range.
    """
    if not 2 <= len(points) <= MOST_POINTS:
        raise InputError(
            "route", f"has {len(points)} points", f"give a line of 2 to {MOST_POINTS} points"
        )
    place = np.array(points, dtype=np.float64)
    if not (
        np.isfinite(place).all()
        and (np.abs(place[:, 0]) <= MAX_LATITUDE).all()
        and (np.abs(place[:, 1]) <= 180.0).all()
    ):
        raise InputError("route", "has coordinates out of range", "give degrees of WGS 84")
    if not (np.abs(np.diff(place, axis=0)).sum(axis=1) > 0.0).any():
        raise InputError("route", "stays at one point", "give a line with two different points")
    return GivenRoute(place[:, 0], place[:, 1])


def _parse_gpx(data: bytes) -> list[tuple[float, float]]:
    found: dict[str, list[tuple[float, float]]] = {name: [] for name in _POINTS}

    def refuse_doctype(*_: object) -> None:
        raise InputError("route", "declares a document type", "give plain GPX")

    def read_point(name: str, attributes: dict[str, str]) -> None:
        kind = name.rpartition(":")[2]
        if kind in found:
            try:
                found[kind].append((float(attributes["lat"]), float(attributes["lon"])))
            except (KeyError, ValueError) as error:
                raise InputError(
                    "route", f"has a {kind} without a position", "give lat and lon in degrees"
                ) from error

    parser = expat.ParserCreate()
    parser.StartDoctypeDeclHandler = refuse_doctype
    parser.EntityDeclHandler = refuse_doctype
    parser.StartElementHandler = read_point
    try:
        parser.Parse(data, True)
    except expat.ExpatError as error:
        raise InputError("route", f"is not valid XML ({error})", "give a GPX file") from error
    return next((points for points in found.values() if len(points) >= 2), [])


def _parse_geojson(data: bytes) -> list[tuple[float, float]]:
    try:
        line = _find_line(json.loads(data))
        return [(float(point[1]), float(point[0])) for point in line]
    except (ValueError, TypeError, IndexError, KeyError, AttributeError, RecursionError) as error:
        raise InputError(
            "route", f"is neither GPX nor GeoJSON ({type(error).__name__})", "give a LineString"
        ) from error


def _find_line(document: Any) -> list[Any]:  # noqa: ANN401 any JSON value
    """Return the coordinates of the first LineString in a GeoJSON document."""
    kind = document["type"]
    if kind == "LineString":
        return list(document["coordinates"])
    if kind == "MultiLineString":
        return [point for part in document["coordinates"] for point in part]
    if kind == "Feature":
        return _find_line(document["geometry"])
    if kind == "FeatureCollection":
        return next(
            (found for feature in document["features"] if (found := _find_line(feature))), []
        )
    return []
