"""Limit on the connections of the web server, with a time limit for half-open connections.

A connection is closed if it has not sent the complete head of a request within HEAD_S. When the
maximum number of connections is open, a new connection replaces an old one: the oldest connection
without a request. If every connection has a request, the oldest connection of the address with the
most connections is replaced. Repeated messages of the web server are logged once per LOG_S.
"""

from __future__ import annotations

import asyncio
import logging
import time
from collections import Counter
from typing import Any, Final

from uvicorn.protocols.http.h11_impl import H11Protocol

log = logging.getLogger(__name__)
HEAD_S: Final = 10.0
MOST: Final = 800  # connections; below the usual limit of 1024 open files per process
LOG_S: Final = 60.0


class BoundedProtocol(H11Protocol):
    """Connection of one browser to the web server, under the limit on connections."""

    _head_timer: asyncio.TimerHandle | None = None  # None if the connection was not accepted

    def connection_made(self, transport: asyncio.Transport) -> None:  # type: ignore[override]
        """Accept a connection if the limit allows it, and wait for its first request."""
        self.host = (transport.get_extra_info("peername") or ("",))[0]
        if len(self.connections) >= MOST and not self._make_place():
            transport.abort()
            return
        super().connection_made(transport)
        self._made_at = time.monotonic()
        self._await_request()

    def data_received(self, data: bytes) -> None:
        """Process received data, and wait for the rest of a request. Data of a connection that was
        not accepted are ignored.
        """
        if self._head_timer is not None:
            super().data_received(data)
            if self.is_silent and self._head_timer.when() <= self.loop.time():
                self._await_request()

    def connection_lost(self, exc: Exception | None) -> None:
        """Release an accepted connection after its end: stop its time limit, and remove it from the
        set of open connections.
        """
        if self._head_timer is not None:
            self._head_timer.cancel()
            super().connection_lost(exc)

    def _make_place(self) -> bool:
        """Make room for a new connection of a browser by closing the oldest connection without a
        request. If every connection has a request, close the oldest connection of the address that
        has the most connections. Return False if no connection may be closed.
        """
        others = [one for one in self.connections if isinstance(one, BoundedProtocol)]
        found = [one for one in others if one.is_silent]
        if not found:
            counts = Counter(one.host for one in others)
            greedy, most = counts.most_common(1)[0]
            if most <= counts[self.host] + 1:
                return False
            found = [one for one in others if one.host == greedy]
        oldest = min(found, key=lambda one: one._made_at)
        self.connections.discard(oldest)
        oldest.transport.abort()
        return True

    @property
    def is_silent(self) -> bool:
        """Return True while the browser's connection has no request that is being answered."""
        return bool(self.cycle is None or self.cycle.response_complete)

    def _await_request(self) -> None:
        self._head_timer = self.loop.call_later(HEAD_S, self._close_silent, self.cycle)

    def _close_silent(self, before: object) -> None:
        """Close the browser's connection if no request has come since the time limit began.
        `before` is the last request at that time.
        """
        if not self.is_silent:
            return
        if self.cycle is before:
            self.transport.abort()
        else:
            self._await_request()


class RareMessages(logging.Filter):
    """Log filter that passes each message at most once per LOG_S seconds, and adds to it the number
    of equal messages that were not logged in between.
    """

    def __init__(self) -> None:
        super().__init__()
        self._passed: dict[str, float] = {}
        self._more: Counter[str] = Counter()

    def filter(self, record: logging.LogRecord) -> bool:
        """Return True if a log message may be written now, because no equal message was written
        within the last LOG_S seconds.
        """
        text = str(record.msg)
        if time.monotonic() - self._passed.get(text, -LOG_S) < LOG_S:
            self._more[text] += 1
            return False
        self._passed[text] = time.monotonic()
        if more := self._more.pop(text, 0):
            record.msg = f"{text} (and {more} more since the last message)"
        return True


def limit_messages() -> None:
    """Log each message of the web server and of its event loop at most once per LOG_S."""
    rare = RareMessages()
    for logger in (log, logging.getLogger("uvicorn.error")):
        logger.addFilter(rare)


def report_loop_error(_: asyncio.AbstractEventLoop, context: dict[str, Any]) -> None:
    """Log an error of the web server's event loop as one line."""
    log.warning("web server: %s", context.get("exception") or context.get("message"))
