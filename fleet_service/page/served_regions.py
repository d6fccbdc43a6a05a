"""Regions of the map, and for which of them a fleet service answers.

Zenoh tells whether a queryable matches a key expression, so no query is sent.
"""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any, Final

import zenoh

from fleet_service.page.map_mirror import box_of
from schemas import grid, keys, regions
from schemas.runtime.presence import PresenceTracker

MOST: Final = 256  # largest number of watched regions


class ServedRegions:
    """Regions whose cells the page shows, and regions whose service disappeared before the page
    knew one of their cells.
    """

    def __init__(self) -> None:
        self._queriers: dict[int, Any] = {}
        self._away_since: dict[int, float] = {}
        # regions that no service announces any more, and since when [s since 1970]
        self._fallen: dict[str, float] = {}

    def watch(self, session: zenoh.Session, tiles: Iterable[int], now: float) -> None:
        """Watch the regions of the given tiles too, and record at time `now` [s since 1970] for
        which regions no service answers.
        """
        for region in {int(grid.parent(tile, grid.REGION_ZOOM, grid.TILE_ZOOM)) for tile in tiles}:
            if region not in self._queriers and len(self._queriers) < MOST:
                expression = f"{keys.ROOT}/map/{keys.chunks(region, grid.REGION_ZOOM)}/*"
                self._queriers[region] = session.declare_querier(expression)
        for region in self._queriers:
            if self.is_answered(region):
                self._away_since.pop(region, None)
            else:
                self._away_since.setdefault(region, now)

    def note_fallen(self, services: PresenceTracker, now: float) -> None:
        """Record regions that no service announces any more and of which the page knows no cells.
        Regions with known cells need no record, because queries about these cells show if a service
        answers.
        """
        served = {token.region for token in services.active}
        known = [keys.chunks(region, grid.REGION_ZOOM) for region in self._queriers]

        def is_fallen(region: str) -> bool:
            if not region.startswith(tuple("0123")):  # the whole map
                return False
            is_served = any(regions.covers(one, region) for one in served)
            has_cells = any(regions.overlap(one, region) for one in known)
            return not is_served and not has_cells

        lost = {token.region for token in services.lost_tokens}
        fallen = {region for region in lost if is_fallen(region)}
        self._fallen = {region: self._fallen.get(region, now) for region in fallen}

    def is_answered(self, region: int) -> bool:
        """Return True if a service answers for a watched region."""
        querier = self._queriers.get(region)
        return querier is not None and bool(querier.matching_status.matching)

    @property
    def is_any_answered(self) -> bool:
        """Return True if a service answers for any watched region."""
        return any(self.is_answered(region) for region in self._queriers)

    def as_json(self) -> list[dict[str, Any]]:
        """Return each region in a form for JSON: its box, True if a service answers for the region,
        and otherwise the time [s since 1970] since which no service answers.
        """
        watched = [
            {
                "region": grid.quadkey(region, grid.REGION_ZOOM),
                "box": box_of(region, grid.REGION_ZOOM),
                "served": region not in self._away_since,
                "since": self._away_since.get(region),
            }
            for region in list(self._queriers)
        ]
        fallen = [
            {"region": region, "box": _box_of_expression(region), "served": False, "since": since}
            for region, since in self._fallen.copy().items()
        ]
        return watched + fallen


def _box_of_expression(region: str) -> list[float]:
    """Return the square that contains all regions which a region expression (Zenoh key pattern that
    selects regions) matches: west, south, east, north [deg]. The digits before the first `*` of the
    expression determine the square.
    """
    digits = region.partition("*")[0].replace("/", "")
    return box_of(grid.from_quadkey(digits), len(digits))
