"""Core of the service without its network. Its inputs are messages from vehicles. Its outputs are
alerts, map tiles, acknowledgements, and answers to queries.

The parts of the service share one state (`app.state`). One worker thread uses `intake`,
`settlement` and `alerts`. Other threads read the map with `queries`, or let the worker run a
function with `run_between_segments`.
"""

from __future__ import annotations

import threading
from collections.abc import Callable
from pathlib import Path
from typing import TypeVar

from fleet_service.app.intake import Intake
from fleet_service.app.precompile import warm_up
from fleet_service.app.queries import Queries
from fleet_service.app.settlement import Settlement
from fleet_service.app.standing_alerts import StandingAlerts
from fleet_service.app.state import ServiceState, SharedState, load_state
from fleet_service.archive.format.load import count_set_aside, set_aside
from fleet_service.archive.identity.vehicle_ids import remove_damaged_lines
from fleet_service.archive.segment_log import SegmentLog
from fleet_service.counts import ServiceCounts
from fleet_service.ingest.dedup import BatchId
from fleet_service.ingest.weather import weather_files
from fleet_service.replay import checkpoints
from fleet_service.replication.ownership import Ownership, open_exclusive
from schemas.config import ServiceConfig
from schemas.runtime.forked import ForkedWork, run_forked

T = TypeVar("T")


class Engine:
    """Parts of one service (without its network), with a state that is restored from its archive.

    Args:
        config: settings.
        root: folder of the archive; it is locked while the engine is open.
        holding: ownership of the archive, which the engine releases when it is closed; None to open
            the archive now, without a lease (ownership limited in time).

    Raises:
        InputError: another service has the archive.
        OSError: the archive cannot be read or written.

    Attributes:
        alerts: active alerts.
        copy: copy of the archive in a bucket (object store); None if there is no copy.
        counts: counts of all parts.
        holding: ownership of the archive.
        intake: admission and fusion of messages.
        queries: access to the map for readers.
        seen: latest time in a report that was in the archive at the start [ns].
        settlement: writing of segments (files of new rows), and acknowledgements.
    """

    def __init__(self, config: ServiceConfig, root: Path, holding: Ownership | None = None) -> None:
        self._config = config
        self._root = root
        # Take ownership before reading anything: this step fills an empty disk from the copy.
        self.holding = holding or open_exclusive(config, root)
        self.copy = self.holding.copy
        try:
            self._open()
        except BaseException:
            self.holding.close()
            raise

    def _open(self) -> None:
        """Load the state from the archive, and create the parts of the service."""
        config = self._config
        root = self._root
        self.counts = ServiceCounts()
        self.counts.witnesses_damaged += remove_damaged_lines(root / "keys")
        upload = None if self.copy is None else self.copy.upload_segments
        log: SegmentLog[BatchId] = SegmentLog(
            root, config.name, upload, self.holding.smallest_epoch
        )
        state = load_state(root, config, set_aside)
        self.counts.checkpoints_refused += state.refused
        self._shared = SharedState(state, config.public_vehicles)
        self.intake = Intake(config, root, self._shared, log, self.counts)
        self.settlement = Settlement(self._shared, self.intake, log, self.holding, self.counts)
        self.queries = Queries(config, root, self._shared)
        self.alerts = StandingAlerts(self._shared)
        self.seen = state.streams.newest
        self.counts.files_set_aside = count_set_aside(root)
        warm_up()

    @property
    def state(self) -> ServiceState:
        """Return the current state of the service: map, alerts, and record of the admitted batches
        (messages with records).
        """
        return self._shared.state

    def reload_state(self, before: Callable[[], None]) -> None:
        """Call the function `before`, which may change the archive. Then load the map, the alerts
        and the record of admitted batches from the archive again, and use them as the state. Use
        this only in a function that `run_between_segments` calls.

        Raises:
            OSError: the archive cannot be read; the state stays unchanged.
        """
        standing = self.alerts.all
        before()
        state = load_state(self._root, self._config, set_aside)
        with self._shared.guard:
            self._shared.replace(state)
            self.intake.reset()
            self.alerts.end_erased(standing)

    def drop_old(self) -> int:
        """Drop old cells whose belief has returned to the prior (the belief before any
        measurement); return the number of dropped cells. Use this only in a function that
        `run_between_segments` calls.
        """
        with self._shared.guard:
            return self.state.drop_old()

    def save_checkpoint(self, stop: threading.Event) -> bool:
        """Save a checkpoint (state of the service, for a fast restart). Return False if the event
        `stop` is set before it is complete.

        Another thread calls this. A child process with a copy of the memory writes the files, so
        that the service continues meanwhile. The worker (the thread that processes messages) starts
        it directly after a segment was written, when all rows in the state are on disk.

        Raises:
            OSError: the disk is full, no segment could be written for too long, or the operating
                system has no memory for the child process.
        """
        writing = self.settlement.run_between_segments(self._start_checkpoint, stop)
        if writing is None:
            return False
        try:
            writing.wait()
        except ChildProcessError:
            if stop.is_set():
                return False
            raise
        return True

    def _start_checkpoint(self) -> ForkedWork:
        known = weather_files(self._root)
        with self._shared.guard:
            return run_forked(
                lambda: checkpoints.save_checkpoint(
                    self._root, self.state.image(self.settlement.newest_segment, known)
                )
            )

    def mark_survived(self) -> None:
        """Record that the service has run well for a while after starting from its checkpoint, so
        that the next start may use it too.
        """
        checkpoints.mark_survived(self._root)

    def close(self, *, has_failed: bool = False) -> None:
        """Stop all parts of the service and release the archive. `has_failed` is True if an error
        ended the service; the checkpoint from which it started may be the cause.
        """
        self.queries.close()
        if not has_failed:
            self.mark_survived()
        self.settlement.close()
        self.holding.close()
