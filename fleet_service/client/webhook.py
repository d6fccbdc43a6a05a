"""Webhook for alerts of road stretches, in the format of Alertmanager's webhook receivers (version
4).

Paging services, chat bridges and scripts accept this format. Delivery is at least once and in
order. A message is removed from the queue only after a 2xx answer within TIMEOUT_S. Redirects are
not followed, because a POST would become an empty GET. Messages that cannot be delivered are
counted and reported.
"""

from __future__ import annotations

import asyncio
import hashlib
import json
import os
import sqlite3
import threading
from collections import Counter
from collections.abc import Callable
from enum import Enum, auto
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final
from urllib.parse import urlsplit

from fleet_service.client.alert_queue import AlertQueue
from fleet_service.client.stretches import StretchAlert, format_time
from schemas.errors import InputError
from schemas.runtime.installing import install_command
from schemas.runtime.metrics import Metric, counter, gauge
from schemas.thresholds import SLIPPERY_MU

if TYPE_CHECKING:
    import httpx

# [s] Time limit of a whole request, so that a slow receiver does not block the queue.
TIMEOUT_S: Final = 5.0
FIRST_WAIT_S = 0.5
LONGEST_WAIT_S = 60.0
# With these answers a receiver refuses a message for ever. Repeating it would block the queue.
REFUSALS: Final = frozenset({400, 413, 415, 422})
LOSSES: Final = ("dropped", "refused", "unstored")
_OPEN: Final = "0001-01-01T00:00:00Z"  # end time of an active alert in Alertmanager


def alert_message(alert: StretchAlert) -> dict[str, Any]:
    """Return the alert of a road stretch as a webhook message in Alertmanager's format."""
    status = "resolved" if alert.state == "cleared" else "firing"
    labels = {
        "alertname": "SlipperyRoad",
        "id": alert.id,
        "direction": alert.direction,
        "headings": ",".join(alert.headings),
        "severity": "critical" if alert.mu < SLIPPERY_MU / 2 else "warning",
    }
    notes = {
        "summary": f"slippery road: {alert.length_m:.0f} m {alert.direction}, mu {alert.mu:.2f}",
        "description": alert.to_line(),
        "place": f"{alert.latitude:.6f},{alert.longitude:.6f}",
    }
    one = {
        "status": status,
        "labels": labels,
        "annotations": notes,
        "startsAt": format_time(alert.since),
        "endsAt": format_time(alert.time) if status == "resolved" else _OPEN,
        "generatorURL": f"geo:{alert.latitude:.6f},{alert.longitude:.6f}",
        "fingerprint": alert.id,
    }
    return {
        "version": "4",
        "groupKey": f'{{}}:{{id="{alert.id}"}}',
        "truncatedAlerts": 0,
        "status": status,
        "receiver": "gripmap",
        "groupLabels": {"id": alert.id},
        "commonLabels": labels,
        "commonAnnotations": notes,
        "externalURL": "",
        "alerts": [one],
    }


def queue_path(url: str) -> Path:
    """Return the default path of the queue file for a receiver's URL."""
    state = Path(os.environ.get("XDG_STATE_HOME") or Path.home() / ".local" / "state")
    return state / "gripmap" / f"webhook-{hashlib.sha256(url.encode()).hexdigest()[:16]}.sqlite"


class Attempt(Enum):
    """Result of an attempt to send the oldest message of the queue."""

    QUEUE_EMPTY = auto()
    ANSWERED = auto()  # the receiver accepted the message, or refused it for good
    FAILED = auto()


