"""Tests that the dashboard and the alert rules use only metrics that a service or an agent exports,
and that the handbook explains each rule.
"""

from __future__ import annotations

import json
import re
import shutil
import subprocess
from typing import Any

import pytest
import yaml

from tests import reference_pages
from tests.reference_pages import Shown
from tests.structure import ROOT

FOLDER = ROOT / "deploy" / "dashboards"
RULES: list[dict[str, Any]] = [
    rule
    for group in yaml.safe_load((FOLDER / "gripmap.rules.yml").read_text())["groups"]
    for rule in group["rules"]
]
EXPRESSIONS = [rule["expr"] for rule in RULES] + [
    target["expr"]
    for panel in json.loads((FOLDER / "gripmap.json").read_text())["panels"]
    for target in panel["targets"]
]


@pytest.fixture(scope="module")
def shown(tmp_path_factory: pytest.TempPathFactory) -> Shown:
    """Start a service and an agent, and return the names of all metrics that they export."""
    return reference_pages.all_metrics(tmp_path_factory.mktemp("archive"))


@pytest.mark.parametrize("expression", EXPRESSIONS)
def test_every_expression_uses_existing_metrics(expression: str, shown: Shown) -> None:
    asked = set(re.findall(r"gripmap_\w+", expression))
    known = {reference_pages.stored_name(m) for found in shown.values() for m in found}
    assert asked <= known, asked - known
    assert asked or expression.startswith("up{")


def test_every_metric_has_a_meaning_and_a_row_in_the_reference(shown: Shown) -> None:
    metrics = [metric for found in shown.values() for metric in found]
    assert len(metrics) > 40
    assert not [metric.name for metric in metrics if not metric.help]
    page = reference_pages.metrics_page(shown)
    assert not [
        metric.name
        for metric in metrics
        if f"| `{reference_pages.stored_name(metric)}` |" not in page
    ]


def test_handbook_has_an_action_for_every_alert_rule() -> None:
    handbook = (ROOT / "deploy" / "docs" / "how-to" / "operate.md").read_text()
    assert set(re.findall(r"`(GripMap\w+)`", handbook)) == {rule["alert"] for rule in RULES}


def test_prometheus_accepts_the_rules() -> None:
    promtool = shutil.which("promtool")
    if promtool is None:
        pytest.skip("promtool is not installed (Debian's package prometheus has it)")
    done = subprocess.run(
        [promtool, "check", "rules", str(FOLDER / "gripmap.rules.yml")],
        capture_output=True,
        text=True,
    )
    assert done.returncode == 0, done.stdout + done.stderr
