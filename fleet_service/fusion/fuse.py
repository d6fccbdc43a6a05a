"""The fusion of one service: observations in, beliefs out. Pure: time comes with the observations.

T is the latest time seen, in whole epochs; the checkpoint lies at T - L. Trust moves with the checkpoint and acts on
observations of the epoch that begins there, so that a vote's weight depends on its own time and not on when it came.
"""

from __future__ import annotations

from dataclasses import dataclass, fields

import numpy as np
from numpy.typing import NDArray

from fleet_service.fusion import constants as c
from fleet_service.fusion.belief import PackedArray, forget, read, unpack
from fleet_service.fusion.cells import NOBODY, NONE, SECOND, Cells, Records
from fleet_service.fusion.stores import Stores, distinct
from fleet_service.fusion.trust import newcomer, trusted
from fleet_service.fusion.votes import PADDED, SCRATCH, P
from fleet_service.fusion.weather import Reports, Weather, aged, no_reports, weather_of
from fleet_service.fusion.window import absorb, settle
from schemas import grid
from schemas.numeric import BoolArray, ByteArray, Float32Array, FloatArray, IntArray
from schemas.runtime.jit import compiled
from schemas.thresholds import NS

SmallArray = NDArray[np.int8]
_ANY = 1 << 62


@dataclass(frozen=True)
class Observations:
    """Admitted visits, arrays of shape (n,).

    Attributes:
        time: end of the visit [ns].
        cell, sector, second: where; `second` is a sector whose edge is near, or -1.
        vehicle, boot, region, place: identity; `vehicle` is a number that stands for the vehicle, `place` counts rows
            in the stream of (vehicle, boot, region).
        evidence: (n, 32) log-likelihood in steps, see `likelihoods.evidence`.
        said: (n, 3) mean, standard deviation and P(slippery) of a value as it was told, NaN to read them in `evidence`.
        beside: (n, k) other cells in which the vehicle may have been instead, -1 where there is none.
        beside_share: (n, k) probability that it was there; what is left belongs to `cell`.
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
    said: Float32Array
    beside: IntArray
    beside_share: Float32Array

    def take(self, rows: IntArray | BoolArray) -> Observations:
        """Some of the rows."""
        return Observations(*(getattr(self, f.name)[rows] for f in fields(self)))


@dataclass(frozen=True)
class Folded:
    """What became of observations: whether each was late or one too many, and so not fused (n,); weight that was used
    (n,); slots that changed (k,)."""

    late: BoolArray
    weight: Float32Array
    slots: IntArray


class Fusion:
    """Beliefs of all cells, and what is needed to go on.

    Args:
        lateness_s: L [s]; an observation older than the checkpoint is reported late and not fused.

    Attributes:
        stores: cells, windows, pairs and vehicles.
        trusts: epoch from which they act, weights by vehicle, and that of an unknown vehicle; the oldest first.
        reports: the weather that may still be asked for.
    """

    def __init__(self, lateness_s: float) -> None:
        self._lateness_ns = int(lateness_s * NS)
        self._kept_epochs = self._lateness_ns // c.EPOCH_NS + 2  # whose trust an observation in time may still need
        self._epoch: int | None = None
        self.stores = Stores()
        self.trusts: list[tuple[int, Float32Array, float]] = [(-1, np.zeros(0, np.float32), newcomer(False))]
        self.reports: Reports = no_reports()
        self._weather: Weather = weather_of(self.reports)

    def resume(self, epoch: int | None, trusts: list[tuple[int, Float32Array, float]], reports: Reports) -> None:
        """Go on from an epoch, the weights that were given since, and the weather; the stores are set before."""
        self._epoch, self.trusts, self.reports = epoch, trusts, reports
        self._weather = weather_of(reports)

    @property
    def epoch(self) -> int:
        """Epoch of the latest time; -1 before the first."""
        return -1 if self._epoch is None else self._epoch

    @property
    def live(self) -> Cells:
        """The cells as they are now; rows beyond `size` are not in use."""
        return self.stores.live

    @property
    def size(self) -> int:
        """Slots in use."""
        return self.stores.size

    @property
    def cell(self) -> IntArray:
        """Cell of every slot, (size,)."""
        return self.live.key[: self.size] // grid.SECTORS

    @property
    def sector(self) -> SmallArray:
        """Sector of every slot, (size,)."""
        return (self.live.key[: self.size] % grid.SECTORS).astype(np.int8)

    @property
    def waiting(self) -> int:
        """Observations in the window, counted per cell."""
        return self.stores.waiting

    @property
    def checkpoint(self) -> int | None:
        """Time of the checkpoint [ns]; None before the first observation."""
        return None if self._epoch is None else self._epoch * c.EPOCH_NS - self._lateness_ns

    @property
    def next_epoch(self) -> int:
        """First time [ns] of which no observation was folded yet; 0 before the first."""
        return 0 if self._epoch is None else (self._epoch + 1) * c.EPOCH_NS

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
        vehicle = self.stores.vehicles_of(o.vehicle)
        epoch = o.time // c.EPOCH_NS
        for e in distinct(epoch[~late]).tolist():
            self._advance(e)
            rows = np.flatnonzero((epoch == e) & ~late)
            used[rows] = self._weights(e, vehicle[rows]) if weight is None else weight[rows]
            slots, left_out = self._absorb(o, rows, vehicle, used, c.WAITING_MOST if weight is None else _ANY)
            touched.append(slots)
            late = late | left_out
            used[left_out] = 0.0
        return Folded(late, used, distinct(np.concatenate(touched)))

    def weather(self, reports: Reports) -> None:
        """Take in weather; each report must act from `next_epoch` on at the earliest, or the map depends on when it
        came."""
        columns = (np.concatenate([getattr(r, f.name) for r in (self.reports, reports)]) for f in fields(Reports))
        self.reports = Reports(*columns)
        if self.checkpoint is not None:  # all that a belief may still ask for is younger than its last visit
            self.reports = _recent(self.reports, self._oldest())
        self._weather = weather_of(self.reports)

    def beliefs(self, slots: IntArray, now: int) -> FloatArray:
        """Belief of each slot about its road, (k, 32), with what time did to it until `now` [ns]."""
        return read(_beliefs(self.stores.state.belief, self.stores.state.cells, self._weather, slots, now))

    def believed(self, slots: IntArray) -> FloatArray:
        """Belief of each slot about its road, (k, 32), at its last observation."""
        return read(self.stores.state.belief[slots].astype(np.float64))

    def slots_of(self, cell: IntArray, sector: IntArray | SmallArray) -> IntArray:
        """Slot of each cell and sector, -1 where nobody was."""
        return self.stores.slots_of(cell * grid.SECTORS + sector)

    def trust(self, vehicle: int) -> float:
        """Weight of a vehicle's next vote."""
        index = self.stores.known(np.array([vehicle]))
        newest = self.trusts[-1][0]
        return float(self._weights(newest, np.where(index < 0, self.stores.vehicles, index))[0])

    def witnesses(self, slots: IntArray, kind: int, since: IntArray | int) -> tuple[IntArray, IntArray]:
        """Vehicles that called slots (k,) GRIP or ICE after `since` [ns] and are still trusted: how many, and the last.

        At most WITNESSES are remembered; the last time [ns] is 0 where there is none.
        """
        voice, voices = self.live.voice[slots], self.stores.state.voices
        who = np.where(voice[:, None] == NONE, NOBODY, voices["witness"][voice, kind])
        when = voices["witnessed"][voice, kind].astype(np.int64) * SECOND
        trust = self._weights(self.trusts[-1][0], np.maximum(who, 0)) >= c.WITNESS_TRUST
        counted = (who != NOBODY) & trust & (when > np.reshape(since, (-1, 1)))
        return counted.sum(axis=1), np.where(counted, when, 0).max(axis=1)

    def _weights(self, epoch: int, vehicle: IntArray) -> Float32Array:
        record = next(record for record in reversed(self.trusts) if record[0] <= epoch or record[0] < 0)
        known, unknown = record[1], np.float32(record[2])
        inside = vehicle < len(known)
        return np.where(inside, np.append(known, unknown)[np.where(inside, vehicle, len(known))], unknown)

    def _advance(self, epoch: int) -> None:
        """Move T to `epoch`, one epoch at a time while the window holds anything."""
        if self._epoch is None:
            self._epoch = epoch
        while self._epoch < epoch:
            self._epoch = self._epoch + 1 if self.waiting else epoch
            before = self._epoch * c.EPOCH_NS - self._lateness_ns
            stores = self.stores
            for due in stores.due_windows(before):
                settle(stores.state, self._weather, stores.peers, stores.names, due, before)
            stores.forget(before // SECOND)
            weights = self.trusts[-1][1]
            joined = np.full(stores.vehicles - len(weights), newcomer(False), np.float32)
            weights, established = trusted(stores.peers, np.append(weights, joined))
            record = (self._epoch, weights, newcomer(established))
            self.trusts = [self.trusts[0], *self.trusts[1:][-self._kept_epochs :], record]

    def _absorb(
        self, o: Observations, rows: IntArray, vehicle: IntArray, weight: Float32Array, most: int
    ) -> tuple[IntArray, BoolArray]:  # fmt: skip
        rows = rows[np.argsort(o.time[rows], kind="stable")]  # in the order of time nothing has to be folded again
        at, keys, share = _votes(o, rows)
        slots = self.stores.slots_for(keys)
        self.stores.reserve(len(slots))
        left_out = absorb(
            self.stores.state, self._weather, slots, at, share, o.time, o.vehicle, o.boot, o.place, vehicle, weight,
            o.evidence, o.said, most,
        )  # fmt: skip
        return slots, left_out

    def _oldest(self) -> int:
        times = self.live.time[: self.size]
        return int(times.min(initial=np.iinfo(np.int64).max, where=times > 0))


def _votes(o: Observations, rows: IntArray) -> tuple[IntArray, IntArray, Float32Array]:
    """Votes of some observations: row, key and share; those beside and in a second sector too. In order of `rows`."""
    own = 1.0 - o.beside_share[rows].sum(axis=1)
    key = o.cell[rows] * grid.SECTORS
    at, keys, share = [rows], [key + o.sector[rows]], [own]
    second = np.flatnonzero(o.second[rows] >= 0)
    if len(second):
        at.append(rows[second])
        keys.append(key[second] + o.second[rows[second]])
        share.append(own[second])
    beside, which = np.nonzero(o.beside[rows] >= 0)
    if len(beside):
        at.append(rows[beside])
        keys.append(o.beside[rows[beside], which] * grid.SECTORS + o.sector[rows[beside]])
        share.append(o.beside_share[rows[beside], which])
    whole = np.concatenate(at)
    order = np.argsort(o.time[whole], kind="stable") if len(at) > 1 else slice(None)
    return whole[order], np.concatenate(keys)[order], np.concatenate(share)[order].astype(np.float32)


def _recent(reports: Reports, oldest: int) -> Reports:
    """Without those that ended before `oldest` [ns]."""
    return reports.take(reports.time >= oldest - 4 * 3600 * SECOND)


@compiled
def _beliefs(belief: PackedArray, cells: Records, weather: Weather, slots: IntArray, now: int) -> FloatArray:
    scratch = np.empty((3, SCRATCH))
    p = scratch[P]
    out = np.empty((len(slots), belief.shape[1]))
    for k in range(len(slots)):
        slot = slots[k]
        unpack(belief, slot, p)
        seconds = max((now - cells[slot].time) * 1e-9, 0.0) + cells[slot].aged
        drift, change, prior = aged(weather, cells[slot].key, now - int(seconds * NS), now)
        forget(p, drift, change, weather.prior[prior], scratch[PADDED])
        for i in range(belief.shape[1]):
            out[k, i] = p[i]
    return out
