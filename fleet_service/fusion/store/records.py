"""The records in which a fusion (beliefs about all cells) is stored. Data that are used together
are adjacent in memory. Compiled functions see a row as an object.

The state consists of record arrays instead of columns for two reasons. A visit to a cell that was
not used recently costs two memory accesses instead of one per column. Compiled functions receive a
few arrays of records instead of dozens of columns, which makes calls cheap.

Terms
    slot          storage of one visited cell and heading sector, by number
    observation   report of one vehicle about one visit
    vote          effect of an observation on the belief of one cell
    value, bound  observation that measures the friction; one that only gives a lower bound of it
    checkpoint    latest time minus the allowed delay; observations before it are final
    window        list of the observations of a slot after the checkpoint, in order of time
    pair          one vehicle in one slot; active while one of its observations is in a window or
                  became final lately, then settled

Records store some numbers as small integers. "In units of 1/FINE" means that the stored integer is
the number times FINE, rounded. The same holds for USED, SHARED and others.
"""

from __future__ import annotations

from enum import IntEnum
from typing import Annotated, Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from fleet_service.fusion import constants
from fleet_service.fusion.belief import PackedArray
from schemas import mugrid
from schemas.numeric import ByteArray, Float32Array, IntArray
from schemas.runtime.records import RecordArray, record_type
from schemas.thresholds import NS, UNKNOWN

NONE: Final = UNKNOWN  # no row, no vehicle, or no known kind of manoeuvre


class Side(IntEnum):
    """Kind of road that a source (a vehicle with a clear report) supports."""

    GRIP = 0
    ICE = 1


class ManoeuvreKind(IntEnum):
    """Kind of manoeuvre of a visit, see `shared.manoeuvre_of`."""

    DRIVING = 0
    BRAKING = 1
    LEFT = 2
    RIGHT = 3


MANOEUVRES: Final = len(ManoeuvreKind)
# Number of vehicles remembered per slot that reported grip, and per slot that reported ice. An
# alert never needs more.
SOURCES: Final = 5
# Units of numbers that records store as integers; a record holds the number times this factor. A
# vehicle's last mean, standard deviation and used-up votes (FINE) have 16 bits and are below 4.
# Open windows and final records use the same units, so both give the same result.
FINE: Final = 16384.0
AGED: Final = 4096.0  # [1/s]; times up to FORGET_S
USED: Final = 100.0
SHARED: Final = 400.0
WEIGHT: Final = 16.0
UNTRUSTED: Final = 64.0
LATE_NS: Final = 60 * NS  # [ns] unit of the age of a late report
# Intervention of a slip controller: none; reported by a vehicle whose interventions often disagree
# with values of others; reported by a vehicle whose interventions usually agree.
UNLIMITED, _NO_FLAG, CLAIMED, HEEDED = range(-1, 3)

Int32Array = NDArray[np.int32]
UIntArray = NDArray[np.uint32]
UInt16Array = NDArray[np.uint16]


