"""The fusion of one service: it takes the vehicles' observations and computes the beliefs about the
friction of all cells. The module is pure: it reads no clock, because time comes with the
observations.

T is the latest observation time, in whole epochs (minutes). The checkpoint is at T - L, where L is
the allowed lateness (delay of an observation). Observations from before the checkpoint are final.
When the checkpoint advances, trust in vehicles is updated; the new trust applies to observations of
the epoch that begins at T. Therefore the weight of an observation depends on the time of the visit,
and not on the time of its arrival.
"""

from __future__ import annotations

from dataclasses import fields, replace
from typing import Final, NamedTuple

import numpy as np

from fleet_service.fusion import constants
from fleet_service.fusion.belief_map import BeliefMap
from fleet_service.fusion.late import LATE_MOST_NS, fused_at
from fleet_service.fusion.observations import Observations
from fleet_service.fusion.shared import shared_parts
from fleet_service.fusion.store.records import CLAIMED, HEEDED, LATE_NS, UNLIMITED, USED
from fleet_service.fusion.store.store import Store, distinct_values
from fleet_service.fusion.trust import compute_vote_weights, initial_trust, shape_of
from fleet_service.fusion.vote_weights import VoteWeights, initial_vote_weights
from fleet_service.fusion.weather import Reports, no_reports, weather_of
from fleet_service.fusion.window import (
    Arrivals,
    VehicleRecords,
    Votes,
    absorb_votes,
    commit_windows,
)
from schemas import grid
from schemas.numeric import BoolArray, Float32Array, IntArray
from schemas.thresholds import NS

_ANY: Final = np.iinfo(np.int64).max  # no limit on the number of visits


