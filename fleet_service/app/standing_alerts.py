"""Alerts that stand, for publication: by tile, in turn for late clients, and their ends."""

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
    """Standing alerts of a running service.

    Args:
        shared: state of the service.
    """

    def __init__(self, shared: SharedState) -> None:
        self._shared = shared
        self._turn = 0  # of the alerts that are repeated
        self._erased: list[
            Alert
        ] = []  # alerts that ended by erasure; their end is not published yet

    @property
    def count(self) -> int:
        """Return the number of cells under alert."""
        return len(self._shared.state.alerts.slots)

    @property
    def slots(self) -> IntArray:
        """Return the slots under alert, (k,)."""
        return np.array(sorted(self._shared.state.alerts.slots), np.int64)

    @property
    def all(self) -> list[Alert]:
        """Return the standing alerts."""
        return self._shared.state.alerts.standing_alerts

    def encode_tiles(self, is_wanted: Callable[[int], bool]) -> list[tuple[int, bytes]]:
        """Return tile and payload of the standing alerts of selected tiles."""
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
        """Return at most `most` standing alerts, in turn, so that clients that were away receive
        them too.
        """
        with self._shared.guard:
            standing = self.all
        self._turn = self._turn % max(len(standing), 1)
        out = standing[self._turn : self._turn + most]
        self._turn += len(out)
        return out

    def end_erased(self, before: Iterable[Alert]) -> None:
        """End those of the alerts `before` an erasure that do not stand any more; call with the
        guard held.
        """
        still = {(alert.cell, alert.sector) for alert in self.all}
        ended = [alert for alert in before if (alert.cell, alert.sector) not in still]
        self._erased += [replace(alert, raised=False, reason=ERASED) for alert in ended]

    def expire(self, now: int) -> list[Alert]:
        """Return the ends of the alerts that expired or were erased, at `now` [ns]."""
        with self._shared.guard:
            ended = [replace(alert, time=now) for alert in self._erased]
            self._erased = []
            return ended + self._shared.state.alerts.expire(now)
