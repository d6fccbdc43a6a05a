"""When changed tiles are put: in rounds on a grid of time, a few tiles a turn of the worker, so that acknowledgements
never wait for them.

A round takes up all tiles that changed since the last one. A moment of the grid at which the last round is not done is
skipped and counted; what changed meanwhile is in the next. So a tile is put once a second as long as there is time for
it, and each in turn when there is not. The grid is the service's own: when within a second a tile is put says nothing
about when somebody passed there.
"""

from __future__ import annotations

from collections import Counter, deque
from collections.abc import Callable
from typing import Final

SHARE_S: Final = 0.02  # of a turn of the worker; with what comes in meanwhile, a segment is late by as much


class TileRounds:
    """The rounds of one service; for one thread.

    Args:
        every_s: between two moments of the grid.
        changed: takes the tiles that changed since its last call.
        put: makes one and puts it.
        counts: takes `tile_rounds_skipped`.
        clock: monotonic seconds.
    """

    def __init__(
        self,
        every_s: float,
        changed: Callable[[], list[int]],
        put: Callable[[int], None],
        counts: Counter[str],
        clock: Callable[[], float],
    ) -> None:
        self._every_s, self._changed, self._put, self._counts, self._clock = every_s, changed, put, counts, clock
        self._due, self._left = clock() + every_s, deque[int]()

    @property
    def waiting(self) -> int:
        """Tiles of the round that are still to be put."""
        return len(self._left)

    def begin(self) -> bool:
        """Begin a round, if its moment has come; whether one has, although the round before may go on instead."""
        passed = int((self._clock() - self._due) // self._every_s) + 1
        if passed <= 0:
            return False
        self._due += passed * self._every_s
        skipped = passed if self._left else passed - 1
        if skipped:
            self._counts["tile_rounds_skipped"] += skipped
        if not self._left:
            self._left.extend(self._changed())
        return True

    def go_on(self, share_s: float = SHARE_S) -> None:
        """Put tiles of the round for so long: one at least, if there is one."""
        end = self._clock() + share_s
        while self._left:
            self._put(self._left.popleft())
            if self._clock() >= end:
                break

    def finish(self, most_s: float) -> None:
        """Put what is left and what changed since, as far as the time allows: the service leaves."""
        known = set(self._left)
        self._left.extend(tile for tile in self._changed() if tile not in known)
        self.go_on(most_s)
