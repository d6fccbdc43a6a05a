"""What surrounds the cells: observations of the window, what vehicles said before it, who spoke. Records in arrays.

Numba passes a few arrays of records in no time, and dozens of columns not; a record also lies together in memory.
"""

from __future__ import annotations

from typing import Final, NamedTuple

import numpy as np

from fleet_service.fusion import constants as c
from fleet_service.fusion.belief import PackedArray
from fleet_service.fusion.cells import Int32Array, Records
from schemas import mugrid
from schemas.numeric import IntArray

GRIP, ICE = 0, 1  # what a witness says
WITNESSES: Final = 5  # remembered per slot of each kind: as many as an alert ever needs

# One observation in one cell. `previous` and `following` link the slot's window in order of time, `before` and `after`
# the entries of one vehicle in it; `pair` is the place of their pair. `number`, `boot`, `place` order equal times.
# `mean`, `std`, `slippery` describe the vote; `power`, `last_mean`, `last_std`, `spent`, `fresh` say what the same
# vehicle had said before.
ENTRY: Final = np.dtype(
    [("previous", "i4"), ("following", "i4"), ("before", "i4"), ("after", "i4"), ("pair", "i4"), ("vehicle", "i4"),
     ("kind", "i1"), ("fresh", "i1"), ("weight", "f4"), ("time", "i8"), ("number", "i8"), ("boot", "i8"),
     ("place", "i8"), ("share", "f4"), ("mean", "f4"), ("std", "f4"), ("slippery", "f4"), ("power", "f4"),
     ("last_mean", "f4"), ("last_std", "f4"), ("spent", "f4"), ("evidence", "u1", (mugrid.BINS,))],
    align=True,
)  # fmt: skip
# The window of a slot: its first and last entry, the first one's time, how many are values; `stale` says that the live
# row waits to be folded anew; the witnesses as they were before the checkpoint. A window that is not in use has slot
# NONE.
WINDOW: Final = np.dtype(
    [("slot", "i4"), ("head", "i4"), ("tail", "i4"), ("stale", "i4"), ("first", "i8"), ("values", "i4"),
     ("witness", "i4", (2, WITNESSES)), ("witnessed", "u4", (2, WITNESSES))]
)  # fmt: skip
# What a vehicle last said in a cell before the checkpoint: a hash table of (slot, vehicle). `last` is the newest of
# the pair's `waiting` entries in the window. Columns are the kinds BOUND and VALUE; `time` [s] is 0 where it said
# nothing of the kind; `std` is the value's.
PAIR: Final = np.dtype(
    [("slot", "i4"), ("vehicle", "i4"), ("last", "i4"), ("waiting", "i4"), ("time", "u4", (2,)), ("mean", "f4", (2,)),
     ("std", "f4"), ("spent", "f4", (2,))]
)  # fmt: skip
# Of a slot with a value: the last SPEAKERS vehicles that gave one before the checkpoint, when [s] and what; the last
# WITNESSES of grip and ice, when [s].
VOICE: Final = np.dtype(
    [("speaker", "i4", (c.SPEAKERS,)), ("spoke", "u4", (c.SPEAKERS,)), ("mean", "f4", (c.SPEAKERS,)),
     ("std", "f4", (c.SPEAKERS,)), ("witness", "i4", (2, WITNESSES)), ("witnessed", "u4", (2, WITNESSES))]
)  # fmt: skip
# Whom a vehicle met: the other, the pair's rank, agreement and meetings.
PEER: Final = np.dtype(
    [("other", "i4", (c.PEERS,)), ("rank", "i4", (c.PEERS,)), ("agreed", "f4", (c.PEERS,)), ("met", "f4", (c.PEERS,))]
)
VEHICLE: Final = np.dtype([("key", "i8")])  # its number

# Places of `State.used`: how many windows and entries are free, how many pairs and voices are in use.
FREE_WINDOWS, FREE_ENTRIES, PAIRS, VOICES = range(4)


class State(NamedTuple):
    """All that compiled code works on.

    `belief` and `cells` are the slots as they are now. `kept_belief` and `kept` are, row by row of `windows`, what they
    were before the checkpoint. `free_windows` and `free_entries` are stacks of free rows.
    """

    belief: PackedArray
    cells: Records
    kept_belief: PackedArray
    kept: Records
    windows: Records
    free_windows: Int32Array
    entries: Records
    free_entries: Int32Array
    pairs: Records
    voices: Records
    used: IntArray
