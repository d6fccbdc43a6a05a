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

# What a vehicle said last, its mean, standard deviation and votes spent, is remembered in 16 bits: parts of 1/FINE, and
# below 4 all. In the window as before the checkpoint, so that it does not matter which of the two is asked.
FINE: Final = 16384.0

# One observation in one cell. `previous` and `following` link the slot's window in order of time, `before` and `after`
# the entries of one vehicle in it; `pair` is the place of their pair. `number`, `boot`, `place` order equal times.
# `mean`, `std`, `slippery` describe the vote; `power`, `last_mean`, `last_std`, `spent`, `fresh` say what the same
# vehicle had said before. What settling reads lies in the first line of two.
ENTRY: Final = np.dtype(
    [("previous", "i4"), ("following", "i4"), ("before", "i4"), ("after", "i4"), ("pair", "i4"), ("vehicle", "i4"),
     ("kind", "i1"), ("fresh", "i1"), ("last_mean", "u2"), ("last_std", "u2"), ("spent", "u2"), ("time", "i8"),
     ("weight", "f4"), ("share", "f4"), ("power", "f4"), ("mean", "f4"), ("std", "f4"), ("slippery", "f4"),
     ("number", "i8"), ("boot", "i8"), ("place", "i8"), ("evidence", "u1", (mugrid.BINS,)), ("unused", "i8")]
)  # fmt: skip
# The window of a slot: its first and last entry, the first one's time, how many are values; `stale` says that the live
# row waits to be folded anew. A window that is not in use has slot NONE.
WINDOW: Final = np.dtype(
    [("slot", "i4"), ("head", "i4"), ("tail", "i4"), ("stale", "i4"), ("first", "i8"), ("values", "i8")]
)  # fmt: skip
# The last WITNESSES of grip and ice in a slot, when [s].
WITNESSED: Final = [("witness", "i4", (2, WITNESSES)), ("witnessed", "u4", (2, WITNESSES))]
KEPT_VOICE: Final = np.dtype(WITNESSED)
# What a vehicle last said in a cell before the checkpoint: a hash table of (slot, vehicle). `last` is the newest of
# the pair's `waiting` entries in the window. Columns are the kinds BOUND and VALUE; `time` [s] is 0 where it said
# nothing of the kind; `std` is the value's. Half a line, so that none lies in two.
PAIR: Final = np.dtype(
    [("slot", "i4"), ("vehicle", "i4"), ("last", "i4"), ("waiting", "u2"), ("std", "u2"), ("time", "u4", (2,)),
     ("mean", "u2", (2,)), ("spent", "u2", (2,))]
)  # fmt: skip
# Of a slot with a value or a witness lately: the last SPEAKERS vehicles that gave a value before the checkpoint, when
# [s] and what; and the witnesses.
VOICE: Final = np.dtype(
    [("speaker", "i4", (c.SPEAKERS,)), ("spoke", "u4", (c.SPEAKERS,)), ("mean", "f4", (c.SPEAKERS,)),
     ("std", "f4", (c.SPEAKERS,)), *WITNESSED]
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

    `belief`, `cells` and `voices` are the slots as they are now. `kept_belief`, `kept` and, where there is a voice,
    `kept_voices` are, row by row of `windows`, what they were before the checkpoint. `free_windows` and `free_entries`
    are stacks of free rows.
    """

    belief: PackedArray
    cells: Records
    kept_belief: PackedArray
    kept: Records
    kept_voices: Records
    windows: Records
    free_windows: Int32Array
    entries: Records
    free_entries: Int32Array
    pairs: Records
    voices: Records
    used: IntArray
