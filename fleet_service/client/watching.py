"""Watch for changes of the map: print one line per changed tile, per alert, and per region that
loses or regains its service.
"""

from __future__ import annotations

import json
import threading
import time
from collections.abc import Callable
from queue import SimpleQueue
from typing import Final, NamedTuple

import pyarrow as pa
import zenoh

from fleet_service.client.map_client import TIMEOUT_S
from fleet_service.client.stretches import StretchAlert, Stretches
from schemas import grid, keys, query, regions, wire
from schemas.config import ZenohSettings
from schemas.runtime import presence, zenoh_session
from schemas.wire.tile import decode_tile

GATHER_S: Final = 0.3  # [s] time for which alerts of neighbouring cells are merged
# [s] Period of the queries for all active alerts, and longest time between two DATEX publications.
REFRESH_S: Final = 60.0


class WatchOptions(NamedTuple):
    """Options that select the changes of the map to print.

    Attributes:
        bbox: west,south,east,north as text; None for the whole map.
        only_alerts: True to omit lines for tiles.
        as_json: True to print each line as JSON.
    """

    bbox: str | None = None
    only_alerts: bool = False
    as_json: bool = False


def watch_map(
    connection: ZenohSettings,
    options: WatchOptions,
    stop: threading.Event,
    print_line: Callable[[str], None],
    on_alert: Callable[[StretchAlert], None] = lambda _: None,
) -> None:
    """Print one line per change of the map until `stop` is set. If no router is reachable, wait for
    one.

    `print_line` is called with each line, and `on_alert` with every alert that has changed.

    Raises:
        InputError: the box is not valid.
    """
    watch = _Watch(options, print_line, on_alert)
    session = zenoh_session.open_session(connection, stop)
    if session is None:
        return
    with session, presence.track_tokens(session) as services:
        if not options.only_alerts:
            session.declare_subscriber(f"{keys.ROOT}/map/**", watch.print_tile)
        session.declare_subscriber(f"{keys.ROOT}/alert/**", watch.queue_alert)
        watch.query_alerts(session, services)  # after subscribing, so that no alert is missed
        print_line(json.dumps({"event": "watching"}) if options.as_json else "watching")
        watch.print_services(services)
        looked = time.monotonic()
        while not stop.wait(GATHER_S):
            if time.monotonic() > looked + REFRESH_S:
                watch.query_alerts(session, services)
                looked = time.monotonic()
            watch.print_alerts()
            watch.print_services(services)
        watch.print_alerts()


class _Watch:
    """State of one watch: the active alerts, and the regions without a service. Received messages
    are queued by Zenoh's threads; all other methods are called from one thread.
    """

    def __init__(
        self,
        options: WatchOptions,
        print_line: Callable[[str], None],
        on_alert: Callable[[StretchAlert], None],
    ) -> None:
        self._query = query.parse({} if options.bbox is None else {"bbox": options.bbox})
        self._as_json = options.as_json
        self._print_line = print_line
        self._on_alert = on_alert
        self._stretches = Stretches()
        self._arrived: SimpleQueue[wire.Alert] = SimpleQueue()
        self._unserved = set[str]()

    def _is_near(self, tile: int) -> bool:
        box = self._query.bbox
        return box is None or bool(grid.touches(box, grid.bounds(tile, grid.TILE_ZOOM)))

    def print_tile(self, sample: zenoh.Sample) -> None:
        """Print a line about a changed tile of the map."""
        tile = keys.parse(str(sample.key_expr)).quadint
        if tile is not None and self._is_near(tile):
            table = decode_tile(sample.payload.to_bytes())
            self._print_line(_tile_line(tile, table, self._as_json))

    def queue_alert(self, sample: zenoh.Sample) -> None:
        """Queue a received alert for the next `print_alerts`."""
        tile = keys.parse(str(sample.key_expr)).quadint
        if tile is not None and self._is_near(tile):
            self._arrived.put(wire.decode_alert(sample.payload.to_bytes()))

    def query_alerts(self, session: zenoh.Session, services: presence.PresenceTracker) -> None:
        """Query the active alerts. A known alert ends if the service of its place does not report
        it; the message about its end was then missed.
        """
        before = services.active
        found = standing_alerts(session)
        answering_regions = {token.region for token in before & services.active}

        def has_service(alert: wire.Alert) -> bool:
            region = regions.region_of(int(grid.tile_of(alert.cell)))
            return any(regions.covers(one, region) for one in answering_regions)

        alerts_in_box = (alert for alert in found if self._is_near(int(grid.tile_of(alert.cell))))
        # The queued alerts are applied later, because some are newer than the answer.
        self._stretches.replace_alerts(alerts_in_box, has_service)

    def print_alerts(self) -> None:
        """Print the stretches of road whose alert has changed."""
        while not self._arrived.empty():
            self._stretches.apply_alert(self._arrived.get())
        for alert in self._stretches.take_changes():
            self._print_line(
                json.dumps({"event": "alert", **alert.to_json_values()})
                if self._as_json
                else alert.to_line()
            )
            self._on_alert(alert)

    def print_services(self, services: presence.PresenceTracker) -> None:
        """Print the regions that have lost or regained their service."""
        served_regions = {token.region for token in services.active}
        lost_regions = {token.region for token in services.lost_tokens} - served_regions
        unserved_regions = (
            set(regions.unserved_expressions(self._query, served_regions))
            if self._query.bbox
            else lost_regions
        )
        if unserved_regions != self._unserved and (served_regions or services.lost_tokens):
            for event, found in (
                ("away", unserved_regions - self._unserved),
                ("back", self._unserved - unserved_regions),
            ):
                if found:
                    self._print_line(_regions_line(event, sorted(found), self._as_json))
            self._unserved = unserved_regions


def standing_alerts(session: zenoh.Session) -> list[wire.Alert]:
    """Return the active alerts of all services that answer."""
    replies = (
        reply.ok
        for reply in session.get(f"{keys.ROOT}/alert/**", timeout=TIMEOUT_S)
        if reply.ok is not None
    )
    return [alert for reply in replies for alert in wire.decode_standing(reply.payload.to_bytes())]


def _regions_line(event: str, found: list[str], as_json: bool) -> str:
    if as_json:
        return json.dumps({"event": event, "regions": found})
    names = ", ".join(found)
    if event == "away":
        return f"no service answers for {names}"
    return f"{names} has a service again"


def _tile_line(tile: int, table: pa.Table, as_json: bool) -> str:
    measured = sum(basis == "measured" for basis in table["basis"].to_pylist())
    slippery = int((table["p_slippery"].to_numpy() > 0.5).sum())
    name = grid.quadkey(tile, grid.TILE_ZOOM)
    if as_json:
        counts = {"cells": table.num_rows, "measured": measured, "slippery": slippery}
        return json.dumps({"event": "tile", "tile": name, **counts})
    return f"tile {name}: {table.num_rows} cells, {measured} measured, {slippery} likely slippery"
