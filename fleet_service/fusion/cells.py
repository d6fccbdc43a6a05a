"""The cells, structure of arrays: one row ("slot") per cell and sector that anybody visited."""

from __future__ import annotations

from typing import NamedTuple, TypeVar

import numpy as np

from schemas import mugrid
from schemas.numeric import Float32Array, IntArray, compiled

NOBODY = -1
WITNESSES = 3  # remembered per slot: as many as an alert ever needs


class Cells(NamedTuple):
    """What is known of each slot.

    Attributes:
        belief: (n, 32) probability of each bin at `time`; single precision halves the memory of a country.
        time: (n,) last observation that was folded [ns].
        first: (n,) first one [ns].
        visits: (n,) observations.
        vehicles: (n,) distinct vehicles.
        values: (n,) votes with a value, fractions of repeated ones summed.
        crowd: (n, 2) bounds and values of vehicles that are not trusted, as far as they are not renewed.
        witness: (n, WITNESSES) the last distinct vehicles that called it slippery, or NOBODY.
        witnessed: (n, WITNESSES) when they did [ns].
    """

    belief: Float32Array
    time: IntArray
    first: IntArray
    visits: IntArray
    vehicles: IntArray
    values: Float32Array
    crowd: Float32Array
    witness: IntArray
    witnessed: IntArray


def empty(slots: int) -> Cells:
    """Slots that hold the prior."""
    return Cells(
        np.full((slots, mugrid.BINS), 1.0 / mugrid.BINS, np.float32),
        np.zeros(slots, np.int64),
        np.zeros(slots, np.int64),
        np.zeros(slots, np.int64),
        np.zeros(slots, np.int64),
        np.zeros(slots, np.float32),
        np.zeros((slots, 2), np.float32),
        np.full((slots, WITNESSES), NOBODY, np.int64),
        np.zeros((slots, WITNESSES), np.int64),
    )


Columns = TypeVar("Columns", bound=tuple[object, ...])


def extended(old: Columns, new: Columns) -> Columns:
    """`new`, with the rows of `old` in front."""
    for source, target in zip(old, new, strict=True):
        target[: len(source)] = source  # type: ignore[index, arg-type]
    return new


@compiled
def copy_slot(source: Cells, target: Cells, slot: int) -> None:
    """One slot from one store to another."""
    target.belief[slot] = source.belief[slot]
    target.time[slot] = source.time[slot]
    target.first[slot] = source.first[slot]
    target.visits[slot] = source.visits[slot]
    target.vehicles[slot] = source.vehicles[slot]
    target.values[slot] = source.values[slot]
    target.crowd[slot] = source.crowd[slot]
    target.witness[slot] = source.witness[slot]
    target.witnessed[slot] = source.witnessed[slot]
