"""The handbook's table of metrics, made from what a service and an agent show: `python -m tests.usability.gauges`."""

from __future__ import annotations

import tempfile
from pathlib import Path
from types import SimpleNamespace
from typing import Any, Final, TypeAlias

from edge_agent.app import metrics as agent_metrics
from fleet_service.app import metrics as service_metrics
from fleet_service.app.engine import Engine
from schemas.config import ServiceConfig
from schemas.runtime.metrics import PREFIX, Metric
from tests.house import ROOT

PAGE: Final = ROOT / "deploy" / "docs" / "operations.md"
_ROW: Final = f"| `{PREFIX}"
Shown: TypeAlias = dict[str, list[Metric]]


def shown(root: Path) -> Shown:
    """All metrics of a service with a new archive, and of an agent."""
    config = ServiceConfig()
    engine = Engine(config, root)
    try:
        pulse = service_metrics.Pulse(turn_age_s=0.0, queued=0, routers=1, clock_lag_s=0.0)
        of_service = service_metrics.metrics(engine, pulse, config, root)
    finally:
        engine.close()
    counts: Any = SimpleNamespace(
        published={}, acknowledged={}, rejected={}, late={}, resent_batches=0, bad_acks=0, failures=0
    )
    publisher: Any = SimpleNamespace(
        unanswered=0, clock_behind_s=0.0, counts=counts, dropped=0, damage=(0, 0), stranded=0, unanswered_s=0.0,
        fill=0.0, links=1, unsettled=lambda: 0,
    )  # fmt: skip
    progress: Any = SimpleNamespace(behind=0, now_s=0.0, lag_s=0.0)
    return {"service": of_service, "agent": agent_metrics.metrics(publisher, progress)}


def stored(metric: Metric) -> str:
    """Its name in Prometheus."""
    return f"{PREFIX}{metric.name}{'_total' if metric.kind == 'counter' else ''}"


def lines(found: Shown) -> list[str]:
    """The rows of the table."""
    return [
        f"| `{stored(metric)}` | {half} | {metric.kind + (metric.label and ', by ' + metric.label)} | {metric.help} |"
        for half, metrics in found.items()
        for metric in metrics
    ]


def rows(text: str) -> list[str]:
    """The rows that a page has."""
    return [line for line in text.splitlines() if line.startswith(_ROW)]


def main() -> None:
    """Write the table anew."""
    text = PAGE.read_text(encoding="utf-8")
    first, *others = rows(text)
    for row in others:
        text = text.replace(row + "\n", "")
    with tempfile.TemporaryDirectory() as folder:
        PAGE.write_text(text.replace(first, "\n".join(lines(shown(Path(folder))))), encoding="utf-8")


if __name__ == "__main__":
    main()
