"""Beliefs of all cells in the state after the last update, and the functions that read them. The
module is pure (no I/O).
"""

from __future__ import annotations

from typing import Final

import numpy as np

from fleet_service.fusion import constants
from fleet_service.fusion.belief import unpack_belief
from fleet_service.fusion.neighbours import ReadRule, road_beliefs
from fleet_service.fusion.observations import SmallArray
from fleet_service.fusion.shared import KERNELS, UNKNOWN_SHAPE, read_slippery, shape_class
from fleet_service.fusion.store.cells import Cells
from fleet_service.fusion.store.records import NONE, Rows, Side
from fleet_service.fusion.store.store import Store
from fleet_service.fusion.vote_weights import VoteWeights
from fleet_service.fusion.weather import Weather
from schemas import grid, mugrid
from schemas.numeric import FloatArray, IntArray
from schemas.runtime.jit import refcount_free_locked
from schemas.thresholds import NS

# Contribution of each bin of a stored belief to P(slippery) of the road, and to the sum of its
# probabilities. One array (kernels, 2, 32) per slope in `shared.SHAPES`.
SLIPPERY_WEIGHTS: Final = tuple(
    np.stack([k @ mugrid.SLIPPERY_SHARE, k.sum(axis=2, dtype=float)], axis=1) for k in KERNELS
)


