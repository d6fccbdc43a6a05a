"""Intake of a running service: it takes messages and weather, passes fused rows to the segment log
(queue of rows for the disk), and returns alerts.
"""

from __future__ import annotations

import time
from collections.abc import Sequence
from contextlib import nullcontext
from itertools import compress
from pathlib import Path

import numpy as np

from fleet_service.app.clock import TimeNow
from fleet_service.app.state import SharedState
from fleet_service.archive.format.segments import Rows
from fleet_service.archive.identity.pseudonyms import Pseudonyms
from fleet_service.archive.segment_log import SegmentLog
from fleet_service.counts import ServiceCounts
from fleet_service.fusion import observations_of
from fleet_service.fusion.vote_weights import UNCORRECTED
from fleet_service.fusion.weather import Reports
from fleet_service.ingest.acks import Acks
from fleet_service.ingest.budgets import NewCells
from fleet_service.ingest.dedup import BatchId
from fleet_service.ingest.inbox import AcceptedBatches, BatchIntake, Message
from fleet_service.ingest.paths import VehiclePaths
from fleet_service.ingest.validation import Clock
from fleet_service.ingest.weather import WeatherInbox
from schemas.config import ServiceConfig
from schemas.numeric import BoolArray
from schemas.thresholds import NS
from schemas.wire import Alert, Kind


class Intake:
    """Admission and fusion of messages; used by the worker (the thread that processes messages).

    Args:
        config: settings.
        root: folder of the archive.
        shared: state of the service.
        log: segment log (queue of rows for the disk), which writes the admitted rows to disk.
        counts: counts of the service.

    Attributes:
        acks: acknowledgements to send.
        batches: admission of batches (messages with records); `reset` replaces it.
        now: time of the last `ingest` [ns].
        report_lag_s: shortest time [s], among the rows of the last `ingest`, from the end of a
            visit (a vehicle's passage through a cell) to the arrival of its report.
        weather: queue of weather messages.
    """

    def __init__(
        self,
        config: ServiceConfig,
        root: Path,
        shared: SharedState,
        log: SegmentLog[BatchId],
        counts: ServiceCounts,
    ) -> None:
        self._config = config
        self._root = root
        self._shared = shared
        self._log = log
        self._counts = counts
        self.acks = Acks()
        self.now = 0
        self.report_lag_s = 0.0
        self.weather = WeatherInbox(root, config.name, shared.state.fusion, counts)
        self.reset()
        if config.weather is not None:
            self._apply_weather(self.weather.begin(config.weather, time.time_ns()))

    def reset(self) -> None:
        """Continue the intake with a newly loaded state of the service. The recorded paths of
        vehicles and their limits on new cells belong to the old state and are discarded.
        """
        self._paths = VehiclePaths()
        self._places = NewCells()
        keys = Pseudonyms(self._root / "keys")
        self.batches = BatchIntake(
            self._shared.state.streams, keys, self._counts, self.acks, self._config.publishers
        )
        self.weather.fusion = self._shared.state.fusion

    def ingest(self, messages: Sequence[Message], at: int | TimeNow) -> list[Alert]:
        """Check messages, and update the map with the admitted messages; return the alerts that are
        raised or cleared. `at` is the service's time with its bounds; a plain number [ns] means a
        time without uncertainty.
        """
        at = at if isinstance(at, TimeNow) else TimeNow(at)
        ahead = int(self._config.clock_ahead_s * NS) + at.slack
        clock = Clock(at.now, ahead, int(self._config.oldest_s * NS), at.doubt, at.earliest)
        self.now = clock.now
        out: list[Alert] = []
        for kind, accepted in self.batches.accept(messages, clock).items():
            if kind is Kind.OBSERVATION:
                out += self._fuse(accepted)
            self._counts.rows[kind] += len(accepted.rows["row"])
            self._log.add(kind, accepted.rows, accepted.batches)
        return out

    @property
    def times(self) -> dict[str, int]:
        """Return, by vehicle, the newest time [ns] that it reported in the last `ingest`."""
        return self.batches.times

    def _fuse(self, accepted: AcceptedBatches) -> list[Alert]:
        rows = accepted.rows
        state = self._shared.state
        self.report_lag_s = float((rows["received_at"] - rows["leave_time"]).min()) * 1e-9
        with self._shared.guard:
            fused = np.flatnonzero(~self._excluded_from_fusion(rows))
            taken = observations_of(rows, rows["witness"]).take(fused)
            with nullcontext() if state.public is None else state.public.follow(taken):
                updated = state.fusion.update(taken)
            state.map.mark_changed(updated.slots)
            raised = state.alerts.update(updated.slots)
            if raised:
                self._shared.tiles.acknowledge()
        n = len(rows["row"])
        rows["late"] = np.ones(n, bool)
        rows["late_by"] = np.zeros(n, np.int64)
        rows["weight"] = np.zeros(n, np.float32)
        rows["late"][fused] = updated.late
        rows["late_by"][fused] = updated.late_by
        rows["weight"][fused] = updated.weight
        rows |= {name: np.full(n, value, np.float32) for name, value in UNCORRECTED.items()}
        self._counts.late += int(updated.late.sum())
        if updated.late.any():
            missed = np.zeros(n, bool)
            missed[fused] = updated.late
            of_batch = np.logical_or.reduceat(missed, np.flatnonzero(rows["row"] == 0))
            self.acks.record_late(compress(accepted.batches, of_batch.tolist()))
        return raised

    def _excluded_from_fusion(self, rows: Rows) -> BoolArray:
        """Return a mask of rows, True for rows that are archived but do not reach the map. The
        reason is that the vehicle cannot have reached the reported position, or that it reports too
        many new cells. Enrolled publishers (data sources that are no vehicles) have no path and are
        not checked.
        """
        witness = rows["witness"]
        beyond = np.zeros(len(witness), bool)
        publishers = [self.batches.witness_of(name) for name in self._config.publishers]
        vehicles = np.flatnonzero(~np.isin(witness, publishers))
        beyond[vehicles] = self._paths.find_implausible(
            witness[vehicles],
            *(rows[name][vehicles] for name in ("leave_time", "latitude", "longitude")),
        )
        self._counts.implausible_moves += int(beyond.sum())
        slots = self._shared.state.fusion.slots_of(rows["cell"], rows["sector"].astype(np.int64))
        new = vehicles[(slots < 0)[vehicles] & ~beyond[vehicles]]
        over = self._places.find_excess(
            witness[new], rows["cell"][new], float(rows["received_at"][0]) / NS
        )
        beyond[new[over]] = True
        self._counts.too_many_places += int(over.sum())
        return beyond

    def update_weather(self, now: int) -> None:
        """Archive the weather reports that arrived since the last call, and apply them to the
        fusion (the beliefs about the friction of all cells).
        """
        self._apply_weather(self.weather.take(now))

    def _apply_weather(self, reports: Reports | None) -> None:
        if reports is not None:
            with self._shared.guard:
                self._shared.state.fusion.update_weather(reports)
            self._counts.weather += len(reports.time)
