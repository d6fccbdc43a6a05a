"""Connections of a Zenoh session: the connected router, the transport, and the number of changes.

Zenoh reports each transport (session with a router) and link (network connection) that opens or
closes. A `LinkWatch` stores the open ones and counts them, so that a program notices a lost
connection at once.
"""

from __future__ import annotations

import logging
import threading
from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from typing import Final

import zenoh

from schemas.runtime.metrics import Metric, counter

# Protocols that the metrics always list, even without a link, so that an alarm rule can name them.
PROTOCOLS: Final = (
    "quic",
    "tls",
    "tcp",
)

log = logging.getLogger(__name__)


class LinkWatch:
    """Observer of the links (network connections to routers) of a Zenoh session.

    Attributes:
        epoch: number of connections to a router that the session has opened so far.
        lost: number of connections to a router that the session has lost so far.

    Args:
        session: session to watch.
        name: name of the session, for the log.
        on_change: function that a thread of Zenoh calls after each opened or lost connection.
    """

    def __init__(
        self, session: zenoh.Session, name: str, on_change: Callable[[], None] = lambda: None
    ) -> None:
        self._name = name
        self._on_change = on_change
        self._lock = threading.Lock()
        self._routers = set[str]()
        # Protocol of each link. The key is the identity of the router and its address.
        self._links = dict[tuple[str, str], str]()
        self.epoch = 0
        self.lost = 0
        info = session.info
        self._listeners = (
            info.declare_link_events_listener(self._record_link, history=True),
            info.declare_transport_events_listener(self._record_transport, history=True),
        )

    @property
    def is_connected(self) -> bool:
        """Return True if the watched session is connected to a router."""
        return bool(self._routers)

    @property
    def protocols(self) -> list[str]:
        """Return the transport protocols of the watched session's current links: quic, tls
        or tcp.
        """
        with self._lock:
            return sorted(self._links.values())

    def close(self) -> None:
        """Stop watching the links of the session."""
        for listener in self._listeners:
            listener.undeclare()  # type: ignore[no-untyped-call]

    def _record_link(self, event: zenoh.LinkEvent) -> None:
        link = event.link
        protocol, address = link.dst.split("/", 1)
        with self._lock:
            if event.kind == zenoh.SampleKind.PUT:
                self._links[str(link.zid), link.dst] = protocol
            else:
                self._links.pop((str(link.zid), link.dst), None)
        if event.kind == zenoh.SampleKind.DELETE:
            log.warning("%s lost the router at %s (%s)", self._name, address, protocol)
        else:
            level = logging.WARNING if self.lost else logging.INFO
            log.log(
                level, "%s is connected to the router at %s over %s", self._name, address, protocol
            )

    def _record_transport(self, event: zenoh.TransportEvent) -> None:
        transport = event.transport
        if transport.whatami != zenoh.WhatAmI.ROUTER:
            return
        zid = str(transport.zid)
        with self._lock:
            if event.kind == zenoh.SampleKind.PUT and zid not in self._routers:
                self._routers.add(zid)
                self.epoch += 1
            elif event.kind == zenoh.SampleKind.DELETE and zid in self._routers:
                self._routers.remove(zid)
                self.lost += 1
        self._on_change()


def link_metrics(watches: Sequence[LinkWatch]) -> list[Metric]:
    """Return metrics about the links (router connections) of several Zenoh sessions."""
    found = Counter(protocol for watch in watches for protocol in watch.protocols)
    return [
        Metric("links", "gauge", "links to routers, by transport", _by_protocol(found), "protocol"),
        counter("links_opened", "connections to a router", sum(watch.epoch for watch in watches)),
        counter(
            "links_lost",
            "connections to a router that were lost",
            sum(watch.lost for watch in watches),
        ),
    ]


def _by_protocol(found: Mapping[str, int]) -> dict[str, float]:
    return {protocol: float(found.get(protocol, 0)) for protocol in (*PROTOCOLS, *found)}


def router_metrics(session: zenoh.Session) -> list[Metric]:
    """Return metrics about the sessions and links of a router, as the router reports them."""
    kinds = Counter(
        str(transport.whatami).rpartition(".")[2].lower() for transport in session.info.transports()
    )
    protocols = Counter(link.dst.partition("/")[0] for link in session.info.links())
    sessions = {kind: float(kinds.get(kind, 0)) for kind in ("client", "router", "peer")}
    return [
        Metric("router_sessions", "gauge", "open sessions, by kind of partner", sessions, "kind"),
        Metric(
            "router_links", "gauge", "open links, by transport", _by_protocol(protocols), "protocol"
        ),
    ]
