"""The map asked by a program, in one line."""

from __future__ import annotations

from datetime import datetime
from typing import Any

import pyarrow as pa

from fleet_service.client import map_client
from schemas.config import ZenohSettings


def ask_map(
    endpoint: str | ZenohSettings,
    *,
    bbox: tuple[float, float, float, float] | None = None,
    route: list[tuple[float, float]] | None = None,
    min_vehicles: int = 1,
    at: datetime | None = None,
) -> pa.Table:
    """The cells of the map, a row per cell and heading sector, as schemas.tables.MAP_CELL has them.

    Args:
        endpoint: of a router, e.g. tcp/127.0.0.1:7447; or settings with certificates.
        bbox: west, south, east, north [deg].
        route: longitude, latitude [deg] of points; the cells ahead in their order.
        min_vehicles: only cells of so many vehicles or more.
        at: the map as it was; without a zone it is UTC.

    Raises:
        InputError: the query is refused, no router answers, or no service does.
    """
    settings = ZenohSettings(connect=[endpoint]) if isinstance(endpoint, str) else endpoint
    asked: dict[str, Any] = {"min_vehicles": str(min_vehicles)}
    if bbox is not None:
        asked["bbox"] = ",".join(map(str, bbox))
    if route is not None:
        asked["route"] = "|".join(f"{longitude},{latitude}" for longitude, latitude in route)
    if at is not None:
        asked["at"] = at.isoformat()
    return map_client.served_table(map_client.ask(settings, asked))
