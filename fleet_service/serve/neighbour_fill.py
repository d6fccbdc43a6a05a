"""Values for cells that nobody visited, from visited neighbours: wider, and marked as borrowed. Pure.

A neighbour's road may be another road (the other side of a shadow, a bridge): half of the borrowed belief is the prior.
"""

from __future__ import annotations

from typing import Final

import numpy as np
import pyarrow as pa

from fleet_service.fusion import Fusion
from fleet_service.serve.map_state import CellView, map_batch
from schemas import grid, mugrid, tables
from schemas.numeric import IntArray

PRIOR_SHARE: Final = 0.5


def borrowed(fusion: Fusion, tile: int, slots: IntArray, route: tuple[IntArray, IntArray] | None, now: int) -> pa.Table:
    """Unvisited cells of a tile beside its visited ones, same sector; of a route only those it passes.

    Belief: half the prior, half the mean of the visited neighbours. `vehicles` is the least of theirs, so that a
    borrowed value is never more public than what it was made from; times are the newest and oldest of theirs.
    """
    beside = grid.neighbours(fusion.live.key[slots] // grid.SECTORS).reshape(-1)
    lender = np.repeat(slots, 8)
    sector = fusion.live.key[lender] % grid.SECTORS
    free = (beside >= 0) & (grid.tile_of(beside) == tile) & (fusion.slots_of(np.maximum(beside, 0), sector) < 0)
    keys, lender = (beside * grid.SECTORS + sector)[free], lender[free]
    if route is not None:
        ahead = np.isin(keys, route[0] * grid.SECTORS + route[1])
        keys, lender = keys[ahead], lender[ahead]
    if not len(keys):
        return tables.MAP_SCHEMA.empty_table()
    wanted, group = np.unique(keys, return_inverse=True)
    belief = np.zeros((len(wanted), mugrid.BINS))
    np.add.at(belief, group, fusion.beliefs(lender, now))
    belief = PRIOR_SHARE * mugrid.PRIOR + (1.0 - PRIOR_SHARE) * belief / belief.sum(axis=1, keepdims=True)
    vehicles = np.full(len(wanted), np.iinfo(np.int64).max)
    first, last = vehicles.copy(), np.zeros(len(wanted), np.int64)
    np.minimum.at(vehicles, group, fusion.live.vehicles[lender])
    np.minimum.at(first, group, fusion.live.first[lender])
    np.maximum.at(last, group, fusion.live.time[lender])
    cells = CellView(
        wanted // grid.SECTORS, wanted % grid.SECTORS, belief, None, vehicles,
        np.zeros(len(wanted), np.int64), first, last, now,
    )  # fmt: skip
    return pa.Table.from_batches([map_batch(cells)])
