"""What browsers ask with: every parameter read as if a stranger had written it."""

from __future__ import annotations

from collections.abc import Callable
from typing import Final

from starlette.requests import Request

from fleet_service.page.records import CELL_LEVEL, LEAST_LEVEL
from fleet_service.page.watchers import View
from schemas import grid, query
from schemas.errors import InputError

MOST_TILES: Final = 256  # in one question
WORLD: Final = (-180.0, -90.0, 180.0, 90.0)


def moment(request: Request) -> int | None:
    """`at` [s since 1970]; None: now."""
    return _number(request, "at", 0, 1 << 33) if "at" in request.query_params else None


def level(request: Request) -> int:
    """Zoom of the places, 14 to 21."""
    return _number(request, "level", LEAST_LEVEL, CELL_LEVEL) if "level" in request.query_params else CELL_LEVEL


def tiles(request: Request) -> list[int]:
    """z14 quadints, some hundred at the most."""
    words = request.query_params.get("tiles", "").split(",")
    if len(words) > MOST_TILES:
        raise InputError("tiles", f"are {len(words)}", f"ask for {MOST_TILES} at once")
    return [_whole("tiles", word, 0, 4**grid.TILE_ZOOM - 1) for word in words if word]


def view(request: Request) -> View:
    """What a watcher looks at."""
    text = request.query_params.get("bbox")
    box = WORLD if text is None else query.parse({"bbox": text}).bbox or WORLD
    return View(box, level(request))


def place(request: Request) -> tuple[int, int]:
    """Cell and sector."""
    cell = _whole("cell", request.path_params["cell"], 0, 4**grid.CELL_ZOOM - 1)
    return cell, _whole("sector", request.path_params["sector"], 0, grid.SECTORS - 1)


def route(request: Request) -> tuple[list[tuple[float, float]], str]:
    """Points (longitude, latitude) of a route, and their text."""
    text = request.query_params.get("points", "")
    found = query.parse({"route": text}).route
    return list(found or ()), text


def _number(request: Request, name: str, least: int, most: int) -> int:
    return _whole(name, request.query_params[name], least, most)


def _whole(name: str, text: str, least: int, most: int) -> int:
    reading: Callable[[str], int] = int
    try:
        found = reading(text)
    except ValueError as error:
        raise InputError(name, f"{text[:40]!r} is no whole number", f"give {least} to {most}") from error
    if not least <= found <= most:
        raise InputError(name, f"{text[:40]} is out of range", f"give {least} to {most}")
    return found