class Updated(NamedTuple):
    """Outcome of an update: arrays (n,) with one item per observation, and the slots that changed.
    A slot is the storage of one cell and heading sector.

    Attributes:
        late: True for an observation that is older than the checkpoint (the time before which
            observations are final), or that was not fused because too many recent visits of its
            vehicle to the cell were stored.
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
    """Outcome of an earlier update (columns of `Updated`, (n,)), stored in the archive when the
    observations were fused for the first time. A replay of the archive uses it again.
    """

    late: BoolArray
    late_by: IntArray
    weight: Float32Array


class Fusion(BeliefMap):
    """Beliefs of all cells, and the state that later updates need. A slot is the storage of one
    cell and heading sector.

    Args:
        lateness_s: allowed lateness L [s]; an observation older than the checkpoint (latest time -
            L) is late, and may be fused with an aged (less certain) likelihood.
        enrolled: True if the service accepts only vehicles on the operator's list. Then nobody can
            invent a name, so a vehicle without a history has full weight (`trust.initial_trust`).

    Attributes:
        reports: weather reports that a later update may still need.
    """

    def __init__(self, lateness_s: float, *, enrolled: bool = False) -> None:
        self.enrolled = enrolled
        self._lateness_ns = int(lateness_s * NS)
        # number of epochs whose vote weights an observation in time may still need
        self._kept_epochs = self._lateness_ns // constants.EPOCH_NS + 2
        self._epoch: int | None = None
        self.reports: Reports = no_reports()
        super().__init__(
            Store(),
            [initial_vote_weights(initial_trust(enrolled=enrolled))],
            weather_of(self.reports),
        )

    def resume(self, epoch: int | None, vote_weights: list[VoteWeights], reports: Reports) -> None:
        """Continue from a checkpoint (saved state of a service), with its epoch (minute), vote
        weights (trust in vehicles) and weather. The caller must have set `store` before.
        """
        self._epoch = epoch
        self.vote_weights = vote_weights
        self.reports = reports
        self._weather = weather_of(reports)
        self._find_shape()

    @property
    def epoch(self) -> int:
        """Return the epoch (minute since 1970) of the latest fused observation; -1 before the first
        observation.
        """
        return -1 if self._epoch is None else self._epoch

    @property
    def waiting(self) -> int:
        """Return the number of observations in the lateness windows: the recent observations, which
        are not final because late ones may still be sorted in before them. An observation that
        affects two sectors counts twice.
        """
        return self.store.waiting

    @property
    def checkpoint(self) -> int | None:
        """Return the time of the checkpoint [ns]: observations before it are final. If an
        observation from before the checkpoint arrives later, it is processed as if it had been made
        at the checkpoint. The result is None before the first observation.
        """
        return None if self._epoch is None else self._epoch * constants.EPOCH_NS - self._lateness_ns

    @property
    def next_epoch(self) -> int:
        """Return the start [ns] of the first epoch (minute) that has not been fused yet; 0 before
        the first observation.
        """
        return 0 if self._epoch is None else (self._epoch + 1) * constants.EPOCH_NS

    def update(self, observations: Observations, before: RecordedResult | None = None) -> Updated:
        """Fuse observations in any order and return the outcome for each.

        A late observation is fused at the checkpoint (the time before which observations are
        final), as a report of the time of its visit (`late`).

        Args:
            observations: n observations.
            before: outcome that was recorded when these observations were fused for the first time;
                given only when an archive is replayed.
        """
        if before is None:
            late, late_by = _find_late(observations.time, self.checkpoint)
            most_waiting = constants.WAITING_MOST
        else:
            late = before.late
            late_by = before.late_by
            most_waiting = _ANY
        delayed = late_by > 0
        if delayed.any():
            observations = replace(observations, time=observations.time + late_by)
        left_out = late & ~delayed
        vehicle = self.store.vehicles_of(observations.vehicle)
        epoch = observations.time // constants.EPOCH_NS
        # The loop writes weight and flags of one epoch after the other into these arrays.
        arrivals = _make_arrivals(observations, vehicle, late_by)
        touched = [np.zeros(0, np.int64)]
        for current in distinct_values(epoch[~left_out]).tolist():
            self._advance(current)
            rows = np.flatnonzero((epoch == current) & ~left_out)
            votes = self._vote_weights_at(current)
            arrivals.weight[rows] = (
                votes.weights(vehicle[rows]) if before is None else before.weight[rows]
            )
            flagged = rows[observations.limited[rows] > 0]
            arrivals.limited[flagged] = np.where(
                votes.may_support_alerts(vehicle[flagged]), HEEDED, CLAIMED
            )
            slots, exceeding = self._absorb(observations, rows, arrivals, most_waiting)
            touched.append(slots)
            late = late | exceeding
            left_out = left_out | exceeding
        arrivals.weight[left_out] = 0.0
        late_by = np.where(left_out, 0, late_by)
        changed = np.concatenate(touched).astype(np.int32)  # NumPy sorts these twice as fast
        slots = distinct_values(changed).astype(np.int64)
        return Updated(late, late_by, arrivals.weight, slots)

    def untouched(self, before: int) -> BoolArray:
        """Return a mask of slots (one per cell and heading sector), (size,): True if the last visit
        of a vehicle was before `before` [ns] and no other record refers to the slot. Such slots may
        be deleted with `drop`.
        """
        return self.store.untouched(before)

    def drop(self, dropped: BoolArray) -> IntArray:
        """Delete the slots that the mask `dropped` (size,) selects; all must be `untouched` (not
        visited recently, and not referred to). Return the new number of each slot, -1 for deleted
        ones.
        """
        return self.store.drop(dropped)

    def update_weather(self, reports: Reports) -> None:
        """Add weather reports. Each must take effect at `next_epoch` (the first minute that is not
        fused yet) or later; otherwise the map would depend on the time at which a report arrives.
        """
        columns = (
            np.concatenate([getattr(r, f.name) for r in (self.reports, reports)])
            for f in fields(Reports)
        )
        self.reports = Reports(*columns)
        # Beliefs are aged from the times of their last visits. Earlier weather has no effect.
        if self.checkpoint is not None:
            times = self.live.time[: self.size]
            oldest = int(times.min(initial=np.iinfo(np.int64).max, where=times > 0))
            self.reports = _drop_old_reports(self.reports, oldest)
        self._weather = weather_of(self.reports)

    def drop_weather(self, before: int) -> None:
        """Drop the weather reports whose validity ended before the time `before` [ns]. Beliefs of
        cells without a later visit must have become the prior.
        """
        self.reports = _drop_old_reports(self.reports, before)
        self._weather = weather_of(self.reports)

    def _vote_weights_at(self, epoch: int) -> VoteWeights:
        return next(
            found
            for found in reversed(self.vote_weights)
            if found.epoch <= epoch or found.epoch < 0
        )

    def _advance(self, epoch: int) -> None:
        """Advance the latest time T to `epoch`. If the lateness window (recent observations, whose
        order can still change) is not empty, advance by one epoch (minute) at a time. After each
        step, commit (make final) the observations that have become too old for the window.
        """
        if self._epoch is None:
            self._epoch = epoch
        while self._epoch < epoch:
            self._epoch = self._epoch + 1 if self.waiting else epoch
            before = self._epoch * constants.EPOCH_NS - self._lateness_ns
            store = self.store
            for due in store.due_windows(before):
                vehicles = VehicleRecords(store.peers, store.names)
                commit_windows(store.state, self._weather, vehicles, due, before)
            store.forget(before // NS)
            last = self.vote_weights[-1]
            joined = store.vehicles - len(last.weight)
            initial = initial_trust(enrolled=self.enrolled)
            weight = np.append(last.weight, np.full(joined, initial, np.float32))
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
        self, observations: Observations, rows: IntArray, arrivals: Arrivals, most_waiting: int
    ) -> tuple[IntArray, BoolArray]:
        """Add the votes of the selected observations to the lateness windows. Return the slots that
        changed, (k,), and a mask (n,) of the observations left out, because `most_waiting`
        observations of their vehicle already wait in the cell.
        """
        # Sort by time, so that no row of the batch makes the belief after another one stale.
        rows = rows[np.argsort(observations.time[rows], kind="stable")]
        at, keys = _place_votes(observations, rows)
        slots = self.store.slots_for(keys)
        self.store.reserve(len(slots))
        return slots, absorb_votes(
            self.store.state, self._weather, arrivals, Votes(at, slots, most_waiting)
        )


def _find_late(time: IntArray, checkpoint: int | None) -> tuple[BoolArray, IntArray]:
    """Return a mask of the observations older than the checkpoint, and the delay [ns] after which
    each of them is fused; 0 for one that is in time or too old to be fused. All arrays have the
    shape (n,).
    """
    late = np.zeros(len(time), np.bool_)
    late_by = np.zeros(len(time), np.int64)
    if checkpoint is not None:
        late = time < checkpoint
        rows = np.flatnonzero(late & (checkpoint - time <= LATE_MOST_NS))
        late_by[rows] = fused_at(time[rows], checkpoint) - time[rows]
    return late, late_by


def _make_arrivals(observations: Observations, vehicle: IntArray, late_by: IntArray) -> Arrivals:
    """Return the columns of n observations that the windows store; `late_by` (n,) is their delay
    [ns]. Weights are 0, and reports of an intervention (`limited`) are not marked as heeded or
    claimed yet.
    """
    n = len(observations.time)
    return Arrivals(
        time=observations.time,
        number=observations.vehicle,
        boot=observations.boot,
        sequence=observations.sequence,
        vehicle=vehicle,
        weight=np.zeros(n, np.float32),
        share=observations.share,
        evidence=observations.evidence,
        reported=observations.reported,
        used=(np.clip(observations.used, 0.0, 2.5) * USED).astype(np.uint8),
        shared=shared_parts(observations.reported),
        manoeuvre=observations.manoeuvre,
        late=(-(-late_by // LATE_NS)).astype(np.uint8),
        limited=np.where(observations.limited < 0, np.int8(UNLIMITED), np.int8(0)),
    )


def voted_keys(observations: Observations) -> IntArray:
    """Return the keys (cell · 4 + sector) of all cells and sectors that the observations affect, as
    one array. A key occurs once for each observation that affects it.
    """
    return _place_votes(observations, np.arange(len(observations.time)))[1]


def _place_votes(observations: Observations, rows: IntArray) -> tuple[IntArray, IntArray]:
    """Return the votes of the selected observations, which are sorted by time, in the same order. A
    vote is the effect of one observation on one cell and heading sector. The two arrays contain the
    row of the observation, and the key (cell · 4 + sector).

    An observation with a heading near the edge of its sector also affects the second sector.
    """
    key = observations.cell[rows] * grid.SECTORS
    keys = key + observations.sector[rows]
    second = np.flatnonzero(observations.second[rows] >= 0)
    if not len(second):
        return rows, keys
    whole = np.concatenate([rows, rows[second]])
    keys = np.concatenate([keys, key[second] + observations.second[rows[second]]])
    order = np.argsort(observations.time[whole], kind="stable")
    return whole[order], keys[order]


def _drop_old_reports(reports: Reports, oldest: int) -> Reports:
    """Return the weather reports without those whose validity ended before `oldest` [ns]."""
    return reports.take(reports.time >= oldest - 4 * 3600 * NS)
