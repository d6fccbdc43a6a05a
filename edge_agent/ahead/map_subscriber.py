"""Map subscriber of one vehicle on its own Zenoh session: receives alerts of the tiles ahead, and
queries the map along the path.

Zenoh calls back on its own threads; one lock protects the received data. Invalid messages are
rejected and counted.
"""

from __future__ import annotations

import logging
import threading
import time
from collections import Counter
from collections.abc import Callable
from typing import Any, Final

import zenoh

from edge_agent.ahead.cell_decoder import decode_alert_message, decode_cells, decode_standing_alerts
from edge_agent.ahead.local_map import LocalMap
from edge_agent.ahead.path import Path, Pose
from edge_agent.ahead.request_log import (
    Box,
    RequestLog,
    Tiles,
    keys_of,
    split_at_antimeridian,
)
from schemas import grid, keys
from schemas.errors import WireError
from schemas.runtime.zenoh_session import connected_routers, quality_of
from schemas.thresholds import NS
from schemas.wire.ahead import AHEAD_ENCODING

log = logging.getLogger(__name__)
ANSWER_S: Final = 5.0  # [s] timeout of a query; the next look-up repeats an unanswered query
# [s] times after a reconnection at which the car repeats its queries while nobody answers. The
# service may reconnect later than the car: Zenoh looks for a router at least every 4 s.
AGAIN_S: Final = (1.0, 3.0, 9.0)
_TOPIC: Final = keys.TOPICS["ahead"]


class _QueryRepeats:
    """Times after a reconnection at which the queries are sent again, until there is an answer."""

    def __init__(self) -> None:
        self._times = list[int]()  # [ns UTC]
        self.is_answered = False

    def begin(self, now: int) -> None:
        """Schedule the repetitions after a reconnection at the time `now` [ns UTC]."""
        self._times = [now + round(later * NS) for later in AGAIN_S]
        self.is_answered = False

    def is_due(self, now: int) -> bool:
        """Return True, once for each scheduled time, if it has passed without an answer."""
        if not self._times or now < self._times[0]:
            return False
        del self._times[0]
        return not self.is_answered


