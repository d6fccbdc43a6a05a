"""The service's clock, which goes on through jumps of the system's.

A wall clock that jumps back an hour would put every honest vehicle an hour into the future, and have its reports
refused for good; so the time never falls behind what has passed since the start. One that jumps forward makes the map
look old, which is honest, until it jumps back. After a restart with a clock that is behind the archive (no battery, no
time server yet) reports up to the time that has already been seen are not in the future.
"""

from __future__ import annotations

import time
from collections.abc import Callable


class SteadyClock:
    """Time of the service [ns UTC].

    Args:
        seen: latest time at which a report was received before this start, 0 if none was.
        wall, steady: the system's clocks [ns]; `steady` never jumps, its zero does not matter.
    """

    def __init__(
        self,
        seen: int = 0,
        wall: Callable[[], int] = time.time_ns,
        steady: Callable[[], int] = time.monotonic_ns,
    ) -> None:
        self._wall, self._steady = wall, steady
        self._zero = wall() - steady()
        self._behind = max(0, seen - wall())

    def now(self) -> int:
        """The time; may jump forward with the wall clock, and back only to what has passed since the start."""
        return max(self._wall(), self._zero + self._steady())

    def slack(self) -> int:
        """How far beyond `now` the true time may lie [ns], by what the archive has seen."""
        return max(0, self._zero + self._steady() + self._behind - self.now())

    def lag(self) -> int:
        """How far the wall clock is behind [ns]: the length of a jump back."""
        return self.now() + self.slack() - self._wall()
