"""Recent moments of the live map in memory. In the first hour, before a service has stored a
snapshot, they are the only past that the page can show. Pure (no I/O).
"""

from __future__ import annotations

import itertools
from collections import OrderedDict
from collections.abc import Mapping
from typing import Final

from fleet_service.page.records import Records

STEP_S: Final = 10
MOST: Final = 180  # number of moments: half an hour in steps of STEP_S
THIN: Final = 60  # number of newest moments that are kept in steps of STEP_S, others of THINNED_S
THINNED_S: Final = 60


class RecentMoments:
    """Map at several recent moments, oldest first: for each moment [s since 1970], the records
    (encoded cells) of all tiles. The arrays are shared with the live map and never copied.
    """

    def __init__(self) -> None:
        self._kept: OrderedDict[int, dict[int, Records]] = OrderedDict()

    def keep(self, now: float, tiles: Mapping[int, Records]) -> None:
        """Store `tiles` (the whole map) as the moment `now` [s since 1970]. Do nothing if the last
        stored moment is too recent, or if no tile has changed since then.
        """
        moment = int(now)
        last = next(reversed(self._kept), None)
        if not tiles or (
            last is not None and (moment < last + STEP_S or _is_same(self._kept[last], tiles))
        ):
            return
        self._kept[moment] = dict(tiles)
        old = list(self._kept)[:-THIN]
        for before, one in itertools.pairwise(old):
            if one // THINNED_S == before // THINNED_S:
                del self._kept[before]
        while len(self._kept) > MOST:
            self._kept.popitem(last=False)

    def times(self) -> list[int]:
        """Return the times of the stored moments [s since 1970], oldest first."""
        return list(self._kept)

    def at(self, moment: int) -> dict[int, Records] | None:
        """Return the tiles of the map at a stored moment [s since 1970]; None if no map of this
        moment is stored.
        """
        return self._kept.get(moment)


def _is_same(before: Mapping[int, Records], tiles: Mapping[int, Records]) -> bool:
    return before.keys() == tiles.keys() and all(before[tile] is tiles[tile] for tile in tiles)
