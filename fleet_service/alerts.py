"""Low-grip alerts: raised on firm belief of at least two vehicles, cleared with hysteresis and a reason. Pure."""

from __future__ import annotations

from typing import Final

import numpy as np

from fleet_service.fusion import Fusion
from fleet_service.fusion.belief import SLIPPERY_SHARE
from fleet_service.fusion.window import witnesses
from schemas import grid, mugrid
from schemas.numeric import IntArray
from schemas.wire import Alert

RAISE_ABOVE: Final = 0.9  # P(slippery)
# Grip must be as sure as ice was: clearing too early is the dearer error, and a few liars can lower P for a while.
CLEAR_BELOW: Final = 0.05
FADE_BELOW: Final = 0.5  # ... but when nobody confirms it, it ends as soon as it is less likely than not
WITNESSES: Final = (
    2  # distinct vehicles that called it slippery themselves: one liar, or one bad sensor, raises nothing
)
# Where the map rests on so many values, it takes one witness more to turn it over. With two, and six of sixty vehicles
# sending random values, a town in five had a false alert (of five that were tried).
FIRM_VALUES: Final = 5.0
WITNESS_NS: Final = 3600 * 10**9  # ... within the hour; older ice belongs to an older road


class Alerts:
    """Which cells are under an alert.

    Args:
        fusion: whose cells they are.
    """

    def __init__(self, fusion: Fusion) -> None:
        self._fusion = fusion
        self.raised: set[int] = set()

    def folded(self, slots: IntArray) -> list[Alert]:
        """Alerts that the cells just folded into raise or clear."""
        fusion = self._fusion
        time = fusion.live.time[slots]
        slippery = fusion.live.belief[slots] @ SLIPPERY_SHARE
        out = []
        for k in np.flatnonzero(slippery > RAISE_ABOVE).tolist():
            slot = int(slots[k])
            if slot in self.raised:
                continue
            needed = WITNESSES + (fusion.live.values[slot] >= FIRM_VALUES)
            if witnesses(fusion.live, slots[k : k + 1], int(time[k]) - WITNESS_NS)[0] >= needed:
                self.raised.add(slot)
                out.append(self._alert(slot, int(time[k]), True, f"P(mu < 0.4) = {slippery[k]:.2f} > {RAISE_ABOVE}"))
        down = np.flatnonzero(slippery < CLEAR_BELOW).tolist() if self.raised else []
        reason = "later visits found grip"
        return out + [self._clear(int(slots[k]), int(time[k]), reason) for k in down if int(slots[k]) in self.raised]

    def faded(self, now: int) -> list[Alert]:
        """Alerts that time alone cleared until `now` [ns]: what was likely has faded, or what is contested is old."""
        slots = np.array(sorted(self.raised), np.int64)
        live = self._fusion.live
        likely = live.belief[slots] @ SLIPPERY_SHARE >= FADE_BELOW
        forgotten = witnesses(live, slots, now - WITNESS_NS) == 0
        faded = (self._fusion.beliefs(slots, now) @ SLIPPERY_SHARE < FADE_BELOW) & (likely | forgotten)
        reason = "no visit has confirmed it for too long"
        return [self._clear(int(slot), now, reason) for slot in slots[faded]]

    def _clear(self, slot: int, time: int, reason: str) -> Alert:
        self.raised.discard(slot)
        return self._alert(slot, time, False, reason)

    def _alert(self, slot: int, time: int, raised: bool, reason: str) -> Alert:
        fusion = self._fusion
        cell = int(fusion.cell[slot])
        belief = fusion.beliefs(np.array([slot]), time)[0]
        latitude, longitude = grid.centre(cell)
        mu, lower, upper = (float(mugrid.quantiles(belief, q)) for q in (0.5, 0.05, 0.95))
        return Alert(
            cell, int(fusion.sector[slot]), raised, time, mu, lower, upper, float(belief @ SLIPPERY_SHARE),
            int(fusion.live.vehicles[slot]), float(latitude), float(longitude), reason,
        )  # fmt: skip