class Webhook:
    """Sender of alerts with its own thread; `close` tries once more to send waiting alerts.

    Args:
        url: URL of the receiver, http or https.
        say: called with a line of text when the receiver becomes unreachable or reachable, and for
            every lost message.
        queue: queue of waiting messages; messages of an earlier process are sent first.
        timeout_s: time limit of a whole request [s].

    Raises:
        InputError: the URL is not valid, or the package for HTTP is missing.
    """

    def __init__(
        self,
        url: str,
        log_line: Callable[[str], None],
        queue: AlertQueue,
        timeout_s: float = TIMEOUT_S,
    ) -> None:
        check_url(url)
        self._url = url
        self._log_line = log_line
        self._queue = queue
        self._timeout_s = timeout_s
        # Log only scheme and host, because the path may contain a secret.
        self._name = f"{urlsplit(url).scheme}://{urlsplit(url).hostname}"
        self.counts: Counter[str] = Counter()
        self._failure = ""
        self._undelivered = 0
        self._is_closed = False
        self._wake = threading.Event()
        self._stop = threading.Event()
        self._wake.set()
        self._thread = threading.Thread(target=self._send_until_closed, name="webhook", daemon=True)
        self._thread.start()

    @property
    def lost_count(self) -> int:
        """Return the number of alerts that were lost, because they can no longer be delivered to
        the receiver.
        """
        return sum(self.counts[name] for name in LOSSES)

    @property
    def waiting_count(self) -> int:
        """Return the number of alerts in the queue; after `close`, the number that remained
        undelivered.
        """
        return self._undelivered if self._is_closed else len(self._queue)

    def health_problems(self) -> list[str]:
        """Return one message per problem of the webhook; empty if no alert is lost and the receiver
        can be reached.
        """
        out = (
            [f"webhook: {self._failure}; {self.waiting_count} alerts wait"] if self._failure else []
        )
        return [*out, f"webhook: {self.lost_count} alerts were lost"] if self.lost_count else out

    def metrics(self) -> list[Metric]:
        """Return the webhook's counters of alerts and the length of its queue, as metrics."""
        alerts = {name: float(self.counts[name]) for name in ("delivered", *LOSSES)}
        return [
            Metric("webhook_alerts", "counter", "Alerts by outcome", alerts, "outcome"),
            counter("webhook_failures", "Failed deliveries", float(self.counts["failures"])),
            gauge("webhook_waiting", "Alerts in the queue", float(self.waiting_count)),
        ]

    def send(self, alert: StretchAlert) -> None:
        """Add an alert to the queue of messages that are sent to the webhook's receiver."""
        try:
            dropped = self._queue.append(json.dumps(alert_message(alert)))
        except sqlite3.Error as error:
            self._count_loss("unstored", 1, f"the queue cannot be written ({error})")
            return
        if dropped:
            self._count_loss("dropped", dropped, "the queue is full")
        self._wake.set()

    def close(self) -> None:
        """Try once to send the waiting alerts, and stop; undelivered alerts stay in the queue
        file.
        """
        self._stop.set()
        self._wake.set()
        self._thread.join(2 * self._timeout_s)
        self._undelivered = len(self._queue)
        self._is_closed = True
        if self._undelivered:
            self._log_line(
                f"webhook: {self._undelivered} alerts remain in the queue for the next watch"
            )
        if self.lost_count:
            self._log_line(f"webhook: {self.lost_count} alerts were lost")
        if not self._thread.is_alive():
            self._queue.close()

    def _count_loss(self, kind: str, number: int, reason: str) -> None:
        self.counts[kind] += number
        self._log_line(f"webhook: {number} alerts lost, {reason}")

    def _send_until_closed(self) -> None:
        import httpx

        with asyncio.Runner() as runner:
            client = httpx.AsyncClient(follow_redirects=False, timeout=self._timeout_s)
            while True:
                self._wake.wait()
                self._wake.clear()
                self._send_queue(runner, client)
                if self._stop.is_set():
                    break
            runner.run(client.aclose())

    def _send_queue(self, runner: asyncio.Runner, client: httpx.AsyncClient) -> None:
        """Send the alert messages of the queue, oldest first, until the queue is empty. After a
        failure, wait and try again, unless the webhook is being closed.
        """
        wait = FIRST_WAIT_S
        while (attempt := self._send_first(runner, client)) is not Attempt.QUEUE_EMPTY:
            if attempt is Attempt.ANSWERED:
                wait = FIRST_WAIT_S
                continue
            if self._stop.is_set():
                return
            self._stop.wait(wait)
            wait = min(2 * wait, LONGEST_WAIT_S)

    def _send_first(self, runner: asyncio.Runner, client: httpx.AsyncClient) -> Attempt:
        """Send the oldest alert message of the queue to the webhook's receiver."""
        try:
            first = self._queue.read_first()
            if first is None:
                return Attempt.QUEUE_EMPTY
            number, text = first
            status = runner.run(self._post_message(client, text))
            failure = _failure_of(status)
            if failure is None:
                self._record_answer(number, status)
                return Attempt.ANSWERED
        # Any error may occur, and the thread must continue.
        except Exception as error:  # noqa: BLE001
            failure = f"{type(error).__name__} {error}".strip()
        self.counts["failures"] += 1
        if not self._failure:
            self._log_line(f"webhook: {self._name} does not accept alerts ({failure}); they wait")
        self._failure = failure
        return Attempt.FAILED

    def _record_answer(self, number: int, status: int) -> None:
        is_delivered = 200 <= status < 300
        self._queue.remove(number)
        if is_delivered:
            self.counts["delivered"] += 1
        else:
            self._count_loss("refused", 1, f"{self._name} answered {status}")
        if self._failure:
            self._log_line("webhook: the receiver answers again")
            self._failure = ""

    async def _post_message(self, client: httpx.AsyncClient, text: str) -> int:
        """Send an alert message to the webhook's receiver, and return the HTTP status of the
        answer; the body of the answer is not read.
        """
        async with asyncio.timeout(self._timeout_s):
            headers = {"Content-Type": "application/json"}
            async with client.stream(
                "POST", self._url, content=text.encode(), headers=headers
            ) as answer:
                return answer.status_code


def check_url(url: str) -> None:
    """Raise InputError if the URL of a webhook's receiver is not valid, or if the package for HTTP
    is missing.
    """
    try:
        parts = urlsplit(url)
        is_valid = (
            parts.scheme in ("http", "https") and bool(parts.hostname) and (parts.port or 1) > 0
        )
    except ValueError:
        is_valid = False
    if not is_valid:
        raise InputError(
            "webhook", f"{url!r} is not a URL", "give http://HOST/PATH or https://HOST/PATH"
        )
    try:
        import httpx  # noqa: F401
    except ImportError as error:
        raise InputError(
            "webhook", "the package httpx is missing", install_command("webhook")
        ) from error


def _failure_of(status: int) -> str | None:
    """Return the reason, from an HTTP status, why a message must be sent again; None if the status
    means that it was delivered or refused for good.
    """
    if 200 <= status < 300 or status in REFUSALS:
        return None
    if 300 <= status < 400:
        return f"it redirects with {status}; give the URL of the receiver itself"
    return f"it answers {status}"
