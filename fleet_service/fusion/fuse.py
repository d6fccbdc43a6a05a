"""The fusion of one service: observations in, beliefs out. Pure: time comes with the observations.

T is the latest time seen, in whole epochs; the checkpoint lies at T - L. Trust moves with the checkpoint and acts on
observations of the epoch that begins there, so that a vote's weight depends on its own time and not on when it came.
"""

from __future__ import annotations

from dataclasses import dataclass, fields

import numpy as np
from numpy.typing import NDArray

from fleet_service.fusion import constants as c
from fleet_service.fusion.belief import forget
from fleet_service.fusion.cells import Cells, empty, extended
from fleet_service.fusion.table import EMPTY, grown, places_of, room, slots_of
from fleet_service.fusion.trust import newcomer, no_peers, no_speakers, trusted
from fleet_service.fusion.window import NONE, Entries, Links, Pairs, absorb, no_entries, no_links, no_pairs, settle
from schemas import grid
from schemas.numeric import BoolArray, ByteArray, Float32Array, FloatArray, IntArray, compiled

SmallArray = NDArray[np.int8]
_FIRST_SLOTS = 1024
_FIRST_VEHICLES = 64


@dataclass(frozen=True)
class Observations:
    """Admitted visits, arrays of shape (n,).

    Attributes:
        time: end of the visit [ns].
        cell, sector, second: where; `second` is a sector whose edge is near, or -1.
        vehicle, boot, region, place: identity; `vehicle` is a number that stands for the vehicle, `place` counts rows
            in the stream of (vehicle, boot, region).
        evidence: (n, 32) log-likelihood in steps, see `likelihoods.evidence`.
    """

    time: IntArray
    cell: IntArray
    sector: SmallArray
    second: SmallArray
    vehicle: IntArray
    boot: IntArray
    region: IntArray
    place: IntArray
    evidence: ByteArray

    def take(self, rows: IntArray | BoolArray) -> Observations:
        """Some of the rows."""
        return Observations(*(getattr(self, f.name)[rows] for f in fields(self)))


@dataclass(frozen=True)
class Folded:
    """What became of observations: late or fused (n,), weight that was used (n,), slots that changed (k,)."""

    late: BoolArray
    weight: Float32Array
    slots: IntArray


