"""Bounded connections of the web server; half-open connections time out.

A connection without a complete request head after HEAD_S is closed. When all places are taken, a
new connection takes the place of the oldest one without a request. Repeated errors of the event
loop are logged once per LOG_S.
"""

from __future__ import annotations

import asyncio
import logging
import time
from typing import Any, Final

from uvicorn.protocols.http.h11_impl import H11Protocol

log = logging.getLogger(__name__)
HEAD_S: Final = 10.0
MOST: Final = 800  # below the usual limit of 1024 files
LOG_S: Final = 60.0


class BoundedProtocol(H11Protocol):
    """Connection of one browser."""

    _head_timer: asyncio.TimerHandle | None = None

    def connection_made(self, transport: asyncio.Transport) -> None:  # type: ignore[override]
        """Accept a connection if there is a place, and wait for its first request."""
        if len(self.connections) >= MOST and not self._close_oldest_silent():
            transport.abort()
            return
        super().connection_made(transport)
        self._made_at = time.monotonic()
        self._head_timer = self.loop.call_later(HEAD_S, self._close_silent)

    def data_received(self, data: bytes) -> None:
        """Ignore data of a connection that was not accepted."""
        if self._head_timer is not None:
            super().data_received(data)

    def connection_lost(self, exc: Exception | None) -> None:
        """Forget the connection, if it was accepted."""
        if self._head_timer is not None:
            self._head_timer.cancel()
            super().connection_lost(exc)

    def _close_oldest_silent(self) -> bool:
        """Close the oldest connection that has sent no request; return False if there is none."""
        silent = [
            one for one in self.connections if isinstance(one, BoundedProtocol) and one.is_silent
        ]
        if not silent:
            return False
        oldest = min(silent, key=lambda one: one._made_at)
        self.connections.discard(oldest)
        oldest.transport.abort()
        return True

    @property
    def is_silent(self) -> bool:
        """Return True until the first request."""
        return bool(self.cycle is None)

    def _close_silent(self) -> None:
        if self.is_silent:
            self.transport.abort()


class LoopErrors:
    """Handler of errors of the event loop that logs the first, and then at most one per LOG_S
    with their number.
    """

    def __init__(self) -> None:
        self._logged_at = -LOG_S
        self._more = 0

    def __call__(self, _: asyncio.AbstractEventLoop, context: dict[str, Any]) -> None:
        """Log an error or count it."""
        if time.monotonic() - self._logged_at < LOG_S:
            self._more += 1
            return
        problem = context.get("exception") or context.get("message")
        log.warning("web server: %s (and %d more since the last message)", problem, self._more)
        self._logged_at = time.monotonic()
        self._more = 0