class CellRecord:
    """A slot (storage of one visited cell and heading sector). Its belief is stored in another
    array, see `belief.unpack_belief`.

    Attributes:
        key: cell · 4 + sector.
        time: time of the latest observation in the belief [ns]; 0 before the first observation.
        first: time of the first observation [ns].
        returned: set of bits of the vehicles whose visits were forgotten, so that a returning
            vehicle is not counted twice; see `settled.returning_bit`.
        visits: number of observations.
        vehicles: number of distinct vehicles.
        values: number of observations with a friction value. Each counts by its weight in the
            belief, so a repeated value of one vehicle adds only a fraction.
        window: row of the slot's window in `State.windows`, or NONE.
        reporters: row of the list of recent reporters in `Rows.reporters`, or NONE. A slot gets a
            list when a vehicle gives a value or reports grip, or when a slip controller intervenes.
        aged: part of the time before `time` that ageing of the belief has not covered yet, in units
            of 1/AGED s. The belief is aged only when FORGET_S or more have passed.
        used: weighted mean grip used by the vehicles that gave values, in units of 1/USED.
        shared: weighted mean of the relative error that these values have in common (standard
            deviation), in units of 1/SHARED.
        untrusted: number of bounds, and number of values, from untrusted vehicles, in units of
            1/UNTRUSTED. Both fade with time.
        manoeuvres: weight of the values for each kind of manoeuvre (`shared.manoeuvre_of`), in
            units of 1/WEIGHT. The weights fade with time.
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
    """One observation of one slot (cell and heading sector) that is not final yet. It is kept in
    the slot's lateness window, because earlier observations may still arrive. When the entry is
    older than the checkpoint, a commit applies it to the slot's final belief and removes it. The
    fields that a commit reads are in the first of the entry's two cache lines.

    The entry changes the belief with the vote weight weight · power · share.

    Attributes:
        previous, following: rows of the neighbouring entries in the slot's window, in order of
            time; NONE at an end.
        before, after: rows of the neighbouring entries of the same vehicle in this window; NONE at
            an end.
        pair: row of the pair (this slot and vehicle) in the table of pairs.
        vehicle: index of the vehicle in this service.
        kind: BOUND (only a lower bound of friction) or VALUE (a measurement of friction).
        fresh: 1 if no earlier report of the vehicle in this cell is remembered, else 0.
        last_mean, last_std: mean and standard deviation that stand for all reports of this kind
            that the vehicle made in this cell up to this entry, in units of 1/FINE. The vehicle's
            next report is compared with these two numbers.
        spent: votes that the vehicle has used up in this cell up to this entry, in units of
            1/FINE; a report with `power` 1 uses up one vote. The number decreases with time, and a
            vehicle has at most VOTES.
        time: end of the visit [ns]; for a late observation, a time directly after the checkpoint.
        weight: trust in the vehicle, see `vote_weights`; about 0 to 1.
        share: weight of the position, 0 to 1; below 1 if it is inaccurate (`space`).
        power: share, 0 to 1, of the observation that is new information after the vehicle's earlier
            reports in this cell, see `votes.discount_vote`.
        mean, std, slippery: mean and standard deviation of μ, and P(slippery), according to this
            observation alone.
        number, boot, sequence: permanent number of the vehicle, random number of its agent's start,
            and number of the row in its stream; they order entries of equal times.
        evidence: log-likelihood of the visit on the friction grid, see
            `likelihoods.make_evidence`.
        used: grip used in the visit, in units of 1/USED.
        shared: relative error that the value has in common with values of other vehicles, see
            `shared.shared_parts`; in units of 1/SHARED.
        manoeuvre: kind of manoeuvre, see `shared.manoeuvre_of`.
        late: time from the visit to `time`, in units of LATE_NS, of an observation that arrived
            after the checkpoint had passed the visit; it is then compared with no other vehicle. 0
            for other observations.
        limited: CLAIMED if a slip controller (ABS, ESC, traction control) intervened below the
            slippery limit; HEEDED if in addition the vehicle's earlier interventions agreed with
            other vehicles; UNLIMITED if the vehicle states that it did not use all of the road's
            grip (`likelihoods.states_more_grip`); else 0.
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
    late: np.uint8
    limited: np.int8


class WindowRecord:
    """The lateness window of a slot: its recent observations, which are not yet final, as a linked
    list of entries.

    Attributes:
        slot: the slot; NONE if the window is not in use.
        head, tail: rows of the first and the last entry.
        stale: 1 if the current belief of the slot must be computed again.
        first: time of the first entry [ns].
        values: number of entries that are values (not only lower bounds).
    """

    slot: np.int32
    head: np.int32
    tail: np.int32
    stale: np.int32
    first: int
    values: int


class PairRecord:
    """Active pair: summary of the final reports of one vehicle in one slot. Final reports are older
    than the checkpoint. A record is half a cache line long, so that no record crosses the border of
    a line.

    The arrays `time`, `mean` and `spent` contain two numbers each: the first for lower bounds, the
    second for values.

    Attributes:
        slot, vehicle: slot and index of the vehicle; a free place of the table has slot NONE.
        last: row of the pair's newest entry in the window (observation that is not final), or NONE.
        waiting: number of the pair's entries in the window.
        std: standard deviation of the vehicle's values (`EntryRecord.last_std`), in units of
            1/FINE.
        time: time [s] of the latest final report; 0 for none.
        mean: running mean of the reported friction (`EntryRecord.last_mean`), in units of 1/FINE.
        spent: number of votes that the vehicle has used up in the slot, out of at most VOTES
            (`EntryRecord.spent`), in units of 1/FINE.
    """

    slot: np.int32
    vehicle: np.int32
    last: np.int32
    waiting: np.uint16
    std: np.uint16
    time: Annotated[UIntArray, 2]
    mean: Annotated[UInt16Array, 2]
    spent: Annotated[UInt16Array, 2]


class SettledRecord:
    """Last report of one kind (value or lower bound) that a vehicle made in a slot. All reports of
    the vehicle in this slot are final (a settled pair).

    Attributes:
        time: last 16 bits of the time [s] of the report; the module `settled` restores the other
            bits.
        mean: running mean of the friction in the vehicle's reports of this kind in the slot
            (`EntryRecord.last_mean`), in units of 1/FINE.
        spent: number of votes that the vehicle has used up in the slot, out of at most VOTES
            (`EntryRecord.spent`), in units of 1/FINE.
    """

    time: np.uint16
    mean: np.uint16
    spent: np.uint16


class SourcesRecord:
    """The sources of a cell and heading sector, which are vehicles with a clear report: the last
    SOURCES vehicles that reported grip, and the last SOURCES vehicles that reported ice. The times
    of their reports [s] are also stored.
    """

    source: Annotated[Int32Array, 2, SOURCES]
    source_time: Annotated[UIntArray, 2, SOURCES]


