"""Zenoh client of the page, with the rights of a reader. It receives tiles and alerts, queries
those that it has missed, and tracks for which regions a service answers.

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
from fleet_service.page.map_mirror import MapMirror, box_of
from schemas import grid, keys, regions, tables, wire
from schemas.config import ZenohSettings
from schemas.errors import InputError, WireError
from schemas.runtime import presence, zenoh_session
from schemas.wire.tile import decode_tile

log = logging.getLogger(__name__)
ROUND_S: Final = 0.5
AGAIN_S: Final = 5.0  # between two questions to a service of which nothing is known
# a tile is put when it changes; that its intervals widen with time must be asked for
REFRESH_S: Final = 60.0
# tiles in a round: 40 a second, 2 400 in the minute; more are renewed more rarely
REFRESHED: Final = 20
REGIONS: Final = 256  # that are watched for a service


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
        self._queriers: dict[int, Any] = {}
        self._away_since: dict[int, float] = {}
        self._names: dict[str, set[str]] = {"alive": set(), "shard": set()}
        self._anything: Any = None
        self._fallen: dict[
            str, float
        ] = {}  # regions whose service said that it serves them, and went: since when
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
                if (
                    served and not self._served
                ):  # at the start, and when a service came back: what was missed
                    self._ask_all(session)
                elif served and time.monotonic() >= self._stood + REFRESH_S:
                    self._ask_standing(session)
                self._served = served
                self._note_fallen(services)
                self._refresh(session)
                if served:
                    self._world.remember(time.time())
                stop.wait(ROUND_S)
            self._session = None

    @property
    def is_connected(self) -> bool:
        """Return True if the page's Zenoh session is connected to a router."""
        session = self._session
        return session is not None and bool(list(session.info.routers_zid()))

    @property
    def is_served(self) -> bool:
        """Return True if a fleet service answers for any region."""
        return self._served and self.is_connected

    def is_heard(self, latitude: float, longitude: float) -> bool:
        """Return True if a service answers for a place [deg]."""
        return self._answers(int(grid.region_of(int(grid.cell_of(latitude, longitude)))))

    def regions(self) -> list[dict[str, Any]]:
        """Return the regions with cells: their box, whether a service answers for them, and, if
        not, since when.
        """
        return [
            {
                "region": grid.quadkey(region, grid.REGION_ZOOM),
                "box": box_of(region, grid.REGION_ZOOM),
                "served": region not in self._away_since,
                "since": self._away_since.get(region),
            }
            for region in list(self._queriers)
        ] + [
            {"region": region, "box": _box_of_expression(region), "served": False, "since": since}
            for region, since in self._fallen.copy().items()
        ]

    def _note_fallen(self, services: presence.PresenceTracker) -> None:
        """Record regions that no service announces any more and of which the page knows no cells.
        Regions with known cells need no record, because queries about these cells show if a service
        answers.
        """
        here = {token.region for token in services.active}
        known = [keys.chunks(region, grid.REGION_ZOOM) for region in self._queriers]
        fallen = {
            token.region
            for token in services.lost_tokens
            if token.region.startswith(tuple("0123"))
            and not any(regions.covers(one, token.region) for one in here)
            and not any(regions.overlap(one, token.region) for one in known)
        }
        self._fallen = {region: self._fallen.get(region, time.time()) for region in fallen}

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
            self._world.take_alert(wire.decode_alert(sample.payload.to_bytes()), time.time())

    def _token(self, sample: zenoh.Sample) -> None:
        with _refusals_logged(sample):
            parsed = keys.parse(str(sample.key_expr))
            names = self._names[parsed.topic.name]
            (names.add if sample.kind == zenoh.SampleKind.PUT else names.discard)(str(parsed.name))

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
        self._world.take_standing(
            standing, lambda cell: self._answers(int(grid.region_of(cell))), time.time()
        )

    def _refresh(self, session: zenoh.Session) -> None:
        for region in {
            int(grid.parent(tile, grid.REGION_ZOOM, grid.TILE_ZOOM)) for tile in self._world.tiles()
        }:
            if region not in self._queriers and len(self._queriers) < REGIONS:
                expression = f"{keys.ROOT}/map/{keys.chunks(region, grid.REGION_ZOOM)}/*"
                self._queriers[region] = session.declare_querier(expression)
        for region, querier in self._queriers.items():
            if querier.matching_status.matching:
                self._away_since.pop(region, None)
            else:
                self._away_since.setdefault(region, time.time())
        now = time.time()
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
            if self._answers(int(grid.parent(tile, grid.REGION_ZOOM, grid.TILE_ZOOM))):
                self._world.take_tile(
                    tile, tables.MAP_SCHEMA.empty_table(), now
                )  # fewer vehicles than are shown
            else:
                self._world.touch(tile, now)

    def _answers(self, region: int) -> bool:
        querier = self._queriers.get(region)
        return querier is not None and bool(querier.matching_status.matching)

    def _sees_services(self) -> bool:
        """Return True if a service answers for any place. A service's token shows this; if tokens
        are hidden, its answers show it.

        A router matches only services that answer for all of a key expression. Therefore a service
        of the whole world is found by any tile, and a service of a region by a region already
        known. Before any region is known, only a reply to a query shows a service.
        """
        if self._names["shard"] or any(self._answers(region) for region in self._queriers):
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


def _box_of_expression(region: str) -> list[float]:
    """Return west, south, east, north [deg] of the square that the leading digits of a region
    expression name.
    """
    digits = region.partition("*")[0].replace("/", "")
    return box_of(grid.from_quadkey(digits), len(digits))


@contextlib.contextmanager
def _refusals_logged(sample: zenoh.Sample) -> Iterator[None]:
    """Provide a context that logs an error which a malformed message causes, and suppresses the
    error.
    """
    try:
        yield
    except (InputError, WireError, KeyError) as error:
        log.warning("%s: %s", sample.key_expr, error)
