"""Status line that a service writes to its log every few seconds."""

from __future__ import annotations

import logging
import time
from typing import Final

from fleet_service.app.clock import SteadyClock
from fleet_service.app.engine import Engine
from fleet_service.ingest.inbox import Inbox
from schemas.runtime.logs import json_values
from schemas.wire import Kind

STATUS_S: Final = 5.0
LAG_S: Final = 1.0  # [s] least difference of the system clock that the status line mentions


class StatusLine:
    """Status of a service as a line of text: observations, cells, alerts, queue and clock."""

    def __init__(
        self, engine: Engine, inbox: Inbox, clock: SteadyClock, events: logging.Logger
    ) -> None:
        self._engine = engine
        self._inbox = inbox
        self._clock = clock
        self._events = events
        self._reported_at = time.monotonic()
        self._reported = 0

    def is_due(self, now: float) -> bool:
        """Return True if the last status line is at least STATUS_S [s] old; `now` is the monotonic
        time [s].
        """
        return now - self._reported_at >= STATUS_S

    def write_line(self, now: float) -> None:
        """Write the service's status line to the log; `now` is the monotonic time [s]."""
        counts = self._engine.counts
        rate = (counts.observations - self._reported) / max(now - self._reported_at, 1e-9)
        self._reported_at = now
        self._reported = counts.observations
        behind = self._clock.lag() * 1e-9
        failing = self._engine.settlement.failing
        rest = ", ".join(
            f"{name} {n}"
            for name, n in sorted(counts.as_dict().items())
            if n and name not in set(Kind) and not name.endswith("_runs")
        )
        text = (
            f"status: {counts.observations} observations ({rate:.0f}/s), {counts.states} states, "
            f"{self._engine.state.fusion.size} cells, {self._engine.alerts.count} alerts, queue "
            f"{len(self._inbox)}"
            + (f"; {rest}" if rest else "")
            + (f"; nothing is acknowledged: {failing}" if failing else "")
            + (f"; the system clock is {behind:.0f} s behind" if behind >= LAG_S else "")
            + (
                f"; the system clock jumped {-behind:.0f} s ahead, and no report confirms this"
                if behind <= -LAG_S
                else ""
            )
        )
        cells = self._engine.state.fusion.size
        self._events.info(
            text, extra=json_values(cells=cells, queue=len(self._inbox), counts=counts.as_dict())
        )
