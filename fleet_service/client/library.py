"""Query of the live map from a Python program."""

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
    """Return the cells of the map, one row per cell and heading sector, with the columns of
    schemas.tables.MAP_CELL.

    Args:
        endpoint: address of a router, e.g. tcp/127.0.0.1:7447; or connection settings with
            certificates.
        bbox: west, south, east, north [deg].
        route: points (longitude, latitude) [deg]; the result has the cells along the route in
            driving order.
        min_vehicles: minimum number of vehicles that have visited a cell.
        at: moment of the map; without a zone it is UTC.

    Raises:
        InputError: the query is refused, or no router or no service answers.
    """
    settings = ZenohSettings(connect=[endpoint]) if isinstance(endpoint, str) else endpoint
    parameters: dict[str, Any] = {"min_vehicles": str(min_vehicles)}
    if bbox is not None:
        parameters["bbox"] = ",".join(map(str, bbox))
    if route is not None:
        parameters["route"] = "|".join(f"{longitude},{latitude}" for longitude, latitude in route)
    if at is not None:
        parameters["at"] = at.isoformat()
    return map_client.served_table(map_client.query_map(settings, parameters))
