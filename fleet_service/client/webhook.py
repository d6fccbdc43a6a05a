"""Webhook for alerts of stretches, in the format of Alertmanager's webhook receivers (version 4).

Every receiver of Alertmanager webhooks accepts them: paging services, chat bridges, scripts. If the receiver is away,
delivery is repeated at growing intervals. Missed alerts are sent in order, up to MOST_WAITING.
"""

from __future__ import annotations

import json
import threading
import urllib.error
import urllib.request
from collections import deque
from collections.abc import Callable
from typing import Any, Final
from urllib.parse import urlsplit

from fleet_service.client.stretches import StretchAlert, iso
from schemas.errors import InputError
from schemas.thresholds import SLIPPERY_MU

MOST_WAITING: Final = 1000
TIMEOUT_S: Final = 5.0
FIRST_WAIT_S, LONGEST_WAIT_S = 0.5, 60.0
_OPEN: Final = "0001-01-01T00:00:00Z"  # Alertmanager's end of what has not ended


def body(alert: StretchAlert) -> dict[str, Any]:
    """Return one alert as a webhook message."""
    status = "resolved" if alert.state == "cleared" else "firing"
    labels = {
        "alertname": "SlipperyRoad", "id": alert.id, "direction": alert.direction, "headings": ",".join(alert.headings),
        "severity": "critical" if alert.mu < SLIPPERY_MU / 2 else "warning",
    }  # fmt: skip
    notes = {
        "summary": f"slippery road: {alert.length_m:.0f} m {alert.direction}, mu {alert.mu:.2f}",
        "description": alert.line(),
        "place": f"{alert.latitude:.6f},{alert.longitude:.6f}",
    }
    one = {
        "status": status, "labels": labels, "annotations": notes, "startsAt": iso(alert.since),
        "endsAt": iso(alert.time) if status == "resolved" else _OPEN,
        "generatorURL": f"geo:{alert.latitude:.6f},{alert.longitude:.6f}", "fingerprint": alert.id,
    }  # fmt: skip
    return {
        "version": "4", "groupKey": f'{{}}:{{id="{alert.id}"}}', "truncatedAlerts": 0, "status": status,
        "receiver": "gripmap", "groupLabels": {"id": alert.id}, "commonLabels": labels, "commonAnnotations": notes,
        "externalURL": "", "alerts": [one],
    }  # fmt: skip


class Webhook:
    """Sender of alerts with a thread of its own; `close` sends the rest once.

    Args:
        url: of the receiver, http or https.
        say: called with a line when the receiver goes away or returns.

    Raises:
        InputError: the URL is not valid.
    """

    def __init__(self, url: str, say: Callable[[str], None]) -> None:
        if urlsplit(url).scheme not in ("http", "https") or not urlsplit(url).netloc:
            raise InputError("webhook", f"{url!r} is no URL", "give http://HOST/PATH or https://HOST/PATH")
        self._url, self._say = url, say
        self._waiting: deque[StretchAlert] = deque(maxlen=MOST_WAITING)
        self._more, self._stop = threading.Event(), threading.Event()
        self._thread = threading.Thread(target=self._run, daemon=True)
        self._thread.start()

    def send(self, alert: StretchAlert) -> None:
        """Queue an alert."""
        self._waiting.append(alert)
        self._more.set()

    def close(self) -> None:
        """Try to send the rest once, and stop."""
        self._stop.set()
        self._more.set()
        self._thread.join(2 * TIMEOUT_S)

    def _run(self) -> None:
        wait = FIRST_WAIT_S
        while True:
            self._more.wait()
            self._more.clear()
            while self._waiting:
                alert = self._waiting[0]
                if self._posted(alert):
                    if wait > FIRST_WAIT_S:
                        self._say("webhook: the receiver answers again")
                    wait = FIRST_WAIT_S
                    if self._waiting and self._waiting[0] is alert:
                        self._waiting.popleft()
                elif self._stop.is_set():
                    self._say(f"webhook: {len(self._waiting)} alerts were not delivered")
                    return
                else:
                    if wait == FIRST_WAIT_S:
                        self._say(f"webhook: {self._url} does not take alerts; they wait")
                    self._stop.wait(wait)
                    wait = min(2 * wait, LONGEST_WAIT_S)
            if self._stop.is_set():
                return

    def _posted(self, alert: StretchAlert) -> bool:
        request = urllib.request.Request(
            self._url, json.dumps(body(alert)).encode(), {"Content-Type": "application/json"}, method="POST"
        )
        try:
            with urllib.request.urlopen(request, timeout=TIMEOUT_S) as reply:
                return 200 <= int(reply.status) < 300
        except (urllib.error.URLError, OSError):
            return False
