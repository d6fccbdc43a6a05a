"""The records of a fusion: what belongs together lies together in memory. Kernels see a row as an
object.

Record arrays and not columns: a visit to a cell that was not lately in use then costs two reads of
memory and not one for every column, and handing a kernel a few arrays of records costs nothing,
where dozens of columns would.
"""

from __future__ import annotations

from typing import Annotated, Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from fleet_service.fusion import constants as c
from fleet_service.fusion.belief import PackedArray
from schemas import mugrid
from schemas.numeric import ByteArray, Float32Array, IntArray
from schemas.runtime.records import RecordArray, record_type

NONE: Final = -1  # no row
NOBODY: Final = -1  # no vehicle
# sides: what a corroborating source reported
GRIP = 0
ICE = 1
SOURCES: Final = 5  # remembered per slot of each side: as many as an alert ever needs
# What a vehicle reported last, its mean, standard deviation and votes spent, is remembered in 16
# bits: parts of 1/FINE, and below 4 all. In the window as before the checkpoint, so that it does
# not matter which of the two is asked.
FINE: Final = 16384.0
AGED: Final = 4096.0  # likewise; never more than FORGET_S
USED: Final = 100.0
SHARED: Final = 400.0
WEIGHT: Final = 16.0
UNTRUSTED: Final = 64.0
MANOEUVRES: Final = 4
# a slip controller's intervention: none, of a flag with a bad record, of one with a good record
_NO_FLAG, CLAIMED, HEEDED = range(3)

Int32Array = NDArray[np.int32]
UIntArray = NDArray[np.uint32]
UInt16Array = NDArray[np.uint16]


class CellRecord:
    """A slot: one visited cell and sector. Its belief is a row of its own, see `belief.unpack_belief`.

    Attributes:
        key: cell · 4 + sector.
        time: last observation that is in the belief [ns]; 0 before the first.
        first: first one [ns].
        returned: a bit for each remainder of the vehicles whose visits were forgotten, so that a
            returning vehicle is not counted twice.
        visits: observations.
        vehicles: distinct vehicles.
        values: votes with a value, fractions of repeated ones summed.
        window: row of the slot's window, or NONE.
        reporters: row of its recent reporters, or NONE if no vehicle gave a value or corroborated
            anything lately.
        aged: time before `time` that the belief has not forgotten yet, in parts of 1/AGED s.
        used: grip used by the vehicles that gave values, mean by weight; in parts of 1/USED.
        shared: relative standard deviation that their values share, mean by weight; in parts of
            1/SHARED.
        untrusted: bounds and values of untrusted vehicles, without those that newer ones replaced;
            in parts of 1/UNTRUSTED.
        manoeuvres: weight of the values by manoeuvre, see `shared`; in parts of 1/WEIGHT.
    """

    key: int
    time: int
    first: int
    returned: np.uint64
    visits: np.uint32
    vehicles: np.uint32
    values: np.float32
    window: np.int32
    reporters: np.int32
    aged: np.uint16
    used: np.uint8
    shared: np.uint8
    untrusted: Annotated[UInt16Array, 2]
    manoeuvres: Annotated[ByteArray, MANOEUVRES]


class EntryRecord:
    """One observation in one cell, younger than the checkpoint. The fields that a commit reads lie
    in the first of its two cache lines.

    Attributes:
        previous, following: entries of the slot's window, in order of time.
        before, after: entries of the same vehicle in it.
        pair: place of the pair of slot and vehicle.
        vehicle: index of the vehicle.
        kind: BOUND or VALUE.
        fresh: True if the vehicle reported nothing here lately.
        last_mean, last_std, spent: reports of the vehicle here so far, this entry included; in
            parts of 1/FINE.
        time: end of the visit [ns].
        weight: trust in the vehicle.
        share: P(the vehicle was in this cell).
        power: how much of the vote is new.
        mean, std, slippery: of the vote.
        number, boot, sequence: order entries of equal times: the vehicle's number, its start, the
            row in its stream.
        evidence: likelihood in steps, see `likelihoods.make_evidence`.
        used, shared: grip used, and the error that its value shares with others, in parts of 1/USED
            and 1/SHARED.
        manoeuvre: see `shared`.
        late: True if it came after the checkpoint, and is compared with no other vehicle.
        limited: CLAIMED where a slip controller says slippery, HEEDED where the vehicle's flags
            have a good record.
    """

    previous: np.int32
    following: np.int32
    before: np.int32
    after: np.int32
    pair: np.int32
    vehicle: np.int32
    kind: np.int8
    fresh: np.int8
    last_mean: np.uint16
    last_std: np.uint16
    spent: np.uint16
    time: int
    weight: np.float32
    share: np.float32
    power: np.float32
    mean: np.float32
    std: np.float32
    slippery: np.float32
    number: int
    boot: int
    sequence: int
    evidence: Annotated[ByteArray, mugrid.BINS]
    used: np.uint8
    shared: np.uint8
    manoeuvre: np.int8
    late: np.int8
    limited: np.int8


