"""Low-grip alerts: raised when at least two vehicles support a firm belief, cleared with hysteresis
and a reason. Pure."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Final

import numpy as np

from fleet_service.fusion import Fusion
from fleet_service.fusion.belief import PRIOR, SLIPPERY_SHARE, quantiles
from fleet_service.fusion.store.records import GRIP, ICE
from fleet_service.serve.idle_roads import OTHERS_NEEDED, IdleRoads
from fleet_service.serve.view import LOWER, UPPER, coarse_counts
from schemas import grid
from schemas.numeric import BoolArray, IntArray
from schemas.thresholds import NS, SLIPPERY_MU
from schemas.wire import Alert

RAISE_ABOVE: Final = 0.9  # P(slippery)
# ... and by its own reports alone no less than without any: neighbours confirm, they do not accuse.
LIKELY: Final = float(SLIPPERY_SHARE @ PRIOR)
CLEAR_BELOW: Final = 0.05  # grip must be as sure as ice was: clearing too early is the dearer error
# an alert without confirmation ends as soon as ice is less likely than grip
FADE_BELOW: Final = 0.5
# distinct vehicles that reported it themselves: one liar, or one bad sensor, moves nothing
LEAST_SOURCES: Final = 2
# ... and one more for each opposite source that is not older than they are by this: a road changes,
# so that earlier visits do not contradict it. With one minute instead of ten, three trusted
# vehicles that flood a dry cell raised an alert in two of six tuning towns; with ten in none.
FRESH_NS: Final = 600 * NS
MOST_SOURCES: Final = 4
CLEAR_SOURCES: Final = (4, 5)  # ... that grip needs to end an alert: at least and at most
SOURCE_NS: Final = 3600 * NS  # sources count for an hour; older ice belongs to an older road
TIME_STEP_NS: Final = 60 * NS  # of alerts where persons are kept private
QUIET_NS: Final = 1800 * NS  # an alert whose ice nobody confirmed for so long may fade


class Alerts:
    """Set of cells under alert.

    Args:
        fusion: owner of the cells.
        idle_roads: limit on alerts on roads where only the witnesses drive; None for no limit, in
            simulations.
        is_private: True if times and numbers of vehicles are given in steps.
    """

    def __init__(
        self, fusion: Fusion, idle_roads: IdleRoads | None = None, *, is_private: bool = False
    ) -> None:
        self._fusion = fusion
        self._is_private = is_private
        self._idle_roads = idle_roads
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
            np.array([a.cell for a in standing], np.int64),
            np.array([a.sector for a in standing], np.int64),
        )
        self._standing |= {
            slot: alert for slot, alert in zip(slots.tolist(), standing, strict=True) if slot >= 0
        }

    def renumber(self, place: IntArray) -> None:
        """Update slots after the fusion renumbered them; `place` is the new number of each. No slot
        under alert is removed."""
        self._standing = {int(place[slot]): alert for slot, alert in self._standing.items()}

    def update(self, slots: IntArray) -> list[Alert]:
        """Return the alerts that updated cells raise or clear."""
        time = self._fusion.live.time[slots]
        slippery = self._fusion.slippery(slots)
        standing = np.isin(slots, np.fromiter(self._standing, np.int64, len(self._standing)))
        likely = np.flatnonzero((slippery > LIKELY) & ~standing)
        likely = likely[self._have_witnesses(slots[likely], ICE, time[likely])]
        likely = likely[
            self._fusion.beliefs_for_alerts(slots[likely]) @ SLIPPERY_SHARE > RAISE_ABOVE
        ]
        believed = self._fusion.beliefs_at_last_report(slots[likely]) @ SLIPPERY_SHARE
        out = []
        for k, probability in zip(likely.tolist(), believed.tolist(), strict=True):
            slot = int(slots[k])
            when = int(time[k])
            if probability > RAISE_ABOVE and self._is_admitted(slot, when):
                reason = f"P(mu < {SLIPPERY_MU}) = {probability:.2f} > {RAISE_ABOVE}"
                self._standing[slot] = self._alert(slot, when, True, reason)
                out.append(self._standing[slot])
        gripping = np.flatnonzero((slippery < CLEAR_BELOW) & standing)
        gripping = gripping[self._have_witnesses(slots[gripping], GRIP, time[gripping])]
        reason = "later visits measured good grip"
        return out + [self._clear(int(slots[k]), int(time[k]), reason) for k in gripping.tolist()]

    def _is_admitted(self, slot: int, time: int) -> bool:
        """Return False on an idle road if its witnesses have supported alerts in too many other
        places lately.
        """
        live = self._fusion.live
        if self._idle_roads is None or live.vehicles[slot] >= OTHERS_NEEDED:
            return True
        witnesses = self._fusion.witnesses(slot, ICE, time - SOURCE_NS)
        return self._idle_roads.admit(
            int(live.key[slot]) // grid.SECTORS, witnesses, time, LEAST_SOURCES
        )

    def _have_witnesses(self, slots: IntArray, side: int, time: IntArray) -> BoolArray:
        """Return True for slots (k,) with enough corroborating sources of a side at `time` (k,)
        [ns].

        The least number of them, and one more for each opposite source that is newer than the
        second newest of them less FRESH_NS, up to the most.
        """
        found = self._fusion.sources(slots, side, time - SOURCE_NS)
        against = self._fusion.sources(slots, GRIP if side == ICE else ICE, time - SOURCE_NS)
        opposed = (against > found[:, 1:2] - FRESH_NS).sum(axis=1)
        least, most = (LEAST_SOURCES, MOST_SOURCES) if side == ICE else CLEAR_SOURCES
        needed = np.minimum(least + opposed, most)
        return np.asarray((found > 0).sum(axis=1) >= needed)

    def expire(self, now: int) -> list[Alert]:
        """Return the alerts that expire by `now` [ns]: less likely than not, and not confirmed
        for QUIET_NS.
        """
        slots = np.array(sorted(self._standing), np.int64)
        forgotten = self._fusion.sources(slots, ICE, now - QUIET_NS)[:, 0] == 0
        faded = (self._fusion.beliefs(slots, now) @ SLIPPERY_SHARE < FADE_BELOW) & forgotten
        reason = "no recent visit has confirmed the alert"
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
        vehicles = int(fusion.live.vehicles[slot])
        if self._is_private:
            vehicles = int(coarse_counts(np.array([vehicles]))[0])
            time = time // TIME_STEP_NS * TIME_STEP_NS
        return Alert(
            cell=cell,
            sector=sector,
            raised=raised,
            time=time,
            mu=mu,
            mu_lower=lower,
            mu_upper=upper,
            p_slippery=float(belief[0] @ SLIPPERY_SHARE),
            vehicles=vehicles,
            latitude=float(latitude),
            longitude=float(longitude),
            reason=reason,
        )