class Fusion:
    """Beliefs of all cells, and what is needed to go on.

    Args:
        lateness_s: L [s]; an observation older than the checkpoint is reported late and not fused.
    """

    def __init__(self, lateness_s: float) -> None:
        self._lateness_ns = int(lateness_s * 1e9)
        self._kept_epochs = self._lateness_ns // c.EPOCH_NS + 2  # whose trust an observation in time may still need
        self._epoch: int | None = None
        self._keys, self._slots = np.full(2 * _FIRST_SLOTS, EMPTY), np.zeros(2 * _FIRST_SLOTS, np.int64)
        self.cell, self.sector = np.zeros(_FIRST_SLOTS, np.int64), np.zeros(_FIRST_SLOTS, np.int8)
        self.size = 0
        self.live, self._kept = empty(_FIRST_SLOTS), empty(_FIRST_SLOTS)
        self._links: Links = no_links(_FIRST_SLOTS)
        self._entries: Entries = no_entries(_FIRST_SLOTS)
        self._pairs, self._pair_count = no_pairs(2 * _FIRST_SLOTS), 0
        self._vehicles: dict[int, int] = {}
        self._speakers, self._peers = no_speakers(_FIRST_SLOTS), no_peers(_FIRST_VEHICLES)
        self._trust: list[tuple[int, Float32Array, float]] = [(-1, np.zeros(0, np.float32), newcomer(False))]

    @property
    def waiting(self) -> int:
        """Observations in the window, counted per cell."""
        return len(self._entries.free) - int(self._entries.unused[0])

    @property
    def checkpoint(self) -> int | None:
        """Time of the checkpoint [ns]; None before the first observation."""
        return None if self._epoch is None else self._epoch * c.EPOCH_NS - self._lateness_ns

    def fold(self, o: Observations, weight: Float32Array | None = None, late: BoolArray | None = None) -> Folded:
        """Take in observations in any order.

        Args:
            o: the observations.
            weight, late: what `Folded` said the first time, when an archive is replayed.
        """
        if late is None:
            late = np.zeros(len(o.time), bool) if self.checkpoint is None else o.time < self.checkpoint
        used = np.zeros(len(o.time), np.float32)
        touched = [np.zeros(0, np.int64)]
        vehicle = self._indices(o.vehicle)
        epoch = o.time // c.EPOCH_NS
        for e in np.unique(epoch[~late]).tolist():
            self._advance(e)
            rows = np.flatnonzero((epoch == e) & ~late)
            used[rows] = self._weights(e, vehicle[rows]) if weight is None else weight[rows]
            touched.append(self._absorb(o.take(rows), vehicle[rows], used[rows]))
        return Folded(late, used, np.unique(np.concatenate(touched)))

    def beliefs(self, slots: IntArray, now: int) -> FloatArray:
        """Belief of each slot, (k, 32), with what time did to it until `now` [ns]."""
        return _beliefs(self.live, slots, now)

    def slots_of(self, cell: IntArray, sector: IntArray | SmallArray) -> IntArray:
        """Slot of each cell and sector, -1 where nobody was."""
        place = places_of(self._keys, cell * grid.SECTORS + sector)
        return np.where(self._keys[place] == EMPTY, NONE, self._slots[place])

    def trust(self, vehicle: int) -> float:
        """Weight of a vehicle's next vote."""
        index = self._vehicles.get(vehicle)
        newest = self._trust[-1][0]
        return float(self._weights(newest, np.array([len(self._vehicles) if index is None else index]))[0])

    def _indices(self, vehicle: IntArray) -> IntArray:
        ids, inverse = np.unique(vehicle, return_inverse=True)
        known = self._vehicles
        indices = np.array([known.setdefault(i, len(known)) for i in ids.tolist()], np.int64)
        if len(known) > len(self._peers.other):
            self._peers = extended(self._peers, no_peers(2 * len(known)))
        return np.asarray(indices[inverse])

    def _weights(self, epoch: int, vehicle: IntArray) -> Float32Array:
        record = next(record for record in reversed(self._trust) if record[0] <= epoch or record[0] < 0)
        known, unknown = record[1], np.float32(record[2])
        inside = vehicle < len(known)
        return np.where(inside, np.append(known, unknown)[np.where(inside, vehicle, len(known))], unknown)

    def _advance(self, epoch: int) -> None:
        """Move T to `epoch`, one epoch at a time while the window holds anything."""
        if self._epoch is None:
            self._epoch = epoch
        while self._epoch < epoch:
            self._epoch = self._epoch + 1 if self.waiting else epoch
            self._settle(self._epoch * c.EPOCH_NS - self._lateness_ns)
            before = self._trust[-1][1]
            joined = np.full(len(self._vehicles) - len(before), newcomer(False), np.float32)
            weights, established = trusted(self._peers, np.append(before, joined))
            record = (self._epoch, weights, newcomer(established))
            self._trust = [self._trust[0], *self._trust[1:][-self._kept_epochs :], record]

    def _settle(self, before: int) -> None:
        if not self.waiting:
            return
        self._reserve_pairs(self.waiting)
        slots = np.flatnonzero(self._links.head[: self.size] != NONE)
        slots = slots[
            np.lexsort((self.sector[slots], self.cell[slots]))
        ]  # an order that does not depend on who came first
        self._pair_count += settle(
            self._kept, self._links, self._entries, self._pairs, self._speakers, self._peers, slots, before
        )

    def _absorb(self, o: Observations, vehicle: IntArray, weight: Float32Array) -> IntArray:
        both = np.flatnonzero(o.second >= 0)
        rows = np.concatenate([np.arange(len(o.time)), both])
        keys = np.concatenate([o.cell, o.cell[both]]) * grid.SECTORS + np.concatenate([o.sector, o.second[both]])
        order = np.argsort(o.time[rows], kind="stable")  # in the order of time nothing has to be folded again
        rows, keys = rows[order], keys[order]
        slots = self._slots_for(keys)
        if self._entries.unused[0] < len(rows):
            places = max(2 * len(self._entries.free), self.waiting + len(rows))
            self._entries = _more_entries(self._entries, places)
        identity = np.stack([o.vehicle, o.boot, o.region, o.place], axis=1)
        absorb(
            self.live, self._kept, self._links, self._entries, self._pairs,
            slots, o.time[rows], identity[rows], vehicle[rows], weight[rows], o.evidence[rows],
        )  # fmt: skip
        return slots

    def _slots_for(self, keys: IntArray) -> IntArray:
        if 2 * (self.size + len(keys)) > len(self._keys):
            self._keys, old, new = grown(self._keys, room(2 * (self.size + len(keys))))
            moved = np.zeros(len(self._keys), np.int64)
            moved[new] = self._slots[old]
            self._slots = moved
        slots = slots_of(self._keys, self._slots, keys, self.size)
        size = max(self.size, int(slots.max()) + 1)
        if size > len(self.cell):
            self._more_slots(2 * size)
        self.cell[slots], self.sector[slots] = keys // grid.SECTORS, (keys % grid.SECTORS).astype(np.int8)
        self.size = size
        return slots

    def _more_slots(self, slots: int) -> None:
        self.cell, self.sector = (np.append(a, np.zeros(slots - len(a), a.dtype)) for a in (self.cell, self.sector))
        self.live = extended(self.live, empty(slots))
        self._kept = extended(self._kept, empty(slots))
        self._links = extended(self._links, no_links(slots))
        self._speakers = extended(self._speakers, no_speakers(slots))

    def _reserve_pairs(self, more: int) -> None:
        if 2 * (self._pair_count + more) > len(self._pairs.keys):
            keys, old, new = grown(self._pairs.keys, room(2 * (self._pair_count + more)))
            larger = no_pairs(len(keys))._replace(keys=keys)
            for name in Pairs._fields[1:]:
                getattr(larger, name)[new] = getattr(self._pairs, name)[old]
            self._pairs = larger


def _more_entries(old: Entries, places: int) -> Entries:
    unused, had = int(old.unused[0]), len(old.free)
    new = extended(old, no_entries(places))
    new.free[:unused] = old.free[:unused]
    new.free[unused : unused + places - had] = np.arange(had, places)
    new.unused[0] = unused + places - had
    return new


@compiled
def _beliefs(cells: Cells, slots: IntArray, now: int) -> FloatArray:
    out = np.empty((len(slots), cells.belief.shape[1]))
    for k in range(len(slots)):
        out[k] = cells.belief[slots[k]]
        forget(out[k], (now - cells.time[slots[k]]) * 1e-9)
    return out