class WindowRecord:
    """The window of a slot: its first and last entry, a flag that the live row must be computed
    again, the first entry's time [ns], and the number of entries that are values. A window that is
    not in use has slot NONE.
    """

    slot: np.int32
    head: np.int32
    tail: np.int32
    stale: np.int32
    first: int
    values: int


class PairRecord:
    """Last reports of a vehicle in a cell before the checkpoint. A record is half a cache line
    long, so that none crosses a line.

    Attributes:
        slot, vehicle: whose; a free place has slot NONE.
        last: the newest of the pair's entries in the window, or NONE.
        waiting: how many these are.
        std: of the last value, in parts of 1/FINE.
        time: of the last bound and value [s]; 0 where there was none.
        mean, spent: of the last bound and value, in parts of 1/FINE.
    """

    slot: np.int32
    vehicle: np.int32
    last: np.int32
    waiting: np.uint16
    std: np.uint16
    time: Annotated[UIntArray, 2]
    mean: Annotated[UInt16Array, 2]
    spent: Annotated[UInt16Array, 2]


class SourcesRecord:
    """The last SOURCES vehicles that reported grip and ice in a slot, and when [s]."""

    source: Annotated[Int32Array, 2, SOURCES]
    source_time: Annotated[UIntArray, 2, SOURCES]


class ReportersRecord:
    """The recent reporters of a slot: the last REPORTERS vehicles that gave a value before the
    checkpoint, when [s] and what, and the grip used; and the corroborating sources."""

    reporter: Annotated[Int32Array, c.REPORTERS]
    time: Annotated[UIntArray, c.REPORTERS]
    mean: Annotated[Float32Array, c.REPORTERS]
    std: Annotated[Float32Array, c.REPORTERS]
    used: Annotated[Float32Array, c.REPORTERS]
    source: Annotated[Int32Array, 2, SOURCES]
    source_time: Annotated[UIntArray, 2, SOURCES]


class PeersRecord:
    """Vehicles with which a vehicle was compared: the other, the rank of their pair, agreement and
    comparisons, summed; squares of the differences of its own use between two visits to one cell,
    and their products with those of its values, by weight; how often others' values confirmed and
    contradicted its slip controllers."""

    other: Annotated[Int32Array, c.PEERS]
    rank: Annotated[Int32Array, c.PEERS]
    agreed: Annotated[Float32Array, c.PEERS]
    met: Annotated[Float32Array, c.PEERS]
    used_squares: np.float32
    used_products: np.float32
    flags_confirmed: np.float32
    flags_contradicted: np.float32


class VehicleRecord:
    """A vehicle: its number."""

    key: int


CELL: Final = record_type(CellRecord)
ENTRY: Final = record_type(EntryRecord)
WINDOW: Final = record_type(WindowRecord)
PAIR: Final = record_type(PairRecord)
SOURCE: Final = record_type(SourcesRecord)
REPORTER: Final = record_type(ReportersRecord)
PEER: Final = record_type(PeersRecord)
VEHICLE: Final = record_type(VehicleRecord)


class Rows(NamedTuple):
    """Beliefs of slots (n, 32), their records (n,) and, by rows of their own, their reporters or
    only sources.
    """

    belief: PackedArray
    cells: RecordArray
    reporters: RecordArray


# Places of `State.used`: how many windows and entries are free, how many pairs and rows of
# reporters are in use.
FREE_WINDOWS, FREE_ENTRIES, PAIRS, REPORTERS_USED = range(4)


class State(NamedTuple):
    """State of the store in arrays, for compiled code.

    Attributes:
        live: the slots as they are now.
        base: row by row of `windows`, the slots as they were before the window; of the reporters
            only the sources.
        windows, entries: pools.
        free_windows, free_entries: stacks of the pools' free rows.
        pairs: hash table that holds its records.
        used: (4,) see FREE_WINDOWS.
    """

    live: Rows
    base: Rows
    windows: RecordArray
    free_windows: Int32Array
    entries: RecordArray
    free_entries: Int32Array
    pairs: RecordArray
    used: IntArray
