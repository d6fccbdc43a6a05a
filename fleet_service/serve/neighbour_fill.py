"""Imputation: beliefs of cells that nobody visited, from visited neighbours: wider, and marked as borrowed. Pure.

A neighbour's road may be another road (the other side of a shadow, a bridge): half of the imputed belief is the prior.
"""

from __future__ import annotations

from typing import Final

import numpy as np

from fleet_service.fusion import Fusion
from fleet_service.serve.view import CellView
from schemas import grid, mugrid
from schemas.numeric import IntArray

PRIOR_SHARE: Final = 0.5


def impute(fusion: Fusion, tile: int, slots: IntArray, route: IntArray | None, now: int) -> CellView:
    """Unvisited cells of a tile that adjoin its visited `slots`, same sector; of a route's keys only those it passes.

    Belief: half the prior, half the mean of the visited neighbours. `vehicles` is the least of theirs, so that an
    imputed value is never more public than what it was made from; times are the newest and oldest of theirs.
    """
    live = fusion.live
    near = grid.neighbours(live.key[slots] // grid.SECTORS).reshape(-1)
    visited = np.repeat(slots, 8)
    sector = live.key[visited] % grid.SECTORS
    free = (near >= 0) & (grid.tile_of(near) == tile) & (fusion.slots_of(np.maximum(near, 0), sector) < 0)
    keys, visited = (near * grid.SECTORS + sector)[free], visited[free]
    if route is not None:
        ahead = np.isin(keys, route)
        keys, visited = keys[ahead], visited[ahead]
    wanted, group = np.unique(keys, return_inverse=True)
    belief = np.zeros((len(wanted), mugrid.BINS))
    np.add.at(belief, group, fusion.beliefs(visited, now))
    vehicles = np.full(len(wanted), np.iinfo(np.int64).max)
    first, last = vehicles.copy(), np.zeros(len(wanted), np.int64)
    np.minimum.at(vehicles, group, live.vehicles[visited])
    np.minimum.at(first, group, live.first[visited])
    np.maximum.at(last, group, live.time[visited])
    return CellView(
        cell=wanted // grid.SECTORS, sector=wanted % grid.SECTORS,
        belief=PRIOR_SHARE * mugrid.PRIOR + (1.0 - PRIOR_SHARE) * belief / belief.sum(axis=1, keepdims=True),
        values=np.zeros(len(wanted), np.float32), vehicles=vehicles, observations=np.zeros(len(wanted), np.int64),
        first=first, last=last, imputed=np.ones(len(wanted), bool),
    )  # fmt: skip
