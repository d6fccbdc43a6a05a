"""Queues for the requests of browsers, so that one client cannot block the page for other clients,
neither for ordinary requests nor for queries about past maps.

At most RUNNING requests of one client are computed at a time; its other requests wait.

A service rebuilds one past map at a time. Therefore the page sends one query about the past at a
time, in the order of arrival, and queues at most MOST_WAITING of one client. After each query about
the past, the page pauses for as long as the query took, so that other readers of the service get
their turn.
"""

from __future__ import annotations

import asyncio
import time
from collections import Counter
from collections.abc import AsyncIterator
from contextlib import asynccontextmanager
from typing import Final

RUNNING: Final = 4
MOST_WAITING: Final = 2  # requests per client: one that is being answered, and one that waits
MOST_CLIENTS: Final = 32
LONGEST_PAUSE_S: Final = 2.0


class TooManyQuestionsError(Exception):
    """Error: one client, or all clients together, have too many queries waiting."""


class RequestTurns:
    """Limit on the concurrent requests of each client; for use in one event loop."""

    def __init__(self) -> None:
        self._counts: Counter[str] = Counter()
        self._free: dict[str, asyncio.Semaphore] = {}

    @asynccontextmanager
    async def take(self, client: str) -> AsyncIterator[None]:
        """Wait until one more request of this client (a browser) may be computed, and count the
        request as running while the block runs.
        """
        self._counts[client] += 1
        try:
            async with self._free.setdefault(client, asyncio.Semaphore(RUNNING)):
                yield
        finally:
            self._counts[client] -= 1
            if not self._counts[client]:
                del self._counts[client], self._free[client]


class PastTurns:
    """Queue of browsers' queries about past maps; for use in one event loop."""

    def __init__(self) -> None:
        self._lock = asyncio.Lock()
        self._waiting: Counter[str] = Counter()
        self._free_at = 0.0

    @asynccontextmanager
    async def take(self, client: str) -> AsyncIterator[None]:
        """Wait until all earlier queries about the past have ended; other queries wait while the
        block runs. `client` is the browser that sent the query.

        Raises:
            TooManyQuestionsError: too many queries are waiting.
        """
        if self._waiting[client] >= MOST_WAITING or len(+self._waiting) >= MOST_CLIENTS:
            raise TooManyQuestionsError
        self._waiting[client] += 1
        try:
            async with self._lock:
                await asyncio.sleep(max(self._free_at - time.monotonic(), 0.0))
                began = time.monotonic()
                try:
                    yield
                finally:
                    ended = time.monotonic()
                    self._free_at = ended + min(ended - began, LONGEST_PAUSE_S)
        finally:
            self._waiting[client] -= 1
            if not self._waiting[client]:
                del self._waiting[client]