class BeliefMap:
    """Beliefs of all cells, and the trust in the vehicles that reported them. `Fusion` updates
    them. A slot is the storage of one cell and heading sector.

    Attributes:
        store: cells, recent observations per cell, records per vehicle and cell, and vehicles.
        vote_weights: trust in the vehicles over time. Each item contains the weights of the
            vehicles' reports from one minute (epoch) on; the oldest item comes first.
    """

    def __init__(self, store: Store, vote_weights: list[VoteWeights], weather: Weather) -> None:
        self.store = store
        self.vote_weights = vote_weights
        self._weather = weather
        self._shape = UNKNOWN_SHAPE

    @property
    def live(self) -> Cells:
        """Return the current state of all cells (belief, counts, times) as columns; only the first
        `size` rows are in use.
        """
        return self.store.live

    @property
    def size(self) -> int:
        """Return the number of slots in use; a slot is the storage of one cell and heading
        sector.
        """
        return self.store.size

    @property
    def cell(self) -> IntArray:
        """Return the cell number of every slot (stored cell and heading sector), (size,)."""
        return self.live.key[: self.size] // grid.SECTORS

    @property
    def sector(self) -> SmallArray:
        """Return the heading sector of every slot, (size,)."""
        return (self.live.key[: self.size] % grid.SECTORS).astype(np.int8)

    def beliefs(self, slots: IntArray, now: int, rows: Rows | None = None) -> FloatArray:
        """Return the belief about the road (32 probabilities of μ) for each slot, (k, 32),
        predicted to `now` [ns]. It includes the evidence of slippery neighbouring cells, which is
        weaker if visits to the cell itself gave no friction value. If `rows` is given, read this
        copy of the state instead of the live one.
        """
        rows = self.store.state.live if rows is None else rows
        rule = _rule_of(self._shape.reader, constants.SILENCE, narrow=True)
        at = np.full(len(slots), now)
        return road_beliefs(rows, self.store.table, self._weather, rule, slots, at)

    def beliefs_at_last_report(self, slots: IntArray) -> FloatArray:
        """Return the belief about the road (32 probabilities of μ) for each slot, (k, 32), at the
        time of the slot's last observation.
        """
        return self._read_for_alerts(self._shape.reader, slots)

    def slippery(self, slots: IntArray) -> FloatArray:
        """Return P(slippery) for each slot, (k,), at its last observation, from reports of this
        cell alone (without neighbours).
        """
        out = np.empty(len(slots))
        weights = SLIPPERY_WEIGHTS[shape_class(self._shape.reader)]
        _write_slippery(self.store.state.live, weights, slots, np.empty(mugrid.BINS), out)
        return out

    def beliefs_for_alerts(self, slots: IntArray) -> FloatArray:
        """Return the belief about the road (32 probabilities of μ) for each slot, (k, 32), at its
        last observation.

        A vehicle that used little grip may report too low a friction. For alerts this error is
        assumed to be larger than for other readers, so that an alert needs stronger evidence of
        ice. The assumed error per unit of unused grip is `shared.Shape.alarm`.
        """
        return self._read_for_alerts(self._shape.alarm, slots)

    def _read_for_alerts(self, slope: float, slots: IntArray) -> FloatArray:
        """Return the belief about the road for each slot, (k, 32), at its last observation. `slope`
        is the assumed error of a value per unit of unused grip.

        Visits without a friction value do not weaken the evidence of neighbouring cells here. So a
        cell between icy cells gets an alert even if its own visitors gave no value.
        """
        rule = _rule_of(slope, 0.0, narrow=False)
        rows = self.store.state.live
        at = self.live.time[slots]
        return road_beliefs(rows, self.store.table, self._weather, rule, slots, at)

    def slots_of(self, cell: IntArray, sector: IntArray | SmallArray) -> IntArray:
        """Return the slot (row number) (n,) of each pair of cell and sector; -1 if no vehicle has
        reported the pair.
        """
        return self.store.slots_of(cell * grid.SECTORS + sector)

    def trust(self, vehicle: int) -> float:
        """Return the weight that the next report of a vehicle will have in the map's beliefs about
        friction. The weight depends on the vehicle's agreement with other vehicles; 0 means no
        trust.
        """
        return float(self.vote_weights[-1].weights(self._index(vehicle))[0])

    def _index(self, vehicle: int) -> IntArray:
        index = self.store.known(np.array([vehicle]))
        return np.where(index < 0, self.store.vehicles, index)

    def sources(self, slots: IntArray, side: Side, since: IntArray | int) -> IntArray:
        """Return the report times [ns] of the vehicles that reported ice or grip (`side`) in each
        slot, (k, SOURCES), newest first.

        Only reports after `since` [ns] by vehicles that are still trusted count. At most SOURCES
        vehicles per slot are stored; time 0 means no vehicle.
        """
        _, when = self.find_sources(slots, side, since)
        return -np.sort(-when, axis=1)

    def find_sources(
        self, slots: IntArray, side: Side, since: IntArray | int
    ) -> tuple[IntArray, IntArray]:
        """Return the vehicles that reported ice or grip (`side`) in the slots, as two arrays (k,
        SOURCES): index of the vehicle, and time of its report [ns]. The time is 0 if the service no
        longer trusts the vehicle, or if the report is not after `since` [ns].
        """
        row = self.live.reporters[slots]
        reporters = self.store.state.live.reporters
        who = np.where(row[:, None] == NONE, NONE, reporters["source"][row, side])
        when = reporters["source_time"][row, side].astype(np.int64) * NS
        trusted = self.vote_weights[-1].weights(np.maximum(who, 0)) >= constants.SOURCE_TRUST
        counted = (who != NONE) & trusted & (when > np.reshape(since, (-1, 1)))
        return who, np.where(counted, when, 0)


def _rule_of(slope: float, silence: float, *, narrow: bool) -> ReadRule:
    """Return the parameters for reading beliefs with an assumed error of `slope` per unit of unused
    grip. `silence` and `narrow` are those of `ReadRule`.
    """
    shape = shape_class(slope)
    return ReadRule(KERNELS[shape], SLIPPERY_WEIGHTS[shape], silence, narrow)


@refcount_free_locked
def _write_slippery(
    live: Rows, weights: FloatArray, slots: IntArray, p: FloatArray, out: FloatArray
) -> None:
    """Write P(slippery) of each slot to `out` (k,). `p` (32,) is memory for the belief of one
    slot.
    """
    for k in range(len(slots)):
        unpack_belief(live.belief, slots[k], p)
        out[k] = read_slippery(weights, live.cells, slots[k], p)
