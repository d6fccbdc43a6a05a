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
    """Reports of ice on the slippery stretches around k slots.

    Attributes:
        second: time by which two vehicles had reported [ns], that is, of the newest report of a
            vehicle other than the one with the newest report, (k,); 0 if only one reported.
        around: mask (k,): True if vehicles reported ice both before and behind the slot, in the
            slot's own direction of the road.
    """

    second: IntArray
    around: BoolArray


def stretch_sources(fusion: Fusion, slots: IntArray, since: IntArray) -> StretchSources:
    """Return when two vehicles had reported ice on the slippery stretches of road around the slots,
    and whether ice was reported on both sides. Only reports after the times `since` (k,) [ns]
    count.
    """
    who, when = _reports_of_ice(fusion, slots, since)
    first, middle, end = (SOURCES * place for place in (1, 1 + NEIGHBOURS, 1 + 2 * NEIGHBOURS))
    found = when > 0
    before = np.asarray(found[:, first:middle].any(axis=1))
    behind = np.asarray(found[:, middle:end].any(axis=1))
    newest = np.take_along_axis(who, when.argmax(axis=1)[:, None], axis=1)
    return StretchSources(np.where(who == newest, 0, when).max(axis=1), before & behind)


def witnesses_of(fusion: Fusion, slot: int, since: int) -> list[int]:
    """Return the numbers of the vehicles that reported ice on the slippery stretch of road around a
    slot after `since` [ns].
    """
    who, when = _reports_of_ice(fusion, np.array([slot]), np.array([since]))
    return [int(fusion.store.names["key"][index]) for index in np.unique(who[when > 0]).tolist()]


def _reports_of_ice(fusion: Fusion, slots: IntArray, since: IntArray) -> tuple[IntArray, IntArray]:
    """Return the reports of ice on the slippery stretches of road around k slots after the times
    `since` (k,) [ns], as two arrays (k, n): index of the vehicle, and time [ns]; 0 for no report.
    They are in the order of `stretch_slots`, with SOURCES reports per slot.
    """
    along = stretch_slots(fusion, slots)
    shape = (len(slots), along.shape[1] * SOURCES)
    who, when = fusion.find_sources(
        np.maximum(along, 0).ravel(), Side.ICE, np.repeat(since, along.shape[1])
    )
    when = np.where(along.reshape(-1, 1) == NONE, 0, when)
    return who.reshape(shape), when.reshape(shape)
