"""Search for the witnesses of an alert: vehicles that reported ice on the slippery stretch of road
around a cell. Pure (no I/O).
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from fleet_service.fusion.constants import NEIGHBOURS
from fleet_service.fusion.fuse import Fusion
from fleet_service.fusion.neighbours import stretches
from fleet_service.fusion.store.records import NONE, SOURCES, Side
from schemas.numeric import BoolArray, IntArray


def stretch_slots(fusion: Fusion, slots: IntArray) -> IntArray:
    """Return, for each slot (cell and heading sector), the slots of the slippery stretch of road
    around it, in both directions of the road, (k, n). The slot itself comes first; positions
    without a slot are NONE.
    """
    return stretches(fusion.store.state.live, fusion.store.table, slots)


class StretchSources(NamedTuple):
    """Vehicles that reported ice on the slippery stretches around k slots (one per cell and heading
    sector), the newest first.

    Attributes:
        who: index of each of at most n vehicles per slot, (k, n).
        when: time of the vehicle's newest report [ns], (k, n); 0 for no vehicle.
        around: mask (k,): True if such vehicles reported ice both before and behind the slot, in
            the slot's own direction of the road.
    """

    who: IntArray
    when: IntArray
    around: BoolArray


def stretch_sources(fusion: Fusion, slots: IntArray, since: IntArray) -> StretchSources:
    """Return the vehicles that reported ice on the slippery stretches of road around the slots (one
    per cell and heading sector) after the times `since` (k,) [ns]. Each vehicle occurs once per
    stretch.
    """
    along = stretch_slots(fusion, slots)
    places = along.shape[1]
    who, when = fusion.find_sources(
        np.maximum(along, 0).ravel(), Side.ICE, np.repeat(since, places)
    )
    when = np.where(along.reshape(-1, 1) == NONE, 0, when).reshape(-1, places, SOURCES)
    found = when.max(axis=2) > 0
    middle = 1 + NEIGHBOURS
    end = middle + NEIGHBOURS
    around = found[:, 1:middle].any(axis=1) & found[:, middle:end].any(axis=1)
    who, when = _newest_first(who.reshape(-1, places * SOURCES), when.reshape(-1, places * SOURCES))
    # Compare only as many vehicles as the stretch with the most has; callers read two.
    most = max(int((when > 0).sum(axis=1).max(initial=0)), 2)
    who = who[:, :most]
    when = when[:, :most]
    again = np.tril(who[:, :, None] == who[:, None, :], -1).any(axis=2)
    return StretchSources(*_newest_first(who, np.where(again, 0, when)), around)


def witnesses_of(fusion: Fusion, slot: int, since: int) -> list[int]:
    """Return the numbers of the vehicles that reported ice on the slippery stretch of road around a
    slot (cell and heading sector) after `since` [ns].
    """
    who, when, _ = stretch_sources(fusion, np.array([slot]), np.array([since]))
    return [int(fusion.store.names["key"][index]) for index in who[0][when[0] > 0].tolist()]


def _newest_first(who: IntArray, when: IntArray) -> tuple[IntArray, IntArray]:
    newest = np.argsort(-when, axis=1, kind="stable")
    return np.take_along_axis(who, newest, axis=1), np.take_along_axis(when, newest, axis=1)
