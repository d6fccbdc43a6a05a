"""Zenoh sessions of all vehicles of a publisher, with their connections to a router. Separate
threads open the sessions.
"""

from __future__ import annotations

import queue
import threading
from collections.abc import Callable, Iterable
from contextlib import suppress
from typing import Final

import zenoh

from edge_agent.publish.outbox import StoredBatch
from edge_agent.publish.zenoh_link import Link
from schemas.config import ZenohSettings
from schemas.runtime.link_watch import LinkWatch
from schemas.runtime.zenoh_session import ReasonLog

# Largest number of sessions that are opened at a time. An unreachable router delays each of them by
# its time limit [s], and a vehicle whose certificate is refused waits for ever. More threads would
# cost the estimator time while there is no router, because each attempt takes 1 ms.
OPENERS: Final = 32


class SessionLinks:
    """Set of Zenoh sessions, one per vehicle.

    `on_open(name, session)` is called when the session of the vehicle `name` is open, on one of
    several threads. `on_ack(name, payload)` is called for each acknowledgement that the vehicle
    receives.
    """

    def __init__(
        self,
        names: Iterable[str],
        settings: ZenohSettings,
        on_open: Callable[[str, zenoh.Session], None],
        on_ack: Callable[[str, bytes], None],
        stop: threading.Event,
    ) -> None:
        self._unopened: queue.SimpleQueue[str] = queue.SimpleQueue()
        for name in names:
            self._unopened.put(name)
        self._settings = settings
        self._on_open = on_open
        self._on_ack = on_ack
        self._stop = stop
        self._links: dict[str, Link] = {}
        self._epochs: dict[str, int] = {}
        self._connected: dict[str, bool] = {}
        self._reasons = ReasonLog()
        self._openers = [
            threading.Thread(target=self._open_links, name="connector", daemon=True)
            for _ in range(min(OPENERS, self._unopened.qsize()))
        ]

    def start(self) -> None:
        """Start the threads that open the sessions. For each session, a thread waits for a router
        as long as necessary.
        """
        for opener in self._openers:
            opener.start()

    def close(self) -> None:
        """Close all Zenoh sessions. The caller must set the event `stop` first, because the method
        waits for the threads that open the sessions.
        """
        for opener in self._openers:
            opener.join()
        for link in self._links.values():
            link.close()

    @property
    def session_count(self) -> int:
        """Return the number of open Zenoh sessions."""
        return len(self._links)

    @property
    def link_watches(self) -> list[LinkWatch]:
        """Return, for each session, the object that watches its link to the router."""
        return [link.watch for link in list(self._links.values())]

    @property
    def is_cut_off(self) -> bool:
        """Return True if an open session had no router at the last `update_connections`."""
        return not all(list(self._connected.values()))

    @property
    def connected_names(self) -> set[str]:
        """Return the names of the vehicles whose session had a router at the last
        `update_connections`.
        """
        return {name for name, connected in self._connected.items() if connected}

    def put_batch(self, batch: StoredBatch) -> bool:
        """Send a batch on its vehicle's session; return False if the session does not accept it."""
        return self._links[batch.stream.vehicle].put(batch)

    def update_connections(self) -> list[str]:
        """Update the connection states, and return the names of the vehicles whose link to a router
        was replaced by a new one.

        Batches in flight (sent and not answered) on the former link are lost, so the caller must
        send them again.
        """
        replaced = []
        for name, link in list(self._links.items()):
            epoch = link.watch.epoch
            if epoch != self._epochs.get(name, 0):
                self._epochs[name] = epoch
                replaced.append(name)
            self._connected[name] = link.is_connected
        return replaced

    def _open_links(self) -> None:
        with suppress(queue.Empty):
            while not self._stop.is_set():
                self._open_link(self._unopened.get_nowait())

    def _open_link(self, name: str) -> None:
        link = Link.open(self._settings, name, self._on_ack, self._stop, self._reasons)
        if link is not None:
            self._links[name] = link
            self._on_open(name, link.session)
