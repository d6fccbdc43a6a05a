"""Local copy ("mirror") of the live alerts by stretch of road. This module does not use the
network.
"""

from __future__ import annotations

import threading
from collections.abc import Callable, Iterable
from typing import Any

from fleet_service.client.stretches import StretchAlert, Stretches
from schemas.wire import Alert


class AlertMirror:
    """Local copy of the active alerts, as stretches of road; thread-safe."""

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._stretches = Stretches()
        self._changed = False
        self.received_count = 0  # number of received messages about alerts
        self.last_received = 0.0  # arrival time of the last message [s since 1970]

    def take_alert(self, alert: Alert, now: float) -> None:
        """Apply a received alert to the local copy: the alert of a cell was raised, repeated or
        cleared.
        """
        with self._lock:
            self.last_received = now
            self.received_count += 1
            self._stretches.apply_alert(alert)

    def take_standing(
        self, standing: Iterable[Alert], served: Callable[[int], bool], now: float
    ) -> None:
        """Replace the active alerts with the alerts in `standing`. `served` is a function that
        returns True if a service answers for a cell; alerts of cells without a service are kept.
        """
        with self._lock:
            self.last_received = now
            self.received_count += 1
            self._stretches.replace_alerts(standing, lambda alert: served(alert.cell))

    def take_change(self) -> bool:
        """Return True if the stretches of road with an alert have changed since the last call."""
        with self._lock:
            found = bool(self._stretches.take_changes()) or self._changed
            self._changed = False
            return found

    def stretches(self) -> list[StretchAlert]:
        """Return the stretches of road with an active alert, according to all messages received
        until now.
        """
        with self._lock:
            self._changed |= bool(self._stretches.take_changes())
            return self._stretches.standing

    def as_json(self) -> list[dict[str, Any]]:
        """Return the stretches of road with an active alert in a form for JSON, newest first."""
        with self._lock:
            return [
                one.to_json_values()
                for one in sorted(self._stretches.standing, key=lambda one: -one.since)
            ]
