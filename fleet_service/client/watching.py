"""Watch for changes of the map: print one line per changed tile, per alert, and per region that
loses or regains its service.
"""

from __future__ import annotations

import json
import threading
from collections.abc import Callable
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
    asked = query.parse({} if options.bbox is None else {"bbox": options.bbox})
    box = asked.bbox
    stretches = Stretches()
    lock = threading.Lock()
    away = set[str]()

    def tile_if_near(key: str) -> int | None:
        tile = keys.parse(key).quadint
        if tile is None or box is None:
            return tile
        return tile if grid.touches(box, grid.bounds(tile, grid.TILE_ZOOM)) else None

    def print_tile(sample: zenoh.Sample) -> None:
        tile = tile_if_near(str(sample.key_expr))
        if tile is not None:
            print_line(_tile_line(tile, decode_tile(sample.payload.to_bytes()), options.as_json))

    def apply_alert(alert: wire.Alert) -> None:
        with lock:
            stretches.apply_alert(alert)

    def apply_sample(sample: zenoh.Sample) -> None:
        if tile_if_near(str(sample.key_expr)) is not None:
            apply_alert(wire.decode_alert(sample.payload.to_bytes()))

    def print_changes() -> None:
        with lock:
            found = stretches.take_changes()
        for alert in found:
            print_line(
                json.dumps({"event": "alert", **alert.to_json_values()})
                if options.as_json
                else alert.to_line()
            )
            on_alert(alert)

    def print_services() -> None:
        nonlocal away
        here = {token.region for token in services.active}
        left = {token.region for token in services.lost_tokens} - here
        now = set(regions.unserved_expressions(asked, here)) if asked.bbox else left
        if now != away and (here or services.lost_tokens):
            _print_regions(print_line, now - away, away - now, as_json=options.as_json)
            away = now

    session = zenoh_session.open_session(connection, stop)
    if session is None:
        return
    with session, presence.track_tokens(session) as services:
        if not options.only_alerts:
            session.declare_subscriber(f"{keys.ROOT}/map/**", print_tile)
        session.declare_subscriber(f"{keys.ROOT}/alert/**", apply_sample)
        for alert in standing_alerts(session):  # after subscribing, so that no alert is missed
            if tile_if_near(keys.alert_key(int(grid.tile_of(alert.cell)))) is not None:
                apply_alert(alert)
        print_line(json.dumps({"event": "watching"}) if options.as_json else "watching")
        print_services()
        while not stop.wait(GATHER_S):
            print_changes()
            print_services()
        print_changes()


def standing_alerts(session: zenoh.Session) -> list[wire.Alert]:
    """Return the active alerts of all services that answer."""
    replies = (
        reply.ok
        for reply in session.get(f"{keys.ROOT}/alert/**", timeout=TIMEOUT_S)
        if reply.ok is not None
    )
    return [alert for reply in replies for alert in wire.decode_standing(reply.payload.to_bytes())]


def _print_regions(
    print_line: Callable[[str], None], away: set[str], back: set[str], *, as_json: bool
) -> None:
    for event, found in (("away", away), ("back", back)):
        if found and as_json:
            print_line(json.dumps({"event": event, "regions": sorted(found)}))
        elif found:
            names = ", ".join(sorted(found))
            print_line(
                f"no service answers for {names}"
                if event == "away"
                else f"{names} has a service again"
            )


def _tile_line(tile: int, table: pa.Table, as_json: bool) -> str:
    measured = sum(basis == "measured" for basis in table["basis"].to_pylist())
    slippery = int((table["p_slippery"].to_numpy() > 0.5).sum())
    name = grid.quadkey(tile, grid.TILE_ZOOM)
    if as_json:
        counts = {"cells": table.num_rows, "measured": measured, "slippery": slippery}
        return json.dumps({"event": "tile", "tile": name, **counts})
    return f"tile {name}: {table.num_rows} cells, {measured} measured, {slippery} likely slippery"
