"""View of cells: their state at one moment, as columns that do not change any more. Pure."""

from __future__ import annotations

from typing import Any, Final, NamedTuple, Protocol

import numpy as np
from numpy.typing import NDArray

from fleet_service.fusion.store.cells import Cells
from schemas import grid, mugrid
from schemas.numeric import BoolArray, Float32Array, FloatArray, IntArray
from schemas.thresholds import NS

CountArray = NDArray[np.integer[Any]]
# of the interval
LOWER = 0.05
UPPER = 0.95
PRIOR_UPPER: Final = float(mugrid.quantiles(mugrid.PRIOR, UPPER))
PRIOR_WIDTH: Final = PRIOR_UPPER - float(mugrid.quantiles(mugrid.PRIOR, LOWER))
# A cell is `measured` when a value brought its upper end down by more than numerics and forgetting
# move it, or halved the interval, or when it is more likely slippery than not; else all that is
# known is a lower bound.
MEASURED_DROP: Final = 0.02
MEASURED_WIDTH: Final = 0.5
KNOWN_SLIPPERY: Final = 0.5
TIME_STEP_NS: Final = 900 * NS  # a quarter of an hour, in which a street has had several cars
COUNT_STEPS: Final = np.array([0, 1, 2, 3, 5, *(m * 10**e for e in range(1, 9) for m in (1, 2, 5))])


class CellView(NamedTuple):
    """Cells as believed at one moment: columns (k,) and beliefs (k, 32).

    Attributes:
        cell, sector: place.
        belief: about the road.
        values: votes with a value.
        vehicles, observations: numbers of them.
        first, last: times of the first and the last observation [ns].
        imputed: True if the belief was made from neighbours.
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
    """Cells of a map and the beliefs about them: a fusion, or what is public of it."""

    @property
    def live(self) -> Cells:
        """Return the cells by columns."""

    def beliefs(self, slots: IntArray, now: int) -> FloatArray:
        """Return the belief about the road of each slot, (k, 32), predicted to `now` [ns]."""

    def slots_of(self, cell: IntArray, sector: IntArray) -> IntArray:
        """Return the slot of each cell and sector, -1 for none."""


def view_cells(source: Readable, slots: IntArray, now: int) -> CellView:
    """Return the cells of `slots` as believed at `now` [ns]; copies, so that the fusion may
    continue.
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
    """Return the cells as readers see them with privacy on: no single passage shows in a time or
    a count.
    """
    vehicles, observations = (
        coarse_counts(np.asarray(column, np.int64))
        for column in (cells.vehicles, cells.observations)
    )
    first, last = (time // TIME_STEP_NS * TIME_STEP_NS for time in (cells.first, cells.last))
    return cells._replace(vehicles=vehicles, observations=observations, first=first, last=last)


def coarse_counts(counts: IntArray) -> IntArray:
    """Return counts in steps of 1, 2, 5, rounded down."""
    return COUNT_STEPS[np.maximum(np.searchsorted(COUNT_STEPS, counts, "right") - 1, 0)]


def join_views(*views: CellView) -> CellView:
    """Return views joined into one."""
    return CellView(*(np.concatenate(columns) for columns in zip(*views, strict=True)))


def is_measured(
    lower: FloatArray, upper: FloatArray, values: Float32Array, p_slippery: FloatArray
) -> BoolArray:
    """Return True for beliefs that contain more than a lower bound, (k,).

    A belief that calls the road slippery always does, wherever it came from: values of the other
    headings lower it too, and ice that is known must never be shown as unknown.

    Args:
        lower, upper: ends of the interval, (k,).
        values: number of votes with a value, (k,).
        p_slippery: probability of less friction than SLIPPERY_MU, (k,).
    """
    narrow = upper - lower < MEASURED_WIDTH * PRIOR_WIDTH
    valued = (values > 0) & ((upper < PRIOR_UPPER - MEASURED_DROP) | narrow)
    return np.asarray(valued | (p_slippery > KNOWN_SLIPPERY))
