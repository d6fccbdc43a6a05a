"""Core of the service without its network: messages in; alerts, tiles, acknowledgements and answers
out.

The parts share one state (`app.state`). One worker uses `intake`, `settlement` and `alerts`. Other
threads use `queries` and `run_between_segments`.
"""

from __future__ import annotations

import threading
from collections import Counter
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
from fleet_service.ingest.dedup import BatchId
from fleet_service.ingest.weather import weather_files as weather_files
from fleet_service.replay import checkpoints
from fleet_service.replay.checkpoints import Taken
from fleet_service.replication.ownership import Ownership, open_exclusive
from schemas.config import ServiceConfig

T = TypeVar("T")


class Engine:
    """Parts of one service, with a state rebuilt from its archive.

    Args:
        config: settings.
        root: of the archive; it is locked while the engine is open.
        holding: ownership of the archive, closed with the engine; None to open the archive now,
            without a lease.

    Raises:
        InputError: another service holds the archive.
        OSError: the archive cannot be read or written.

    Attributes:
        alerts: standing alerts.
        copy: bucket copy of the archive; None without one.
        counts: counters of all parts.
        holding: ownership of the archive.
        intake: admission and fusion of messages.
        queries: readers of the map.
        seen: latest time in a report that the archive held at the start [ns].
        settlement: segments and acknowledgements.
    """

    def __init__(self, config: ServiceConfig, root: Path, holding: Ownership | None = None) -> None:
        self._config = config
        self._root = root
        # Ownership comes before anything is read, because it fills an empty disk from the copy.
        self.holding = holding or open_exclusive(config, root)
        self.copy = self.holding.copy
        try:
            self._open()
        except BaseException:
            self.holding.close()
            raise

    def _open(self) -> None:
        """Load the state from the archive and create the parts."""
        config = self._config
        root = self._root
        self.counts: Counter[str] = Counter()
        self.counts["witnesses_damaged"] += remove_damaged_lines(root / "keys")
        upload = None if self.copy is None else self.copy.upload_segments
        log: SegmentLog[BatchId] = SegmentLog(
            root, config.name, upload, self.holding.smallest_epoch
        )
        state = load_state(root, config, set_aside)
        self.counts["checkpoints_refused"] += state.refused
        self._shared = SharedState(state, config.public_vehicles)
        self.intake = Intake(config, root, self._shared, log, self.counts)
        self.settlement = Settlement(self._shared, self.intake, log, self.holding, self.counts)
        self.queries = Queries(config, root, self._shared)
        self.alerts = StandingAlerts(self._shared)
        self.seen = state.streams.newest
        self.counts["files_set_aside"] = count_set_aside(root)
        warm_up()

    @property
    def state(self) -> ServiceState:
        """Return the current state."""
        return self._shared.state

    def reload_state(self, before: Callable[[], None]) -> None:
        """Call `before`, then replace the state by that of the archive; call it in
        `run_between_segments`.

        Raises:
            OSError: the archive cannot be read; the state stays.
        """
        standing = self.alerts.all
        before()
        state = load_state(self._root, self._config, set_aside)
        with self._shared.guard:
            self._shared.adopt(state)
            self.intake.reset()
            self.alerts.end_erased(standing)

    def drop_old(self) -> int:
        """Drop old cells that are back at the prior; return their number. Call it in
        `run_between_segments`.
        """
        with self._shared.guard:
            return self.state.drop_old()

    def checkpoint(self, stop: threading.Event) -> Taken | None:
        """Return the state and the last segment it includes; None if stopped meanwhile.

        The worker copies the state right after a segment, when every row in it is on disk. Another
        thread calls this.
        """
        return self.settlement.run_between_segments(self._image, stop)

    def _image(self) -> Taken:
        with self._shared.guard:
            return self.state.image(self.settlement.newest_segment, weather_files(self._root))

    def mark_survived(self) -> None:
        """Record that the service has run for a while with the checkpoint it began from."""
        checkpoints.mark_survived(self._root)

    def close(self) -> None:
        """Close all parts and release the archive."""
        self.queries.close()
        self.mark_survived()
        self.settlement.close()
        self.holding.close()
