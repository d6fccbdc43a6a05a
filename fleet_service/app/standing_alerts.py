"""Active ("standing") alerts of a service, prepared for publication.

- A query is answered with all active alerts of each queried tile (map square).
- Active alerts are published again in turn, so that clients that connect later receive them.
- When an alert ends, a message that states its end is published.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import replace
from typing import Final

import numpy as np

from fleet_service.app.state import SharedState
from schemas import grid, wire
from schemas.numeric import IntArray
from schemas.wire import Alert

ERASED: Final = "the reports behind the alert were erased"


class StandingAlerts:
    """Active alerts of a running service.

    Args:
        shared: state of the service.
    """

    def __init__(self, shared: SharedState) -> None:
        self._shared = shared
        self._turn = 0  # position of the next alert to repeat
        # alerts that ended because their data were erased, and whose end is not published yet
        self._erased: list[Alert] = []

    @property
    def count(self) -> int:
        """Return the number of slots (cell and heading sector) with an active alert."""
        return len(self._shared.state.alerts.slots)

    @property
    def slots(self) -> IntArray:
        """Return the slots with an active alert, (k,)."""
        return np.array(sorted(self._shared.state.alerts.slots), np.int64)

    @property
    def all(self) -> list[Alert]:
        """Return all active alerts of the service."""
        return self._shared.state.alerts.standing_alerts

    def encode_tiles(self, is_wanted: Callable[[int], bool]) -> list[tuple[int, bytes]]:
        """Return (tile number, payload) for each tile that has active alerts and that `is_wanted`
        accepts.
        """
        tiles: dict[int, list[Alert]] = {}
        with self._shared.guard:
            for alert in self.all:
                tiles.setdefault(int(grid.tile_of(alert.cell)), []).append(alert)
        return [
            (tile, wire.encode_standing(alerts))
            for tile, alerts in tiles.items()
            if is_wanted(tile)
        ]

    def next_to_repeat(self, most: int) -> list[Alert]:
        """Return at most `most` active alerts to publish again. Successive calls go through all
        alerts, so clients that were offline receive them too.
        """
        with self._shared.guard:
            standing = self.all
        self._turn = self._turn % max(len(standing), 1)
        out = standing[self._turn : self._turn + most]
        self._turn += len(out)
        return out

    def end_erased(self, before: Iterable[Alert]) -> None:
        """Prepare the end messages of alerts that an erasure of data has removed. `expire` returns
        these messages. The caller must hold the lock of the shared state.

        `before` contains the alerts that were active before the erasure. Those that are missing
        from the active alerts now were removed.
        """
        active = {(alert.cell, alert.sector) for alert in self.all}
        ended = [alert for alert in before if (alert.cell, alert.sector) not in active]
        self._erased += [replace(alert, raised=False, reason=ERASED) for alert in ended]

    def expire(self, now: int) -> list[Alert]:
        """Return the messages that end those alerts which have expired by `now` [ns] or were
        erased.
        """
        with self._shared.guard:
            ended = [replace(alert, time=now) for alert in self._erased]
            self._erased = []
            return ended + self._shared.state.alerts.expire(now)
