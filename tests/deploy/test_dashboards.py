"""The board and the rules ask for metrics that a service or an agent really shows, and the handbook knows each rule."""

from __future__ import annotations

import json
import re
import shutil
import subprocess
from types import SimpleNamespace
from typing import Any

import pytest
import yaml

from edge_agent.app import metrics as agent_metrics
from fleet_service.app import metrics as service_metrics
from fleet_service.app.engine import Engine
from schemas.config import ServiceConfig
from tests.house import ROOT

FOLDER = ROOT / "deploy" / "dashboards"
RULES: list[dict[str, Any]] = [
    rule for group in yaml.safe_load((FOLDER / "gripmap.rules.yml").read_text())["groups"] for rule in group["rules"]
]
EXPRESSIONS = [rule["expr"] for rule in RULES] + [
    target["expr"]
    for panel in json.loads((FOLDER / "gripmap.json").read_text())["panels"]
    for target in panel["targets"]
]


@pytest.fixture(scope="module")
def shown(tmp_path_factory: pytest.TempPathFactory) -> set[str]:
    """Names of all metrics, as Prometheus stores them."""
    root = tmp_path_factory.mktemp("archive")
    config = ServiceConfig()
    engine = Engine(config, root)
    try:
        pulse = service_metrics.Pulse(turn_age_s=0.0, queued=0, routers=1, clock_lag_s=0.0)
        found = service_metrics.metrics(engine, pulse, config, root)
    finally:
        engine.close()
    counts: Any = SimpleNamespace(
        published={}, acknowledged={}, rejected={}, late={}, resent_batches=0, bad_acks=0, failures=0
    )
    publisher: Any = SimpleNamespace(
        unanswered=0,
        clock_behind_s=0.0,
        counts=counts,
        dropped=0,
        damage=(0, 0),
        stranded=0,
        owed_s=0.0,
        fill=0.0,
        links=1,
        unsettled=lambda: 0,
    )
    progress: Any = SimpleNamespace(behind=0, now_s=0.0, lag_s=0.0)
    found += agent_metrics.metrics(publisher, progress)
    return {f"gripmap_{metric.name}{'_total' if metric.kind == 'counter' else ''}" for metric in found}


@pytest.mark.parametrize("expression", EXPRESSIONS)
def test_every_expression_asks_for_metrics_that_are_shown(expression: str, shown: set[str]) -> None:
    asked = set(re.findall(r"gripmap_\w+", expression))
    assert asked <= shown, asked - shown
    assert asked or expression.startswith("up{")


def test_the_handbook_says_what_to_do_about_every_rule() -> None:
    handbook = (ROOT / "deploy" / "docs" / "operations.md").read_text()
    assert set(re.findall(r"`(GripMap\w+)`", handbook)) == {rule["alert"] for rule in RULES}


def test_prometheus_accepts_the_rules() -> None:
    promtool = shutil.which("promtool")
    if promtool is None:
        pytest.skip("promtool is not installed (Debian's package prometheus has it)")
    done = subprocess.run(
        [promtool, "check", "rules", str(FOLDER / "gripmap.rules.yml")], capture_output=True, text=True
    )
    assert done.returncode == 0, done.stdout + done.stderr
