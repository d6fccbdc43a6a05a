"""The fusion of one service: observations in, beliefs out. Pure: time comes with the observations.

T is the latest time seen, in whole epochs; the checkpoint lies at T - L. Trust moves with the
checkpoint and acts on observations of the epoch that begins there, so that a vote's weight depends
on its own time and not on when it came.
"""

from __future__ import annotations

from dataclasses import fields
from typing import Final, NamedTuple

import numpy as np

from fleet_service.fusion import constants as c
from fleet_service.fusion.belief import SLIPPERY_SHARE, unpack_belief
from fleet_service.fusion.late import LATE_MOST_NS, delay_observations, fused_at
from fleet_service.fusion.neighbours import road_beliefs
from fleet_service.fusion.observations import Observations, SmallArray
from fleet_service.fusion.shared import KERNELS, UNKNOWN_SHAPE, kernel_of, shape_class, shared_parts
from fleet_service.fusion.store.cells import Cells
from fleet_service.fusion.store.records import CLAIMED, HEEDED, NOBODY, NONE, USED, Rows
from fleet_service.fusion.store.store import Store, distinct_values
from fleet_service.fusion.trust import compute_vote_weights, initial_trust, shape_of
from fleet_service.fusion.vote_weights import VoteWeights, initial_vote_weights
from fleet_service.fusion.weather import Reports, Weather, no_reports, weather_of
from fleet_service.fusion.window import Arrivals, Votes, absorb_votes, commit_windows
from schemas import grid
from schemas.numeric import BoolArray, Float32Array, FloatArray, IntArray
from schemas.runtime.jit import compiled
from schemas.thresholds import NS

_ANY: Final = 1 << 62
# What each bin of a belief adds to P(slippery) of the road, and to all of it, by the fleet's shape:
# (kernels, 2, 32).
SLIPPERY_WEIGHTS: Final = tuple(
    np.stack([k @ SLIPPERY_SHARE, k.sum(axis=2, dtype=float)], axis=1) for k in KERNELS
)


class Updated(NamedTuple):
    """Outcome of an update for each observation (n,), and the slots that changed.

    Attributes:
        late: True for an observation that is older than the checkpoint, or that was not fused
            because too many visits of its vehicle to the cell were in the window.
        late_by: delay between the time of a late observation and the time at which it is fused
            [ns]; 0 if it is in time or not fused.
        weight: weight that was used; 0 if the observation was not fused.
        slots: slots that changed, (k,).
    """

    late: BoolArray
    late_by: IntArray
    weight: Float32Array
    slots: IntArray


class RecordedResult(NamedTuple):
    """Values of `Updated` at the first fusion, used when an archive is replayed."""

    late: BoolArray
    late_by: IntArray
    weight: Float32Array


