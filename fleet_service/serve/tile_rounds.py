"""Publication of changed tiles in rounds. The service publishes only a few tiles in each pass of
the service's main loop, so that acknowledgements never wait.

A round publishes all tiles that changed since the last round. Rounds begin at fixed times,
`every_s` apart. If the last round is not complete at such a time, the time is skipped and counted,
and the changes go to the next round. A changed tile is therefore published in every round if there
is enough time, and in a later round otherwise. The offset of the fixed times is random and secret,
so that the time of a publication does not reveal when a vehicle passed.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Final

from fleet_service.counts import ServiceCounts

# [s] Time for tiles per pass of the worker's loop. A segment is delayed by about as much.
SHARE_S: Final = 0.02


class TileRounds:
    """Publication rounds of one service; for use by one thread.

    Args:
        every_s: time between the beginnings of two rounds [s].
        changed: function that returns the tiles that changed since its last call.
        put: function that makes and publishes the first of the waiting tiles. It returns their
            number, at least one.
        counts: counts of the service; `tile_rounds_skipped` is increased.
        clock: function that returns monotonic time [s].
    """

    def __init__(
        self,
        every_s: float,
        changed: Callable[[], list[int]],
        put: Callable[[list[int]], int],
        counts: ServiceCounts,
        clock: Callable[[], float],
    ) -> None:
        self._every_s = every_s
        self._changed = changed
        self._put = put
        self._counts = counts
        self._clock = clock
        self._due = clock() + every_s
        self._unpublished: list[int] = []

    @property
    def waiting(self) -> int:
        """Return the number of tiles of the current publication round that are not published
        yet.
        """
        return len(self._unpublished)

    def begin(self) -> bool:
        """Begin a publication round if one is due, and return True; return False if none is due. If
        the previous round is not complete, it is continued instead of a new one.
        """
        passed = int((self._clock() - self._due) // self._every_s) + 1
        if passed <= 0:
            return False
        self._due += passed * self._every_s
        skipped = passed if self._unpublished else passed - 1
        if skipped:
            self._counts.tile_rounds_skipped += skipped
        if not self._unpublished:
            self._unpublished.extend(self._changed())
        return True

    def go_on(self, share_s: float = SHARE_S) -> None:
        """Publish tiles of the current round for `share_s` [s], but at least the next ones."""
        end = self._clock() + share_s
        while self._unpublished:
            del self._unpublished[: self._put(self._unpublished)]
            if self._clock() >= end:
                break

    def finish(self, most_s: float) -> None:
        """Publish the remaining and newly changed tiles, for at most `most_s` [s], because the
        service stops.
        """
        known = set(self._unpublished)
        self._unpublished.extend(tile for tile in self._changed() if tile not in known)
        self.go_on(most_s)
