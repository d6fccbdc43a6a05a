"""Metrics of the fleet services, which the page shows in its health view. They are read over HTTP,
because services do not publish their metrics over Zenoh.
"""

from __future__ import annotations

import re
import threading
import time
import urllib.request
from http.client import HTTPException
from typing import Any, Final

from schemas.runtime.metrics import PREFIX

READ_S: Final = 2.0
# [s] Time for which an answer is reused, so that many browsers cause only one request.
KEPT_S: Final = 2.0
MOST_BYTES: Final = 1 << 20
_LINE: Final = re.compile(rf'{PREFIX}(\w+?)(_total)?(?:\{{\w+="([^"]*)"\}})? (\S+)')


class ServiceHealth:
    """Metrics of fleet services, by address.

    Args:
        addresses: addresses such as http://127.0.0.1:9464.
    """

    def __init__(self, addresses: list[str]) -> None:
        self._addresses = addresses
        self._lock = threading.Lock()
        self._answers: list[dict[str, Any]] = []
        self._queried_at = 0.0
        self._before: dict[str, tuple[float, float]] = {}

    def services(self) -> list[dict[str, Any]]:
        """Return one entry per fleet service: `address`, `answers` (True if the service answered),
        and the values of its metrics.
        """
        with self._lock:
            if time.monotonic() - self._queried_at >= KEPT_S:
                self._answers = [self._ask(address) for address in self._addresses]
                self._queried_at = time.monotonic()
            return self._answers

    def _ask(self, address: str) -> dict[str, Any]:
        place = f"{address.rstrip('/').removesuffix('/metrics')}/metrics"
        try:
            with urllib.request.urlopen(place, timeout=READ_S) as answer:
                text = answer.read(MOST_BYTES).decode("utf-8", "replace")
        except (OSError, ValueError, HTTPException):
            return {"address": address, "answers": False}
        found = parse_metrics(text)
        rows = found.get("rows", {}).get("observation", 0.0)
        now = time.monotonic()
        before = self._before.get(address)
        self._before[address] = (now, rows)
        rate = (
            None
            if before is None or now <= before[0]
            else max(rows - before[1], 0.0) / (now - before[0])
        )
        single = {
            name: found.get(name, {}).get("")
            for name in (
                "report_lag_seconds",
                "cells",
                "alerts",
                "queue_messages",
                "clock_lag_seconds",
            )
        }
        return {
            "address": address,
            "answers": True,
            "observations": rows,
            "per_second": rate,
            "refused": found.get("refused_messages", {}),
            "failures": found.get("failures", {}),
            **single,
        }


def parse_metrics(text: str) -> dict[str, dict[str, float]]:
    """Parse an OpenMetrics text; return, for each metric, its values by label. The label of a value
    without a label is "".
    """
    found: dict[str, dict[str, float]] = {}
    for line in text.splitlines():
        match = _LINE.fullmatch(line)
        if match:
            found.setdefault(match[1], {})[match[3] or ""] = float(match[4])
    return found
