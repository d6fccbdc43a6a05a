"""Low-grip alerts: raised when at least two vehicles support a firm belief, cleared with hysteresis and a reason.
Pure."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Final

import numpy as np

from fleet_service.fusion import Fusion
from fleet_service.fusion.belief import PRIOR, SLIPPERY_SHARE, quantiles
from fleet_service.fusion.store.records import GRIP, ICE, SOURCES
from fleet_service.serve.view import LOWER, UPPER
from schemas import grid
from schemas.numeric import IntArray
from schemas.thresholds import NS, SLIPPERY_MU
from schemas.wire import Alert

RAISE_ABOVE: Final = 0.9  # P(slippery)
# ... and by its own reports alone no less than without any: neighbours confirm, they do not accuse. On a road that was
# firmly dry each cell bears the doubt about a change by itself (CHANGE_LEAST), so that ice takes three passes to a half
# where the reports of all neighbours are sure. Nor do they confirm where as many found grip as ice: there the stretch
# may end, and fixes err by metres.
LIKELY: Final = float(SLIPPERY_SHARE @ PRIOR)
# Grip must be as sure as ice was: clearing too early is the dearer error, and a few liars can lower P for a while.
CLEAR_BELOW: Final = 0.05
FADE_BELOW: Final = 0.5  # ... but when nobody confirms it, it ends as soon as it is less likely than not
LEAST_SOURCES: Final = 2  # distinct vehicles that reported it themselves: one liar, or one bad sensor, moves nothing
MOST_ICE: Final = 4  # that ice ever needs: three insiders who flood a cell are too few
SOURCE_NS: Final = 3600 * NS  # ... within the hour; older ice belongs to an older road


class Alerts:
    """Set of cells under alert.

    Args:
        fusion: owner of the cells.
    """

    def __init__(self, fusion: Fusion) -> None:
        self._fusion = fusion
        self._standing: dict[int, Alert] = {}

    @property
    def slots(self) -> set[int]:
        """Return the slots under alert."""
        return set(self._standing)

    @property
    def standing_alerts(self) -> list[Alert]:
        """Return the standing alerts as they were raised."""
        return list(self._standing.values())

    def resume(self, standing: Sequence[Alert]) -> None:
        """Continue with alerts that stood before a restart."""
        slots = self._fusion.slots_of(
            np.array([a.cell for a in standing], np.int64), np.array([a.sector for a in standing], np.int64)
        )
        self._standing |= {slot: alert for slot, alert in zip(slots.tolist(), standing, strict=True) if slot >= 0}

    def renumber(self, place: IntArray) -> None:
        """Update slots after the fusion renumbered them; `place` is the new number of each. No slot under alert is
        removed."""
        self._standing = {int(place[slot]): alert for slot, alert in self._standing.items()}

    def update(self, slots: IntArray) -> list[Alert]:
        """Return the alerts that updated cells raise or clear."""
        time, slippery = self._fusion.live.time[slots], self._fusion.slippery(slots)
        standing = np.isin(slots, np.fromiter(self._standing, np.int64, len(self._standing)))
        out, likely = [], np.flatnonzero((slippery > LIKELY) & ~standing)
        ice, grip = (self._fusion.sources(slots[likely], side, time[likely] - SOURCE_NS)[0] for side in (ICE, GRIP))
        likely = likely[(ice >= LEAST_SOURCES) & ((ice > grip) | (slippery[likely] > RAISE_ABOVE))]
        alarming = self._fusion.alarming(slots[likely]) @ SLIPPERY_SHARE > RAISE_ABOVE
        likely = likely[alarming]
        believed = self._fusion.believed(slots[likely]) @ SLIPPERY_SHARE
        for k, probability in zip(likely.tolist(), believed.tolist(), strict=True):
            slot, when = int(slots[k]), int(time[k])
            if probability > RAISE_ABOVE and self._is_corroborated(slot, ICE, when):
                self._standing[slot] = self._alert(
                    slot, when, True, f"P(mu < {SLIPPERY_MU}) = {probability:.2f} > {RAISE_ABOVE}"
                )
                out.append(self._standing[slot])
        gripping = np.flatnonzero((slippery < CLEAR_BELOW) & standing).tolist()
        return out + [
            self._clear(int(slots[k]), int(time[k]), "later visits found grip")
            for k in gripping
            if self._is_corroborated(int(slots[k]), GRIP, int(time[k]))
        ]

    def _is_corroborated(self, slot: int, side: int, time: int) -> bool:
        """Return True if one side has enough corroborating sources: as many as the other within the hour, within
        limits.

        Grip counts only if it was found after the last ice.
        """
        slots, hour = np.array([slot]), time - SOURCE_NS
        against, last = self._fusion.sources(slots, GRIP if side == ICE else ICE, hour)
        found, _ = self._fusion.sources(slots, side, np.maximum(last, hour) if side == GRIP else hour)
        return bool(found[0] >= np.clip(against[0], LEAST_SOURCES, MOST_ICE if side == ICE else SOURCES))

    def expire(self, now: int) -> list[Alert]:
        """Return the alerts that expire by `now` [ns]: the belief fell below one half, and no source reported within
        the hour."""
        slots = np.array(sorted(self._standing), np.int64)
        forgotten = self._fusion.sources(slots, ICE, now - SOURCE_NS)[0] == 0
        faded = (self._fusion.beliefs(slots, now) @ SLIPPERY_SHARE < FADE_BELOW) & forgotten
        reason = "no visit has confirmed it for too long"
        return [self._clear(int(slot), now, reason) for slot in slots[faded]]

    def _clear(self, slot: int, time: int, reason: str) -> Alert:
        self._standing.pop(slot, None)
        return self._alert(slot, time, False, reason)

    def _alert(self, slot: int, time: int, raised: bool, reason: str) -> Alert:
        fusion = self._fusion
        cell, sector = divmod(int(fusion.live.key[slot]), grid.SECTORS)
        belief = fusion.beliefs(np.array([slot]), time)
        latitude, longitude = grid.centre(cell)
        lower, mu, upper = quantiles(belief, (LOWER, 0.5, UPPER))[:, 0].tolist()
        return Alert(
            cell=cell, sector=sector, raised=raised, time=time, mu=mu, mu_lower=lower, mu_upper=upper,
            p_slippery=float(belief[0] @ SLIPPERY_SHARE), vehicles=int(fusion.live.vehicles[slot]),
            latitude=float(latitude), longitude=float(longitude), reason=reason,
        )  # fmt: skip
