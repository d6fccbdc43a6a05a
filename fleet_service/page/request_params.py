"""Parsing of parameters in requests from browsers. Every parameter is checked, because a request
may be malicious.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Final

from starlette.requests import Request

from fleet_service.page.features import FEW, MOST, Box, FeatureQuestion
from fleet_service.page.records import CELL_LEVEL, LEAST_LEVEL
from fleet_service.page.watchers import View
from schemas import grid, query
from schemas.config import to_nanoseconds
from schemas.errors import InputError

MOST_TILES: Final = 256  # largest number of tiles in one request
_OF_FEATURES: Final = ("bbox", "datetime", "limit", "after", "f")
WORLD: Final = (-180.0, -90.0, 180.0, 90.0)


def parse_moment(request: Request) -> int | None:
    """Return the parameter `at` of a request, a time [s since 1970]; None if absent, which means
    now.
    """
    return _parse_number(request, "at", 0, 1 << 33) if "at" in request.query_params else None


def parse_level(request: Request) -> int:
    """Return the parameter `level` of a request: the zoom of the records (cells), 14 to 21."""
    return (
        _parse_number(request, "level", LEAST_LEVEL, CELL_LEVEL)
        if "level" in request.query_params
        else CELL_LEVEL
    )


def parse_tiles(request: Request) -> list[int]:
    """Return the parameter `tiles` of a request as quadints (numbers) of zoom 14; at most
    MOST_TILES are allowed.
    """
    words = request.query_params.get("tiles", "").split(",")
    if len(words) > MOST_TILES:
        raise InputError("tiles", f"are {len(words)}", f"request at most {MOST_TILES} at once")
    return [_parse_whole("tiles", word, 0, 4**grid.TILE_ZOOM - 1) for word in words if word]


def parse_view(request: Request) -> View:
    """Return the part of the map that a browser shows, from the parameters of its request: box and
    zoom level.
    """
    text = request.query_params.get("bbox")
    box = WORLD if text is None else query.parse({"bbox": text}).bbox or WORLD
    return View(box, parse_level(request))


def parse_features(request: Request, now: int) -> FeatureQuestion:
    """Return the query for features that a request contains; `now` is the time [ns].

    Raises:
        InputError: a parameter is unknown or not valid.
    """
    parameters = request.query_params
    if unknown := [name for name in parameters if name not in _OF_FEATURES]:
        raise InputError(unknown[0][:40], "is not a parameter", f"use {', '.join(_OF_FEATURES)}")
    boxes = _parse_boxes(parameters["bbox"]) if "bbox" in parameters else (None,)
    since, at = _parse_interval(parameters.get("datetime", "../.."), now)
    limit = _parse_whole("limit", parameters["limit"], 1, 1 << 31) if "limit" in parameters else FEW
    after = parse_feature_id(parameters["after"]) if "after" in parameters else -1
    return FeatureQuestion(boxes, since, at, min(limit, MOST), after)


def _parse_boxes(text: str) -> tuple[Box, ...]:
    """Return the boxes that the parameter `bbox` of a query for features covers: west, south, east,
    north [deg]. Heights, the third and the sixth of six numbers, are ignored.

    A box whose west is larger than its east crosses the 180° meridian (OGC 17-069r4, 7.15.3). It is
    divided there into two boxes.
    """
    sides = text.split(",")
    if len(sides) == 6:
        sides = sides[:2] + sides[3:5]
    try:
        crosses = len(sides) == 4 and float(sides[0]) > float(sides[2])
    except ValueError:
        crosses = False  # the parser below states the error
    if not crosses:
        box = query.parse({"bbox": ",".join(sides)}).bbox
        return () if box is None else (box,)
    west, south, east, north = sides
    halves = ((west, south, "180", north), ("-180", south, east, north))
    wide = [half for half in halves if float(half[0]) != float(half[2])]
    return tuple(box for half in wide if (box := query.parse({"bbox": ",".join(half)}).bbox))


def parse_feature_id(text: str) -> int:
    """Return the key (cell · 4 + sector) from the id of a feature (map cell with heading)."""
    cell, _, sector = text.partition("-")
    found = _parse_whole("feature", cell, 0, 4**grid.CELL_ZOOM - 1) * grid.SECTORS
    return found + _parse_whole("feature", sector, 0, grid.SECTORS - 1)


def _parse_interval(text: str, now: int) -> tuple[int, int | None]:
    """Parse a time parameter. Return the time [ns] from which observations are selected, and the
    time [ns] of the requested map (None for now).

    The text is an instant or an interval in the notation of RFC 3339. An interval gives both times;
    one side may be open (`..` or nothing). An instant gives only the time of the map.
    """
    first, is_interval, last = text.partition("/")
    begin = _parse_instant(first)
    end = _parse_instant(last if is_interval else first)
    if begin is None and end is None and not is_interval:
        raise InputError(
            "datetime",
            f"{text[:40]!r} is not a time",
            "give 2026-01-31T07:00:00Z, or two with / between",
        )
    if begin is not None and end is not None and begin > end:
        raise InputError("datetime", "ends before it begins", "give the earlier time first")
    since = begin if begin is not None and is_interval else 0
    at = end if end is not None and end < now else None
    return since, at


def _parse_instant(text: str) -> int | None:
    if text in ("", ".."):
        return None
    try:
        found = query.parse({"at": text}).at
    except InputError as error:
        raise InputError(
            "datetime", error.problem, "give 2026-01-31T07:00:00Z, or two with / between"
        ) from error
    return None if found is None else to_nanoseconds(found)


def parse_place(request: Request) -> tuple[int, int]:
    """Return the cell and the heading sector that the path of a request names."""
    cell = _parse_whole("cell", request.path_params["cell"], 0, 4**grid.CELL_ZOOM - 1)
    return cell, _parse_whole("sector", request.path_params["sector"], 0, grid.SECTORS - 1)


def parse_route(request: Request) -> tuple[list[tuple[float, float]], str]:
    """Return the points (longitude, latitude) [deg] of the route in a request, and the same points
    as text.
    """
    text = request.query_params.get("points", "")
    found = query.parse({"route": text}).route
    return list(found or ()), text


def _parse_number(request: Request, name: str, least: int, most: int) -> int:
    return _parse_whole(name, request.query_params[name], least, most)


def _parse_whole(name: str, text: str, least: int, most: int) -> int:
    reading: Callable[[str], int] = int
    try:
        found = reading(text)
    except ValueError as error:
        raise InputError(
            name, f"{text[:40]!r} is not a whole number", f"give {least} to {most}"
        ) from error
    if not least <= found <= most:
        raise InputError(name, f"{text[:40]} is out of range", f"give {least} to {most}")
    return found
