"""View of cells: a copy of their state at one moment, as columns that no longer change. Pure (no
I/O).
"""

from __future__ import annotations

from typing import Any, Final, NamedTuple, Protocol

import numpy as np
from numpy.typing import NDArray

from fleet_service.fusion.store.cells import Cells
from schemas import grid, mugrid
from schemas.numeric import BoolArray, Float32Array, FloatArray, IntArray
from schemas.thresholds import NS

CountArray = NDArray[np.integer[Any]]
# levels of the published interval's ends
LOWER = 0.05
UPPER = 0.95
PRIOR_UPPER: Final = float(mugrid.quantiles(mugrid.PRIOR, UPPER))
PRIOR_WIDTH: Final = PRIOR_UPPER - float(mugrid.quantiles(mugrid.PRIOR, LOWER))
# A cell is `measured` in three cases: a value has lowered its upper end by more than numerical
# errors and ageing do; a value has halved the interval; or the cell is more likely slippery than
# not. Otherwise only a lower bound is known.
MEASURED_DROP: Final = 0.02
MEASURED_WIDTH: Final = 0.5
KNOWN_SLIPPERY: Final = 0.5
# [ns] Published times are rounded to this, a quarter of an hour, in which several cars pass a
# street.
TIME_STEP_NS: Final = 900 * NS
COUNT_STEPS: Final = np.array([0, 1, 2, 3, 5, *(m * 10**e for e in range(1, 9) for m in (1, 2, 5))])


class CellView(NamedTuple):
    """State of cells at one moment: columns (k,) and beliefs (k, 32).

    Attributes:
        cell, sector: map cell and heading sector.
        belief: belief about the friction of the road.
        values: number of reports with a value of μ (not only a lower bound).
        vehicles, observations: number of vehicles and of observations.
        first, last: times of the first and the last observation [ns].
        imputed: True if the belief was estimated from neighbours.
    """

    cell: IntArray
    sector: IntArray
    belief: FloatArray
    values: Float32Array
    vehicles: CountArray
    observations: CountArray
    first: IntArray
    last: IntArray
    imputed: BoolArray


class Readable(Protocol):
    """Interface to the cells of a map and their beliefs (probability of each friction value):
    implemented by a `Fusion` and by its public copy.
    """

    @property
    def live(self) -> Cells:
        """Return the present state of all cells as columns, one row per slot (cell and heading
        sector).
        """

    def beliefs(self, slots: IntArray, now: int) -> FloatArray:
        """Return the belief about the road (32 probabilities of μ) for each slot, (k, 32),
        predicted to `now` [ns].
        """

    def slots_of(self, cell: IntArray, sector: IntArray) -> IntArray:
        """Return the slot (row number), (n,), of each cell and heading sector; -1 if a cell has
        none.
        """


def view_cells(source: Readable, slots: IntArray, now: int) -> CellView:
    """Return a copy of the state of `slots`, with beliefs for the time `now` [ns]. The map may be
    updated afterwards without changing the copy.
    """
    live = source.live
    key = live.key[slots]
    return CellView(
        cell=key // grid.SECTORS,
        sector=key % grid.SECTORS,
        belief=source.beliefs(slots, now),
        values=live.values[slots],
        vehicles=live.vehicles[slots],
        observations=live.visits[slots],
        first=live.first[slots],
        last=live.time[slots],
        imputed=np.zeros(len(slots), bool),
    )


def coarsen_cells(cells: CellView) -> CellView:
    """Return the cells with times and counts rounded for privacy, so that no single passage of a
    vehicle is visible.
    """
    vehicles = coarse_counts(np.asarray(cells.vehicles, np.int64))
    observations = coarse_counts(np.asarray(cells.observations, np.int64))
    first = cells.first // TIME_STEP_NS * TIME_STEP_NS
    last = cells.last // TIME_STEP_NS * TIME_STEP_NS
    return cells._replace(vehicles=vehicles, observations=observations, first=first, last=last)


def coarse_counts(counts: IntArray) -> IntArray:
    """Return counts of vehicles or observations (n,), rounded down to 0, 1, 2, 3, 5, 10, 20, 50,
    100 and so on.
    """
    return COUNT_STEPS[np.maximum(np.searchsorted(COUNT_STEPS, counts, "right") - 1, 0)]


def join_views(*views: CellView) -> CellView:
    """Return several views (copies of the state of some cells) joined into one."""
    return CellView(*(np.concatenate(columns) for columns in zip(*views, strict=True)))


def is_measured(
    lower: FloatArray, upper: FloatArray, values: Float32Array, p_slippery: FloatArray
) -> BoolArray:
    """Return a mask of beliefs about friction (k,): True if the belief contains more information
    than a lower bound.

    A belief that the road is slippery always counts as measured, even if it comes from values of
    other headings, because known ice must never be shown as unknown.

    Args:
        lower, upper: ends of the interval of μ, (k,).
        values: number of reports with a value of μ (not only a lower bound), (k,).
        p_slippery: probability of μ below SLIPPERY_MU, (k,).
    """
    narrow = upper - lower < MEASURED_WIDTH * PRIOR_WIDTH
    valued = (values > 0) & ((upper < PRIOR_UPPER - MEASURED_DROP) | narrow)
    return np.asarray(valued | (p_slippery > KNOWN_SLIPPERY))