class MapSubscriber:
    """Receiver of the map ahead of one vehicle. It subscribes to alerts of slippery places, and
    queries map cells.

    Args:
        vehicle: name of the vehicle.
        session: open session of the vehicle; the caller closes it.
        urgent: function called with the places (cell·4 + sector) whose alerts have changed.
        clock: function that returns the time [ns UTC].
    """

    def __init__(
        self,
        vehicle: str,
        session: zenoh.Session,
        urgent: Callable[[list[int]], None],
        clock: Callable[[], int] = time.time_ns,
    ) -> None:
        self._session = session
        self._urgent = urgent
        self._clock = clock
        self._lock = threading.Lock()
        self._map = LocalMap()
        self._requests = RequestLog()
        self._tiles = Tiles()
        self._subscribers: dict[int, Any] = {}
        self._routers: frozenset[str] = frozenset()
        self._repeats = _QueryRepeats()
        self._publisher = session.declare_publisher(
            keys.ahead_key(vehicle), encoding=AHEAD_ENCODING, **quality_of(_TOPIC)
        )
        self.counts: Counter[str] = Counter()

    def map_lock(self) -> threading.Lock:
        """Return the lock that a thread must hold while it reads the local copy of the map
        (`local_map`).
        """
        return self._lock

    @property
    def local_map(self) -> LocalMap:
        """Return the local copy of the map; the caller must have acquired the lock of the
        subscriber.
        """
        return self._map

    @property
    def tiles(self) -> list[int]:
        """Return the map tiles whose alerts the vehicle has subscribed to."""
        return self._tiles.subscribed_tiles

    @property
    def is_connected(self) -> bool:
        """Return True if the vehicle's session was connected to a router at the last check."""
        return bool(self._routers)

    def follow_paths(self, paths: list[Path], pose: Pose, within: float) -> None:
        """Subscribe to alerts and send map queries along the possible paths, the most likely path
        first. The call does not wait for an answer.

        The subscriptions cover the first `within` metres of the paths. A path is queried only if
        some part of its first `within` metres was not requested recently. The queries then cover
        every part of the whole path that was not requested recently.
        """
        routers = connected_routers(self._session)
        is_reconnected = bool(routers - self._routers)
        self._routers = routers
        tiles, dropped = self._tiles.update_subscriptions(
            [path.first_metres(within) for path in paths], pose
        )
        for tile in dropped:
            self._subscribers.pop(tile).undeclare()
        for tile in tiles:
            self._subscribers[tile] = self._session.declare_subscriber(
                keys.alert_key(tile), self._on_alert
            )
        if not routers:
            return
        if is_reconnected:
            self._repeats.begin(self._clock())
        if is_reconnected or self._repeats.is_due(self._clock()):
            self._requests.request_again()
            tiles = self._tiles.subscribed_tiles
        # Query the active alerts only after subscribing, so that no alert is missed in between.
        for tile in tiles:
            self._send_query(keys.alert_key(tile), self._on_standing)
        for path in paths:
            for box in self._requests.missing_boxes(path, pose, within):
                self._query_box(box)
        with self._lock:
            self._map.drop_old(pose.time)

    def publish_view(self, payload: Callable[[], bytes]) -> None:
        """Publish `payload`, the encoded outlook (the map's values for the road ahead), on the
        vehicle's own Zenoh key, if there is a subscriber.
        """
        if self._publisher.matching_status.matching:  # type: ignore[attr-defined] # stub: bool
            self._publisher.put(payload())
            self.counts["told"] += 1

    def close(self) -> None:
        """Stop the subscriptions to alerts; the vehicle's session stays open."""
        for subscriber in self._subscribers.values():
            subscriber.undeclare()
        self._subscribers.clear()
        self._publisher.undeclare()

    def _query_box(self, box: Box) -> None:
        for part in split_at_antimeridian(box):
            text = ",".join(f"{side:.6f}" for side in part)
            for region in keys_of(part):
                key = f"{keys.ROOT}/map/{keys.chunks(region, grid.REGION_ZOOM)}/*?bbox={text}"
                self._send_query(key, self._on_cells)
                self.counts["questions"] += 1

    def _send_query(self, selector: str, take: Callable[[str, bytes], None]) -> None:
        def receive_reply(reply: zenoh.Reply) -> None:
            if reply.ok is None:
                self.counts["unanswered"] += 1
                return
            self._repeats.is_answered = True
            self._pass_payload(take, str(reply.ok.key_expr), reply.ok.payload.to_bytes())

        try:
            self._session.get(selector, receive_reply, timeout=ANSWER_S)
        except zenoh.ZError as error:
            self.counts["unanswered"] += 1
            log.warning("the map cannot be queried: %s", error)

    def _on_alert(self, sample: zenoh.Sample) -> None:
        self._pass_payload(self._store_alert, str(sample.key_expr), sample.payload.to_bytes())

    def _pass_payload(self, take: Callable[[str, bytes], None], key: str, payload: bytes) -> None:
        self.counts["bytes"] += len(key) + len(payload)
        try:
            take(key, payload)
        except WireError as error:
            self.counts[f"refused.{error.field}"] += 1
            log.warning("a message on %s is ignored: %s", key, error)

    def _store_alert(self, key: str, payload: bytes) -> None:
        now = self._clock()
        alert = decode_alert_message(key, payload, now)
        self.counts["alerts"] += 1
        with self._lock:
            changed = self._map.store_alert(alert, now)
        if changed:
            self._urgent([alert.cell * grid.SECTORS + alert.sector])

    def _on_standing(self, key: str, payload: bytes) -> None:
        now = self._clock()
        tile, alerts = decode_standing_alerts(key, payload, now)
        with self._lock:
            changed = self._map.store_standing_alerts(tile, alerts, now)
        if changed:
            self._urgent(changed)

    def _on_cells(self, key: str, payload: bytes) -> None:
        now = self._clock()
        tile, cells = decode_cells(key, payload, now)
        self.counts["cells"] += len(cells.key)
        with self._lock:
            self._map.store_cells(tile, cells, now)
