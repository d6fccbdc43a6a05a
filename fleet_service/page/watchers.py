"""Server-sent events to browsers. Each browser has a view and a short queue; a browser that is too
slow is asked to reload.

tiles    blocks (encoded cells of tiles) in base64, one per line: changed cells, or a complete
         tile when zoomed out
alerts   all stretches with an active alert
beat     time, served regions, number of active alerts: every two seconds
reload   this browser has missed an event and must query again
"""

from __future__ import annotations

import asyncio
import base64
import json
import time
from collections import Counter
from collections.abc import AsyncIterator, Callable
from typing import Any, Final, NamedTuple

from fleet_service.page.map_mirror import MapMirror, box_of
from fleet_service.page.records import CELL_LEVEL, TileBlock
from schemas import grid

FLUSH_S: Final = 0.1  # [s] changes within this time are sent as one event
BEAT_S: Final = 2.0
WAITING: Final = 64  # largest number of events in a browser's queue: six seconds of a busy map
MOST: Final = 400  # largest number of watching browsers
Box = tuple[float, float, float, float]
_RELOAD: Final = b"event: reload\ndata: {}\n\n"


class TooManyWatchersError(Exception):
    """Error: the maximum number of watching browsers is reached."""


class View(NamedTuple):
    """Part of the map that a browser shows: west, south, east, north [deg], and the zoom level of
    the records (cells).
    """

    box: Box
    level: int


class _OpenPage(NamedTuple):
    view: View
    queue: asyncio.Queue[bytes | None]
    client: str


class Watchers:
    """Set of all browsers that show the live map and receive its changes; for use in one event
    loop.

    Args:
        world: the mirrored map.
        state: function that returns the state of services for a `beat` event.
        most: maximum number of watching browsers.
    """

    def __init__(
        self, world: MapMirror, state: Callable[[], dict[str, Any]], most: int = MOST
    ) -> None:
        self._world = world
        self._state = state
        self._most = most
        self._watchers: dict[asyncio.Queue[bytes | None], _OpenPage] = {}  # oldest first
        self.reloads = 0

    def __len__(self) -> int:
        return len(self._watchers)

    def add_watcher(self, view: View, client: str = "") -> AsyncIterator[bytes]:
        """Return the stream of events (changes of the map) for a view, from now on, until the
        browser disconnects.

        Streams are shared fairly: if the maximum is reached, the client with the most streams loses
        one to a client with fewer.

        Raises:
            TooManyWatchersError: no stream can be ended; the browser must try again later.
        """
        if len(self._watchers) >= self._most:
            self._make_place(client)
        watcher = _OpenPage(view, asyncio.Queue(WAITING), client)
        self._watchers[watcher.queue] = watcher
        watcher.queue.put_nowait(_encode_event("alerts", self._world.alerts.as_json()))
        watcher.queue.put_nowait(_encode_event("beat", self._beat_content()))
        return self._stream_events(watcher)

    def _make_place(self, client: str) -> None:
        counts = Counter(watcher.client for watcher in self._watchers.values())
        greedy, most = counts.most_common(1)[0] if counts else ("", 0)
        if most <= counts[client] + 1:
            raise TooManyWatchersError
        oldest = next(watcher for watcher in self._watchers.values() if watcher.client == greedy)
        del self._watchers[oldest.queue]
        self._queue_event(oldest, None)

    async def _stream_events(self, watcher: _OpenPage) -> AsyncIterator[bytes]:
        try:
            while (event := await watcher.queue.get()) is not None:
                yield event
        finally:
            self._watchers.pop(watcher.queue, None)

    async def run(self) -> None:
        """Send the changes of the map to all watching browsers, again and again, until this asyncio
        task is cancelled.
        """
        beaten = 0.0
        while True:
            await asyncio.sleep(FLUSH_S)
            if changes := self._world.changes():
                self.send_changes(changes)
            if self._world.alerts.take_change():
                self._send_to_all(_encode_event("alerts", self._world.alerts.as_json()))
            if time.monotonic() - beaten >= BEAT_S:
                beaten = time.monotonic()
                self._send_to_all(_encode_event("beat", self._beat_content()))

    def close(self) -> None:
        """End the event streams of all browsers."""
        for watcher in list(self._watchers.values()):
            self._queue_event(watcher, None)

    def _beat_content(self) -> dict[str, Any]:
        return {"now": time.time(), "heard": self._world.last_received, **self._state()}

    def send_changes(self, changes: list[TileBlock]) -> None:
        """Send changed blocks to the browsers whose view they touch."""
        # blocks by (tile, level), each encoded once for all browsers that show it
        lines: dict[tuple[int, int], bytes] = {}
        for watcher in list(self._watchers.values()):
            found = []
            for block in changes:
                if grid.touches(watcher.view.box, _tile_box(block.tile)):
                    place = (block.tile, watcher.view.level)
                    if place not in lines:
                        lines[place] = self._event_line(block, watcher.view.level)
                    found.append(lines[place])
            if found:
                self._queue_event(watcher, b"event: tiles\n" + b"".join(found) + b"\n")

    def _event_line(self, block: TileBlock, level: int) -> bytes:
        """Return the line of an event that contains the block in the form of a zoom level."""
        is_cells = level == CELL_LEVEL
        content = block.encoded() if is_cells else self._world.encoded(block.tile, level)
        return b"data: " + base64.b64encode(content) + b"\n"

    def _send_to_all(self, event: bytes) -> None:
        for watcher in list(self._watchers.values()):
            self._queue_event(watcher, event)

    def _queue_event(self, watcher: _OpenPage, event: bytes | None) -> None:
        try:
            watcher.queue.put_nowait(event)
        except asyncio.QueueFull:
            while not watcher.queue.empty():
                watcher.queue.get_nowait()
            self.reloads += 1
            watcher.queue.put_nowait(_RELOAD if event is not None else None)


def _tile_box(tile: int) -> Box:
    west, south, east, north = box_of(tile)
    return west, south, east, north


def _encode_event(name: str, value: object) -> bytes:
    return f"event: {name}\ndata: {json.dumps(value)}\n\n".encode()
