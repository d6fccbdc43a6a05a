"""Data sources of the page's HTTP routes."""

from __future__ import annotations

from collections.abc import Awaitable, Callable
from pathlib import Path
from typing import NamedTuple

from starlette.requests import Request
from starlette.responses import Response

from fleet_service.client.datex_feed import DatexFile
from fleet_service.page.basemap import BaseMap
from fleet_service.page.health import ServiceHealth
from fleet_service.page.map_mirror import MapMirror
from fleet_service.page.moments import Moments
from fleet_service.page.reader import Reader
from fleet_service.page.roads import RoadMap
from fleet_service.page.watchers import Watchers

Handlers = dict[str, Callable[[Request], Awaitable[Response]]]  # request handlers by URL path


class Sources(NamedTuple):
    """Data sources from which the HTTP routes of the page take their answers, such as the local
    copy of the map and the Zenoh client.
    """

    world: MapMirror
    reader: Reader
    moments: Moments
    health: ServiceHealth
    watchers: Watchers
    overlay: Path | None = None
    base_map: BaseMap | None = None
    datex: DatexFile | None = None
    roads: RoadMap | None = None