class ReportersRecord:
    """Vehicles that recently reported in a cell and heading sector, in two lists.

    The first list contains the last REPORTERS vehicles that gave a friction value: index
    (`reporter`), time [s], mean, standard deviation and grip used. The second list contains the
    last SOURCES vehicles that reported grip, and the last SOURCES that reported ice: index
    (`source`) and time [s].
    """

    reporter: Annotated[Int32Array, constants.REPORTERS]
    time: Annotated[UIntArray, constants.REPORTERS]
    mean: Annotated[Float32Array, constants.REPORTERS]
    std: Annotated[Float32Array, constants.REPORTERS]
    used: Annotated[Float32Array, constants.REPORTERS]
    source: Annotated[Int32Array, 2, SOURCES]
    source_time: Annotated[UIntArray, 2, SOURCES]


class PeersRecord:
    """Comparisons of one vehicle's friction values with those of other vehicles, and with its own
    earlier values. The record has PEERS places, each for one other vehicle.

    Attributes:
        other: index of the other vehicle in each place.
        rank: pseudo-random number of the vehicle and the other vehicle. If a group of places is
            full, the vehicles with the lowest numbers keep theirs, so that frequent reporters have
            no advantage (`trust._pair_rank`).
        agreed, met: summed agreement, and number of comparisons, for each other vehicle.
        used_squares, used_products: sums from which `trust.shape_of` estimates by how much friction
            values are too low per unit of unused grip. Each term compares two visits of the vehicle
            to one cell, weighted by accuracy. The first sum adds the squared difference in grip
            used. The second adds this difference times the difference in reported friction.
        flags_confirmed, flags_contradicted: how often values of other vehicles confirmed and
            contradicted the vehicle's slip controllers.
    """

    other: Annotated[Int32Array, constants.PEERS]
    rank: Annotated[Int32Array, constants.PEERS]
    agreed: Annotated[Float32Array, constants.PEERS]
    met: Annotated[Float32Array, constants.PEERS]
    used_squares: np.float32
    used_products: np.float32
    flags_confirmed: np.float32
    flags_contradicted: np.float32


class VehicleRecord:
    """Vehicle that has reported. Its permanent number is its key in the hash table of vehicles."""

    key: int


CELL: Final = record_type(CellRecord)
ENTRY: Final = record_type(EntryRecord)
WINDOW: Final = record_type(WindowRecord)
PAIR: Final = record_type(PairRecord)
SETTLED: Final = record_type(SettledRecord)
SOURCE: Final = record_type(SourcesRecord)
REPORTER: Final = record_type(ReportersRecord)
PEER: Final = record_type(PeersRecord)
VEHICLE: Final = record_type(VehicleRecord)


class Rows(NamedTuple):
    """State of slots, in three arrays.

    Attributes:
        belief: packed beliefs, (n, 32).
        cells: `CellRecord` of each slot, (n,).
        reporters: records of the vehicles that recently reported in a slot; `CellRecord.reporters`
            is the row. They are `ReportersRecord`, or in copies only `SourcesRecord`.
    """

    belief: PackedArray
    cells: RecordArray
    reporters: RecordArray


# Indices into `State.used`: numbers of free windows and of free entries; numbers of active pairs
# and of rows of reporters in use; time [s] before which no settled report was made; number of
# vehicles when pairs were last settled.
FREE_WINDOWS, FREE_ENTRIES, PAIRS, REPORTERS_USED, SETTLED_SINCE, SETTLED_VEHICLES = range(6)


class State(NamedTuple):
    """State of the store in arrays, for compiled code. The terms are defined in the module's
    docstring.

    Attributes:
        live: the current slots.
        base: final state (without the observations in the window) of each slot that has a window,
            in the rows of `windows`. The lists in `base.reporters` have the type `SourcesRecord`:
            they name the vehicles that reported grip or ice, but not their friction values.
        windows, entries: pools (arrays with free rows) of `WindowRecord` and `EntryRecord`.
        free_windows, free_entries: stacks of the pools' free rows.
        pairs: hash table with the records of active pairs (vehicles that reported in a slot
            recently).
        settled: `SettledRecord` of each report of the settled pairs (all other pairs), (k,), sorted
            by slot, vehicle and kind.
        settled_keys: vehicle and kind of each settled report, (k,): four times the vehicle's index,
            plus two times the kind, plus one if the pair is active again.
        settled_std: standard deviation (`PairRecord.std`) of the settled reports that are values,
            in the order of `settled`.
        settled_begin: rows of `settled` and of `settled_std` at which the reports of each slot
            begin, (m + 1, 2). Slots from m on, which are new, have no settled pairs.
        used: (6,) counts, such as the number of free rows of `windows`; the constants from
            FREE_WINDOWS on are the indices.
    """

    live: Rows
    base: Rows
    windows: RecordArray
    free_windows: Int32Array
    entries: RecordArray
    free_entries: Int32Array
    pairs: RecordArray
    settled: RecordArray
    settled_keys: UIntArray
    settled_std: UInt16Array
    settled_begin: UIntArray
    used: IntArray
