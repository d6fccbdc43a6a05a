"""Zenoh client of the page, with the rights of a reader. It receives changes of tiles and alerts,
and queries those that it has missed.

It publishes nothing. If the access list hides liveliness tokens, it works without them.
"""

from __future__ import annotations

import contextlib
import logging
import threading
import time
from collections.abc import Iterator, Mapping
from typing import Any, Final

import pyarrow as pa
import zenoh

from fleet_service.client import map_client
from fleet_service.client.watching import standing_alerts
from fleet_service.page.map_mirror import MapMirror
from fleet_service.page.served_regions import ServedRegions
from schemas import grid, keys, tables, wire
from schemas.config import ZenohSettings
from schemas.errors import InputError, WireError
from schemas.runtime import presence, zenoh_session
from schemas.wire.tile import decode_tile

log = logging.getLogger(__name__)
ROUND_S: Final = 0.5
AGAIN_S: Final = 5.0  # [s] period of attempts to query the map while no service is known
# [s] Period in which tiles are queried again. Services publish a tile only after a change, but the
# intervals of unchanged cells become wider with time.
REFRESH_S: Final = 60.0
# Number of tiles per round of ROUND_S: 2,400 per minute. With more tiles, the period is longer.
REFRESHED: Final = 20


class Reader:
    """Zenoh session of the live page.

    Args:
        connection: connection settings for the router.
        world: mirrored map, which receives the data.
    """

    def __init__(self, connection: ZenohSettings, world: MapMirror) -> None:
        self._connection = connection
        self._world = world
        self._session: zenoh.Session | None = None
        self._regions = ServedRegions()
        self._names: dict[str, set[str]] = {"alive": set(), "shard": set()}
        self._anything: Any = None
        self._served = False
        self._stood = 0.0
        self._tried = -AGAIN_S

    def run(self, stop: threading.Event) -> None:
        """Receive map tiles and alerts over Zenoh until `stop` is set."""
        session = zenoh_session.open_session(self._connection, stop)
        if session is None:
            return
        with session, presence.track_tokens(session) as services:
            self._session = session
            session.declare_subscriber(map_client.EVERYWHERE, self._tile)
            session.declare_subscriber(f"{keys.ROOT}/alert/**", self._alert)
            for kind in self._names:
                session.liveliness().declare_subscriber(
                    f"{keys.ROOT}/{kind}/*", self._token, history=True
                )
            while not stop.is_set():
                served = bool(self._sees_services())
                # At the start, and after a service has returned, query everything.
                if served and not self._served:
                    self._ask_all(session)
                elif served and time.monotonic() >= self._stood + REFRESH_S:
                    self._ask_standing(session)
                self._served = served
                self._regions.note_fallen(services, time.time())
                self._refresh(session)
                if served:
                    self._world.remember(time.time())
                stop.wait(ROUND_S)
            self._session = None

    @property
    def is_connected(self) -> bool:
        """Return True if the page's Zenoh session is connected to a router."""
        session = self._session
        return session is not None and bool(zenoh_session.connected_routers(session))

    @property
    def is_served(self) -> bool:
        """Return True if a fleet service answers for any region."""
        return self._served and self.is_connected

    def has_service(self, latitude: float, longitude: float) -> bool:
        """Return True if a fleet service answers for the place at this latitude and longitude
        [deg].
        """
        return self._regions.is_answered(
            int(grid.region_of(int(grid.cell_of(latitude, longitude))))
        )

    def regions(self) -> list[dict[str, Any]]:
        """Return each region of the map: its box, True if a service answers for it, and otherwise
        the time [s since 1970] since which no service answers.
        """
        return self._regions.as_json()

    def names(self, kind: str) -> list[str]:
        """Return the names that have a Zenoh liveliness token (sign of a connected process) of the
        given kind; empty if the access list hides the tokens.
        """
        return sorted(self._names[kind])

    def ask(self, selector: str, parameters: Mapping[str, str]) -> Iterator[tuple[int, pa.Table]]:
        """Yield the tile number and the cells of every reply to a query.

        Raises:
            InputError: a service refused the query, or no router is connected.
        """
        session = self._session
        if session is None:
            raise InputError("connect", "no router answers", "start one, or correct --connect")
        for key, payload in map_client.query_replies(session, selector, parameters):
            tile = keys.parse(key).quadint
            if tile is not None:
                yield tile, decode_tile(payload)

    def _tile(self, sample: zenoh.Sample) -> None:
        with _refusals_logged(sample):
            tile = keys.parse(str(sample.key_expr)).quadint
            if tile is not None:
                self._world.take_tile(tile, decode_tile(sample.payload.to_bytes()), time.time())

    def _alert(self, sample: zenoh.Sample) -> None:
        with _refusals_logged(sample):
            self._world.alerts.take_alert(wire.decode_alert(sample.payload.to_bytes()), time.time())

    def _token(self, sample: zenoh.Sample) -> None:
        with _refusals_logged(sample):
            parsed = keys.parse(str(sample.key_expr))
            names = self._names[parsed.topic.name]
            if sample.kind == zenoh.SampleKind.PUT:
                names.add(str(parsed.name))
            else:
                names.discard(str(parsed.name))

    def _ask_all(self, session: zenoh.Session) -> None:
        """Query all tiles and alerts that existed before this session. The subscription to changes
        has begun before this query, so no change is missed.
        """
        try:
            for tile, table in self.ask(map_client.EVERYWHERE, {}):
                self._world.take_tile(tile, table, time.time())
        except (InputError, WireError) as error:
            log.warning("the map could not be read: %s", error)
        self._ask_standing(session)

    def _ask_standing(self, session: zenoh.Session) -> None:
        self._stood = time.monotonic()
        standing = standing_alerts(session)
        self._world.alerts.take_standing(
            standing, lambda cell: self._regions.is_answered(int(grid.region_of(cell))), time.time()
        )

    def _refresh(self, session: zenoh.Session) -> None:
        now = time.time()
        self._regions.watch(session, self._world.tiles(), now)
        for tile in self._world.oldest(now - REFRESH_S, REFRESHED):
            found = False
            try:
                for answered, table in self.ask(keys.map_key(tile), {}):
                    self._world.take_tile(answered, table, now)
                    found = True
            except (InputError, WireError) as error:
                log.warning("a tile could not be read: %s", error)
            if found:
                continue
            if self._regions.is_answered(int(grid.parent(tile, grid.REGION_ZOOM, grid.TILE_ZOOM))):
                # The service has no cells for readers, for example because of too few vehicles.
                self._world.take_tile(tile, tables.MAP_SCHEMA.empty_table(), now)
            else:
                self._world.touch(tile, now)

    def _sees_services(self) -> bool:
        """Return True if at least one fleet service is connected, no matter which region it serves.
        The Zenoh liveliness token of a service shows this.

        If the access list hides tokens, the page asks the router which queries a service could
        answer. The router reports only services that can answer all keys of a query. A service of
        the whole world is found by a query for any tile. A service of some regions is found only by
        a query for one of its regions, which the page must already know. While the page knows no
        tile, it queries the whole map instead, and any reply shows a service.
        """
        if self._names["shard"] or self._regions.is_any_answered:
            return True
        session = self._session
        if session is None or not self.is_connected:
            return False
        if self._anything is None:
            self._anything = session.declare_querier(f"{keys.ROOT}/map/*/*/*/*")
        if self._anything.matching_status.matching:
            return True
        if self._world.tiles() or time.monotonic() < self._tried + AGAIN_S:
            return False
        self._tried = time.monotonic()
        with contextlib.suppress(InputError):
            return any(True for _ in map_client.query_replies(session, map_client.EVERYWHERE, {}))
        return False


@contextlib.contextmanager
def _refusals_logged(sample: zenoh.Sample) -> Iterator[None]:
    """Provide a context that logs an error which a malformed message causes, and suppresses the
    error.
    """
    try:
        yield
    except (InputError, WireError, KeyError) as error:
        log.warning("%s: %s", sample.key_expr, error)
