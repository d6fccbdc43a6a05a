"""Estimate of the number of distinct vehicles that were recently in a cell. It is never too large,
and takes sixteen bytes per cell. Pure (no I/O).

This number decides whether readers may see a cell, because a single vehicle is hidden only among
several recent vehicles. If a cell stayed public for ever, a single car at night would be visible in
it.
"""

from __future__ import annotations

from typing import Final

import numpy as np
from numpy.typing import NDArray

from fleet_service.fusion import Fusion, Observations
from schemas.numeric import IntArray
from schemas.thresholds import NS

# [ns] Length of a part of the window. The window is the current part and the one before, so it
# covers 12 to 24 hours.
PART_NS: Final = 12 * 3600 * NS
PARTS: Final = 2
# 2⁶⁴ divided by the golden ratio: the multiples of this number are far apart (Fibonacci hashing).
_FIBONACCI: Final = np.uint64(0x9E3779B97F4A7C15)
_SHIFT: Final = np.uint64(58)


class Visitors:
    """Recent vehicles of each slot (cell and heading sector) of a fusion (beliefs about the
    friction of all cells). The time window is divided into parts; in each part, a visiting vehicle
    sets one of 64 bits.

    Args:
        fusion: owner of the slots; it must process observations before they are passed to `add`.
    """

    def __init__(self, fusion: Fusion) -> None:
        self._fusion = fusion
        self._bits: NDArray[np.uint64] = np.zeros((0, PARTS), np.uint64)
        self._part = 0  # number of the newest part of the window, counted from the epoch

    def add(self, observations: Observations) -> None:
        """Record, for each cell that `observations` report, the vehicles that report it."""
        self._grow()
        part = observations.time // PART_NS
        self._move_on(int(part.max(initial=self._part)))
        bit = bit_of(observations.vehicle)
        for sector in (observations.sector, observations.second):
            slot = self._fusion.slots_of(observations.cell, np.maximum(sector, 0))
            for back in range(PARTS):
                is_current = (part == self._part - back) & (slot >= 0) & (sector >= 0)
                np.bitwise_or.at(self._bits[:, back], slot[is_current], bit[is_current])

    @property
    def newest(self) -> int:
        """Return the time [ns] at which the newest part of the time window begins."""
        return self._part * PART_NS

    def count(self, slots: IntArray, now: int) -> IntArray:
        """Return the number of distinct vehicles in each slot, (k,), within the time window that
        ends at `now` [ns].
        """
        self._grow()
        parts_ago = max(now // PART_NS - self._part, 0)
        within = self._bits[slots, : max(PARTS - parts_ago, 0)]
        return np.asarray(np.bitwise_count(np.bitwise_or.reduce(within, axis=1)), np.int64)

    def renumber(self, place: IntArray) -> None:
        """Update the slot numbers of the counted visitors after the slots were renumbered; `place`
        contains the new numbers, -1 for removed slots.
        """
        stay = np.flatnonzero(place >= 0)
        longer = np.zeros((len(place), PARTS), np.uint64)
        longer[: min(len(place), len(self._bits))] = self._bits[: len(place)]
        self._bits = longer[stay]

    def columns(self) -> dict[str, IntArray]:
        """Return the counted visitors as columns for a checkpoint (saved state), from which the
        method `of` restores this object.
        """
        self._grow()
        return {
            "bits": self._bits[: self._fusion.size].reshape(-1).view(np.int64),
            "part": np.array([self._part]),
        }

    @staticmethod
    def of(fusion: Fusion, columns: dict[str, IntArray]) -> Visitors:
        """Return the recent visitors of cells that `columns` describe; no visitors if the columns
        do not match the cells of `fusion`.
        """
        made = Visitors(fusion)
        bits = columns["bits"]
        if len(bits) == PARTS * fusion.size:
            made._bits = bits.view(np.uint64).reshape(-1, PARTS).copy()
            made._part = int(columns["part"][0])
        return made

    def _grow(self) -> None:
        """Enlarge the memory for new slots. The memory is doubled when it is full, so that this is
        rare.
        """
        if len(self._bits) < self._fusion.size:
            longer = np.zeros((2 * self._fusion.size, PARTS), np.uint64)
            longer[: len(self._bits)] = self._bits
            self._bits = longer

    def _move_on(self, part: int) -> None:
        """Begin a new part of the time window, with number `part`: vehicles are counted in it from
        now on. Delete the counts of parts that no longer belong to the window.
        """
        new_parts = part - self._part
        if new_parts > 0:
            self._bits[:, new_parts:] = self._bits[:, : max(PARTS - new_parts, 0)]
            self._bits[:, :new_parts] = 0
            self._part = part


def bit_of(vehicle: IntArray) -> NDArray[np.uint64]:
    """Return, for each vehicle number (n,), a 64-bit integer with one bit set; two vehicles may
    have the same bit.
    """
    return np.uint64(1) << ((vehicle.astype(np.uint64) * _FIBONACCI) >> _SHIFT)
