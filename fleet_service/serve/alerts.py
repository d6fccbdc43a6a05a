"""Low-friction alerts. An alert is raised when at least two vehicles reported ice and the cell is
slippery with high probability. The alert is cleared only when the probability has clearly fallen
(hysteresis). The message about its end states a reason. Pure (no I/O).
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Final

import numpy as np

from fleet_service.fusion import Fusion, constants
from fleet_service.fusion.belief import PRIOR, quantiles
from fleet_service.fusion.store.records import NONE, SOURCES, Side
from fleet_service.fusion.witnesses import stretch_slots, stretch_sources, witnesses_of
from fleet_service.serve.idle_roads import OTHERS_NEEDED, IdleRoads
from fleet_service.serve.view import LOWER, UPPER, coarse_counts
from schemas import grid, mugrid
from schemas.numeric import BoolArray, IntArray
from schemas.thresholds import CALLED_SHARE, NS, SLIPPERY_MU
from schemas.wire import Alert

# P(slippery) from which an alert is raised. Of 20 tuning fleets on winter tyres that drove gently
# through a wet curve, one raised a false alert with .9 and nine with .8. With .7, alerts covered
# .96 of the slippery cell-minutes of the towns mentioned at LEAST_SOURCES.
RAISE_ABOVE: Final = CALLED_SHARE
# Smallest P(slippery) from the cell's own reports with which an alert may be raised: that of the
# prior.
LIKELY: Final = float(mugrid.SLIPPERY_SHARE @ PRIOR)
# P(slippery) below which an alert is cleared. It is stricter than raising, because clearing too
# early is the more serious error.
CLEAR_BELOW: Final = 0.05
# P(slippery) below which an alert without confirmation ends: grip is then more likely than ice.
FADE_BELOW: Final = 0.5
# Smallest number of vehicles that reported ice, so that one lying vehicle or one bad sensor raises
# no alert. They may have reported it on the stretch, or in the cell only if a source of grip
# opposes. In eight tuning towns, alerts covered .926 of the slippery cell-minutes with stretches,
# .907 without. A stretch includes the other direction of the road: with it, ten tuning drives of
# the demo needed 3.2 passes until an alert (mean of the drives' medians), and 3.6 without.
LEAST_SOURCES: Final = 2
# [ns] MOST_SOURCES sources of ice in the cell are needed, unless every source of grip is older than
# the second newest source of ice by at least this. Earlier sources of grip do not contradict ice,
# because roads change. With one minute instead of ten, three trusted vehicles that flood a dry cell
# raised an alert in two of six tuning towns.
FRESH_NS: Final = 600 * NS
MOST_SOURCES: Final = 2 * LEAST_SOURCES
TIME_STEP_NS: Final = 60 * NS  # [ns] alert times are rounded to this if persons are kept private
QUIET_NS: Final = 1800 * NS  # [ns] an alert may fade if no vehicle has confirmed ice for this time


class Alerts:
    """Cells that have an active alert, and the rules by which alerts begin and end.

    Args:
        fusion: owner of the cells, that is, the beliefs about the friction of all cells.
        idle_roads: rule that limits in how many places a vehicle may support alerts on roads
            without other traffic; None for no limit, in simulations.
        is_private: True if times and numbers of vehicles are rounded for privacy.
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
        """Return the slots (cell and heading sector) that have an active alert."""
        return set(self._standing)

    @property
    def standing_alerts(self) -> list[Alert]:
        """Return the active alerts with the content that they had when they were raised."""
        return list(self._standing.values())

    def resume(self, standing: Sequence[Alert]) -> None:
        """Take over the alerts that were active before a restart of the service."""
        slots = self._fusion.slots_of(
            np.array([a.cell for a in standing], np.int64),
            np.array([a.sector for a in standing], np.int64),
        )
        self._standing |= {
            slot: alert for slot, alert in zip(slots.tolist(), standing, strict=True) if slot >= 0
        }

    def renumber(self, place: IntArray) -> None:
        """Update the slot numbers of active alerts after the slots were renumbered; `place`
        contains the new number of each slot. A slot with an active alert must not have been
        removed.
        """
        self._standing = {int(place[slot]): alert for slot, alert in self._standing.items()}

    def update(self, slots: IntArray) -> list[Alert]:
        """Return the alerts that are raised or cleared because the given slots, (k,), were
        updated.
        """
        slippery = self._fusion.slippery(slots)
        standing = np.isin(slots, np.fromiter(self._standing, np.int64, len(self._standing)))
        gripping = slots[(slippery < CLEAR_BELOW) & standing]
        icy = slots[slippery > LIKELY]
        icy = icy[self._own_sources(icy, Side.ICE)[:, 0] > 0]
        raised = self._raise_likely(icy, slots) if len(icy) else []
        cleared = gripping[self._can_clear(gripping)] if len(gripping) else gripping
        reason = "later visits measured good grip"
        times = self._fusion.live.time[cleared].tolist()
        return raised + [
            self._clear(slot, time, reason)
            for slot, time in zip(cleared.tolist(), times, strict=True)
        ]

    def _raise_likely(self, icy: IntArray, updated: IntArray) -> list[Alert]:
        """Return the alerts that are raised because the slots `icy`, (k,), were updated, in which
        vehicles reported ice. They are some of the slots `updated`, (n,).
        """
        likely = self._suspects(icy)
        likely = likely[
            self._fusion.beliefs_for_alerts(likely) @ mugrid.SLIPPERY_SHARE > RAISE_ABOVE
        ]
        p_slippery = self._fusion.beliefs_at_last_report(likely) @ mugrid.SLIPPERY_SHARE
        # An alert that an update of a neighbouring cell causes gets the newest time of the update.
        time = self._fusion.live.time
        raised = np.where(np.isin(likely, updated), time[likely], time[updated].max(initial=0))
        out = []
        for slot, when, probability in zip(
            likely.tolist(), raised.tolist(), p_slippery.tolist(), strict=True
        ):
            if probability > RAISE_ABOVE and self._is_admitted(slot, when):
                reason = f"P(mu < {SLIPPERY_MU}) = {probability:.2f} > {RAISE_ABOVE}"
                self._standing[slot] = self._alert(slot, when, True, reason)
                out.append(self._standing[slot])
        return out

    def _is_admitted(self, slot: int, time: int) -> bool:
        """Return True if the limit for idle roads permits an alert. A road is idle if fewer than
        OTHERS_NEEDED vehicles have ever reported it. On other roads there is no limit.

        On an idle road, at least LEAST_SOURCES of the vehicles that reported the ice must be below
        their own limit. A vehicle has reached its limit if its reports have recently led to alerts
        on idle roads in several other areas (see `IdleRoads`).
        """
        live = self._fusion.live
        if self._idle_roads is None or live.vehicles[slot] >= OTHERS_NEEDED:
            return True
        witnesses = witnesses_of(self._fusion, slot, time - constants.SOURCE_NS)
        return self._idle_roads.admit(
            int(live.key[slot]) // grid.SECTORS, witnesses, time, LEAST_SOURCES
        )

    def _suspects(self, slots: IntArray) -> IntArray:
        """Return the slots that are candidates for a new alert. A "source" of a slot is a vehicle
        that reported ice there within the hour before the slot's last report.

        The given `slots` (k,) all have a source. They are checked, and also the other slots on the
        same slippery stretches of road. Slots with an active alert are left out. A slot becomes a
        candidate if both conditions hold:

        1. The slot itself or its stretch has enough sources. More are needed in a slot where
           vehicles also reported grip.
        2. The ice is in this slot. This is assumed in two cases: either the slot has a source of
           its own and its own reports make slippery road probable, or the stretch has sources both
           before and behind the slot.
        """
        fusion = self._fusion
        candidates = np.unique(stretch_slots(fusion, slots))
        candidates = candidates[candidates != NONE]
        candidates = candidates[
            ~np.isin(candidates, np.fromiter(self._standing, np.int64, len(self._standing)))
        ]
        own = self._own_sources(candidates, Side.ICE)
        against = self._own_sources(candidates, Side.GRIP)
        opposed = against[:, 0] > own[:, 1] - FRESH_NS
        needed = np.where(opposed, MOST_SOURCES, LEAST_SOURCES)
        enough = (own > 0).sum(axis=1) >= needed
        along = stretch_sources(
            fusion, candidates, fusion.live.time[candidates] - constants.SOURCE_NS
        )
        enough |= (along.second > 0) & (against[:, 0] <= along.second - FRESH_NS)
        accused = (own[:, 0] > 0) & (fusion.slippery(candidates) > LIKELY)
        return np.asarray(candidates[enough & (accused | along.around)])

    def _own_sources(self, slots: IntArray, side: Side) -> IntArray:
        """Return the report times [ns] of the vehicles that support one `side` (ice or grip) in
        each slot, (k, SOURCES); 0 means no vehicle. Only reports within the hour before the slot's
        last report count.
        """
        return self._fusion.sources(
            slots, side, self._fusion.live.time[slots] - constants.SOURCE_NS
        )

    def _can_clear(self, slots: IntArray) -> BoolArray:
        """Return a mask of slots, (k,): True if the alert may be cleared. Within the hour before
        the last report, at least two more vehicles must have reported grip than ice.

        The map remembers at most SOURCES vehicles per slot that reported grip, and at most SOURCES
        that reported ice. Therefore SOURCES vehicles that reported grip always suffice, because a
        larger number cannot be recorded.
        """
        grip = (self._own_sources(slots, Side.GRIP) > 0).sum(axis=1)
        ice = (self._own_sources(slots, Side.ICE) > 0).sum(axis=1)
        return np.asarray(grip >= np.minimum(ice + 2, SOURCES))

    def expire(self, now: int) -> list[Alert]:
        """Return the end messages of alerts that expire by `now` [ns], because the road is slippery
        with a probability below one half and no vehicle has confirmed ice for QUIET_NS.
        """
        slots = np.array(sorted(self._standing), np.int64)
        forgotten = self._fusion.sources(slots, Side.ICE, now - QUIET_NS)[:, 0] == 0
        faded = (self._fusion.beliefs(slots, now) @ mugrid.SLIPPERY_SHARE < FADE_BELOW) & forgotten
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
            p_slippery=float(belief[0] @ mugrid.SLIPPERY_SHARE),
            vehicles=vehicles,
            latitude=float(latitude),
            longitude=float(longitude),
            reason=reason,
        )