class Fusion:
    """Beliefs of all cells, and the state that later updates need.

    Args:
        lateness_s: L [s]; an observation older than the checkpoint is late, and is fused with aged
            evidence.
        enrolled: True if only vehicles of an enrolment file are fused; an unknown vehicle then has
            full weight.

    Attributes:
        enrolled: as above.
        store: cells, windows, pairs and vehicles.
        vote_weights: of the vehicles, one record per epoch, the oldest first.
        reports: the weather that a later update may still need.
    """

    def __init__(self, lateness_s: float, *, enrolled: bool = False) -> None:
        self.enrolled = enrolled
        self._lateness_ns = int(lateness_s * NS)
        self._kept_epochs = (
            self._lateness_ns // c.EPOCH_NS + 2
        )  # whose trust an observation in time may still need
        self._epoch: int | None = None
        self.store = Store()
        self.vote_weights: list[VoteWeights] = [initial_vote_weights(initial_trust(False))]
        self.reports: Reports = no_reports()
        self._weather: Weather = weather_of(self.reports)
        self._shape = UNKNOWN_SHAPE

    def resume(self, epoch: int | None, vote_weights: list[VoteWeights], reports: Reports) -> None:
        """Continue from a checkpoint: its epoch, vote weights and weather; the caller has set `store`."""
        self._epoch = epoch
        self.vote_weights = vote_weights
        self.reports = reports
        self._weather = weather_of(reports)
        self._find_shape()

    @property
    def epoch(self) -> int:
        """Epoch of the latest time; -1 before the first."""
        return -1 if self._epoch is None else self._epoch

    @property
    def live(self) -> Cells:
        """The cells as they are now; rows beyond `size` are not in use."""
        return self.store.live

    @property
    def size(self) -> int:
        """Number of slots in use."""
        return self.store.size

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
        return self.store.waiting

    @property
    def checkpoint(self) -> int | None:
        """Time of the checkpoint [ns]; None before the first observation."""
        return None if self._epoch is None else self._epoch * c.EPOCH_NS - self._lateness_ns

    @property
    def next_epoch(self) -> int:
        """First time [ns] that lies after all fused epochs; 0 before the first observation."""
        return 0 if self._epoch is None else (self._epoch + 1) * c.EPOCH_NS

    def update(self, o: Observations, before: RecordedResult | None = None) -> Updated:
        """Fuse observations in any order.

        A late one is fused at the checkpoint, with its evidence aged to that time
        (`late.aged_evidence`).

        Args:
            o: the observations.
            before: values of `Updated` at the first fusion, when an archive is replayed.
        """
        n = len(o.time)
        used = np.zeros(n, np.float32)
        limited = np.zeros(n, np.int8)
        if before is None:
            checkpoint = np.iinfo(np.int64).min if self.checkpoint is None else self.checkpoint
            late = o.time < checkpoint
            late_by = np.where(
                late & (checkpoint - o.time <= LATE_MOST_NS),
                fused_at(o.time, checkpoint) - o.time,
                0,
            )
        else:
            late = before.late
            late_by = before.late_by
        old = late_by > 0
        if old.any():
            o = delay_observations(o, late_by, self._weather)
        left = late & ~old
        vehicle = self.store.vehicles_of(o.vehicle)
        epoch = o.time // c.EPOCH_NS
        touched = [np.zeros(0, np.int64)]
        for e in distinct_values(epoch[~left]).tolist():
            self._advance(e)
            rows = np.flatnonzero((epoch == e) & ~left)
            votes = self._vote_weights_at(e)
            limited[rows] = (
                np.where(votes.may_support_alerts(vehicle[rows]), HEEDED, CLAIMED) * o.limited[rows]
            )
            if before is None:
                used[rows] = votes.weights(vehicle[rows])
            else:
                used[rows] = before.weight[rows]
            arrivals = _make_arrivals(o, vehicle, used, old)._replace(limited=limited)
            slots, left_out = self._absorb(
                o, rows, arrivals, c.WAITING_MOST if before is None else _ANY
            )
            touched.append(slots)
            late = late | left_out
            left = left | left_out
        used[left] = 0.0
        late_by = np.where(left, 0, late_by)
        return Updated(late, late_by, used, distinct_values(np.concatenate(touched)))

    def untouched(self, before: int) -> BoolArray:
        """Return True for each slot (size,) whose last visit was before `before` [ns] and that
        nothing else refers to; see `drop`.
        """
        return self.store.untouched(before)

    def drop(self, dropped: BoolArray) -> IntArray:
        """Delete slots (size,) that are `untouched`; return the new number of each slot, -1 for
        deleted ones.
        """
        return self.store.drop(dropped)

    def update_weather(self, reports: Reports) -> None:
        """Add weather reports. None may apply before `next_epoch`, because otherwise the map would
        depend on the time of arrival.
        """
        columns = (
            np.concatenate([getattr(r, f.name) for r in (self.reports, reports)])
            for f in fields(Reports)
        )
        self.reports = Reports(*columns)
        if (
            self.checkpoint is not None
        ):  # all that a belief may still ask for is younger than its last visit
            self.reports = _drop_old_reports(self.reports, self._oldest())
        self._weather = weather_of(self.reports)

    def beliefs(self, slots: IntArray, now: int, rows: Rows | None = None) -> FloatArray:
        """Return the belief about the road of each slot, (k, 32), predicted to `now` [ns],
        including the evidence of slippery neighbours; of a copy of the live rows if `rows` is one.
        """
        kernels = KERNELS[shape_class(self._shape.reader)]
        return self._read(kernels, slots, np.full(len(slots), now), rows)

    def beliefs_at_last_report(self, slots: IntArray) -> FloatArray:
        """Return the belief about the road of each slot, (k, 32), at its last observation."""
        return self._read(KERNELS[shape_class(self._shape.reader)], slots, self.live.time[slots])

    def slippery(self, slots: IntArray) -> FloatArray:
        """Return P(slippery) of each slot (k,) at its last observation, from its own reports alone."""
        return _slippery_probability(
            self.store.state.live, SLIPPERY_WEIGHTS[shape_class(self._shape.reader)], slots
        )

    def beliefs_for_alerts(self, slots: IntArray) -> FloatArray:
        """Return the same as `beliefs_at_last_report`, but with the upper end of the range of the
        slope, which alarms assume for gentle values; see `shared`.
        """
        return self._read(KERNELS[shape_class(self._shape.alarm)], slots, self.live.time[slots])

    def _read(
        self, kernels: Float32Array, slots: IntArray, now: IntArray, rows: Rows | None = None
    ) -> FloatArray:
        rows = self.store.state.live if rows is None else rows
        return road_beliefs(rows, self.store.table, self._weather, kernels, slots, now)

    def slots_of(self, cell: IntArray, sector: IntArray | SmallArray) -> IntArray:
        """Return the slot of each cell and sector, -1 if no vehicle has reported it."""
        return self.store.slots_of(cell * grid.SECTORS + sector)

    def trust(self, vehicle: int) -> float:
        """Return the weight of a vehicle's next vote."""
        return float(self.vote_weights[-1].weights(self._index(vehicle))[0])

    def _index(self, vehicle: int) -> IntArray:
        index = self.store.known(np.array([vehicle]))
        return np.where(index < 0, self.store.vehicles, index)

    def sources(self, slots: IntArray, side: int, since: IntArray | int) -> IntArray:
        """Return the report times of the corroborating sources of slots (k,), newest first, (k,
        SOURCES) [ns].

        A source is a vehicle, still trusted, that reported GRIP or ICE there after `since` [ns]. At
        most SOURCES are remembered; 0 stands for none.
        """
        _, when = self.find_sources(slots, side, since)
        return -np.sort(-when, axis=1)

    def find_sources(
        self, slots: IntArray, side: int, since: IntArray | int
    ) -> tuple[IntArray, IntArray]:
        """Return index and time [ns] of each remembered source, (k, SOURCES); time 0 if it does
        not count.
        """
        row = self.live.reporters[slots]
        reporters = self.store.state.live.reporters
        who = np.where(row[:, None] == NONE, NOBODY, reporters["source"][row, side])
        when = reporters["source_time"][row, side].astype(np.int64) * NS
        trusted = self.vote_weights[-1].weights(np.maximum(who, 0)) >= c.SOURCE_TRUST
        counted = (who != NOBODY) & trusted & (when > np.reshape(since, (-1, 1)))
        return who, np.where(counted, when, 0)

    def _vote_weights_at(self, epoch: int) -> VoteWeights:
        return next(
            found
            for found in reversed(self.vote_weights)
            if found.epoch <= epoch or found.epoch < 0
        )

    def _advance(self, epoch: int) -> None:
        """Move T to `epoch`, one epoch at a time while the window has entries."""
        if self._epoch is None:
            self._epoch = epoch
        while self._epoch < epoch:
            self._epoch = self._epoch + 1 if self.waiting else epoch
            before = self._epoch * c.EPOCH_NS - self._lateness_ns
            store = self.store
            for due in store.due_windows(before):
                commit_windows(store.state, self._weather, store.peers, store.names, due, before)
            store.forget(before // NS)
            last = self.vote_weights[-1]
            joined = store.vehicles - len(last.weight)
            weight = np.append(last.weight, np.full(joined, initial_trust(False), np.float32))
            votes = compute_vote_weights(
                store.peers, last._replace(weight=weight), self._epoch, enrolled=self.enrolled
            )
            self.vote_weights = [
                self.vote_weights[0],
                *self.vote_weights[1:][-self._kept_epochs :],
                votes,
            ]
            self._find_shape()

    def _find_shape(self) -> None:
        self._shape = shape_of(self.store.peers, self.vote_weights[-1].weight)

    def _absorb(
        self, o: Observations, rows: IntArray, arrivals: Arrivals, most: int
    ) -> tuple[IntArray, BoolArray]:
        rows = rows[
            np.argsort(o.time[rows], kind="stable")
        ]  # in the order of time nothing is computed again
        at, keys, share = _spread_votes(o, rows)
        slots = self.store.slots_for(keys)
        self.store.reserve(len(slots))
        return slots, absorb_votes(
            self.store.state, self._weather, arrivals, Votes(at, slots, share), most
        )

    def _oldest(self) -> int:
        times = self.live.time[: self.size]
        return int(times.min(initial=np.iinfo(np.int64).max, where=times > 0))


def _make_arrivals(
    o: Observations, vehicle: IntArray, weight: Float32Array, old: BoolArray
) -> Arrivals:
    return Arrivals(
        time=o.time,
        number=o.vehicle,
        boot=o.boot,
        sequence=o.sequence,
        vehicle=vehicle,
        weight=weight,
        evidence=o.evidence,
        reported=o.reported,
        used=(np.clip(o.used, 0.0, 2.5) * USED).astype(np.uint8),
        shared=shared_parts(o.reported),
        manoeuvre=o.manoeuvre,
        late=old,
        limited=np.zeros(len(o.time), np.int8),
    )


def voted_keys(o: Observations) -> IntArray:
    """Return the keys that observations vote on, with repetitions."""
    return _spread_votes(o, np.arange(len(o.time)))[1]


def _spread_votes(o: Observations, rows: IntArray) -> tuple[IntArray, IntArray, Float32Array]:
    """Return the votes of some observations, sorted by time: row, key and share.

    An observation may also vote on a second sector and on neighbouring cells.
    """
    own = 1.0 - o.other_share[rows].sum(axis=1)
    key = o.cell[rows] * grid.SECTORS
    at = [rows]
    keys = [key + o.sector[rows]]
    share = [own]
    second = np.flatnonzero(o.second[rows] >= 0)
    if len(second):
        at.append(rows[second])
        keys.append(key[second] + o.second[rows[second]])
        share.append(own[second])
    elsewhere, which = np.nonzero(o.other[rows] >= 0)
    if len(elsewhere):
        at.append(rows[elsewhere])
        keys.append(o.other[rows[elsewhere], which] * grid.SECTORS + o.sector[rows[elsewhere]])
        share.append(o.other_share[rows[elsewhere], which])
    whole = np.concatenate(at)
    order = np.argsort(o.time[whole], kind="stable") if len(at) > 1 else slice(None)
    return (
        whole[order],
        np.concatenate(keys)[order],
        np.concatenate(share)[order].astype(np.float32),
    )


def _drop_old_reports(reports: Reports, oldest: int) -> Reports:
    """Return the reports without those that ended before `oldest` [ns]."""
    return reports.take(reports.time >= oldest - 4 * 3600 * NS)


@compiled
def _slippery_probability(live: Rows, weights: FloatArray, slots: IntArray) -> FloatArray:
    p = np.empty(live.belief.shape[1])
    out = np.empty(len(slots))
    for k in range(len(slots)):
        unpack_belief(live.belief, slots[k], p)
        weight = weights[kernel_of(live.cells, slots[k])]
        slippery = 0.0
        whole = 0.0
        for i in range(len(p)):
            slippery += weight[0, i] * p[i]
            whole += weight[1, i] * p[i]
        out[k] = slippery / whole
    return out
