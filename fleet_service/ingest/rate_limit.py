"""Rate limit: a token bucket of bytes per sender, applied before a message is parsed.

A bucket fills at a constant rate and holds a burst, so that a vehicle can catch up after an outage.
Messages beyond the limit are dropped, counted and not acknowledged: the sender keeps them and sends
them again. The vehicle's name is the last chunk of the key; routers with an access list guarantee
that it is the sender's own name.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Collection, Mapping
from typing import Final

from fleet_service.counts import ServiceCounts

# Cost [bytes] of the smallest message. Reading, checking and refusing it costs a few dozen records.
LEAST_BYTES: Final = 1024
JSON: Final = "application/json"
JSON_COST: Final = 10  # cost of a JSON byte relative to protobuf; the worker needs 23 ms for 64 kB
# Largest number of names with a bucket of their own. More names can only be invented ones; they
# share one bucket.
MOST_NAMES: Final = 100_000
_OTHERS: Final = ""


class RateLimiter:
    """Token buckets (allowances that refill at a constant rate) of one service, one per vehicle.

    Args:
        rate: long-term rate of a vehicle [bytes/s].
        burst: amount that a vehicle may send at once [bytes].
        known: enrolled names; None to accept any name.
        counts: counts of the service; `limited` and `refused["unknown"]` are increased.
        clock: function that returns the time [s].
        shares: rate of publishers (senders for many vehicles) as a multiple of a vehicle's, by
            name.
    """

    def __init__(
        self,
        rate: float,
        burst: float,
        known: Collection[str] | None,
        counts: ServiceCounts,
        clock: Callable[[], float] = time.monotonic,
        shares: Mapping[str, float] | None = None,
    ) -> None:
        self._rate = rate
        self._burst = burst
        self._known = known
        self._counts = counts
        self._clock = clock
        self._shares = shares or {}
        # remaining amount [bytes] of each name, and the time [s] to which it applies
        self._buckets: dict[str, tuple[float, float]] = {}
        self._swept = -float("inf")

    def allows(self, key: str, size: int, encoding: str = "") -> bool:
        """Return True if a message of `size` bytes on `key` may be processed; otherwise count it as
        limited or refused.
        """
        name = key.rpartition("/")[2]
        if self._known is not None and name not in self._known:
            self._counts.refused["unknown"] += 1
            return False
        now = self._clock()
        if name not in self._buckets and len(self._buckets) >= MOST_NAMES and not self._forget(now):
            name = _OTHERS
        share = self._shares.get(name, 1.0)
        burst = self._burst * share
        tokens, since = self._buckets.get(name, (burst, now))
        tokens = min(burst, tokens + (now - since) * self._rate * share)
        cost = min(max(size, LEAST_BYTES) * (JSON_COST if encoding.startswith(JSON) else 1), burst)
        fits = tokens >= cost
        self._buckets[name] = (tokens - cost if fits else tokens, now)
        if not fits:
            self._counts.limited += 1
        return fits

    def __len__(self) -> int:
        return len(self._buckets)

    def _forget(self, now: float) -> bool:
        """Drop the token buckets (allowances) that are full again, because their vehicles have not
        sent recently. Do this at most once per refill time. Return True if there is room for
        another bucket.
        """
        if now - self._swept >= self._burst / self._rate:
            self._swept = now
            self._buckets = {
                name: (tokens, since)
                for name, (tokens, since) in list(self._buckets.items())
                if tokens / self._shares.get(name, 1.0) + (now - since) * self._rate < self._burst
            }
        return len(self._buckets) < MOST_NAMES
