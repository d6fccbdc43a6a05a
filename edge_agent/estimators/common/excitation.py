"""Record of the largest grip that the wheels used (force over load) within the last second. It is
kept in a ring of short time intervals (slots).
"""

from __future__ import annotations

import math
from typing import Annotated

from schemas.numeric import FloatArray
from schemas.runtime.jit import compiled
from schemas.thresholds import UTILISED_WINDOW_S

SLOTS = 64
# [s] shortest slot, so that the ring covers the last second at any sample rate
SLOT_S = UTILISED_WINDOW_S / (SLOTS - 1)


class Excitation:
    """Largest grip used in the last second, kept in a ring of time slots (short intervals). Each
    slot has the largest force over load [1] that any wheel used during the slot.
    """

    time: Annotated[FloatArray, SLOTS]  # [s] beginning of each slot
    used: Annotated[FloatArray, SLOTS]
    newest: int  # index of the latest slot
    largest: float  # largest value within the last second
    largest_time: float  # [s] beginning of its slot


@compiled
def begin_excitation(ring: Excitation) -> None:
    """Reset the ring of time slots that records the grip used. Afterwards it contains no grip."""
    ring.largest_time = -math.inf
    for k in range(SLOTS):
        ring.time[k] = -math.inf


@compiled
def note_excitation(ring: Excitation, time: float, used: float) -> None:
    """Store `used`, the grip used at `time` [s], in the ring of time slots. Update `ring.largest`,
    the largest value of the last second.
    """
    place = ring.newest
    if not time - ring.time[place] < SLOT_S:
        place = (place + 1) % SLOTS
        ring.newest = place
        ring.time[place] = time
        ring.used[place] = used
    else:
        ring.used[place] = max(ring.used[place], used)
    if ring.used[place] >= ring.largest:
        ring.largest = ring.used[place]
        ring.largest_time = ring.time[place]
    elif not ring.largest_time > time - UTILISED_WINDOW_S:
        _find_largest(ring, time)


@compiled
def _find_largest(ring: Excitation, time: float) -> None:
    """Search all time slots of the last second for the largest grip used, and store it in
    `ring.largest`. This is needed when the slot of the previous maximum has expired.
    """
    ring.largest = 0.0
    for k in range(SLOTS):
        if ring.time[k] > time - UTILISED_WINDOW_S and ring.used[k] >= ring.largest:
            ring.largest = ring.used[k]
            ring.largest_time = ring.time[k]
