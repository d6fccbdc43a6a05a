"""Tests of friction as VSS signals (Vehicle Signal Specification). Values must be percentages
within the allowed range, and unknown values must be absent. The command must print the values that
it publishes over a session.
"""

from __future__ import annotations

import json
import math
from pathlib import Path

import numpy as np
import pytest
import zenoh

from edge_agent.cli import main
from edge_agent.observe.pipeline import Grip
from edge_agent.publish.vss import BRANCH, RoadFrictionOutput, road_friction
from schemas import keys
from schemas.runtime.zenoh_session import configuration
from schemas.thresholds import NS
from tests.edge_agent.service import Router, Service
from tests.waiting import matched, until

START = 1_800_000_000 * NS
WORDS = [
    "run",
    "--scenario",
    "test",
    "--estimator",
    "ckf",
    "--name",
    "car-one",
    "--duration",
    "6",
    "--vss",
]


def grip(mu: float, lower: float, upper: float, used: float, seconds: float = 0.0) -> Grip:
    values = (np.array([value]) for value in (mu, lower, upper, used))
    return Grip._make((*values, np.array([START + round(seconds * NS)])))


def names(known: dict[str, float]) -> dict[str, float]:
    return {
        name.removeprefix(f"{BRANCH}."): value
        for name, value in known.items()
        if name.startswith(BRANCH)
    }


def test_quantiles_are_percent_and_clipped() -> None:
    assert names(road_friction(0.312, 0.25, 0.4, 0.3)) == {
        "MostProbable": 31.2,
        "LowerBound": 25.0,
        "UpperBound": 40.0,
    }
    assert names(road_friction(1.05, 0.9, 1.18, 1.0)) == {
        "MostProbable": 100.0,
        "LowerBound": 90.0,
        "UpperBound": 100.0,
    }


@pytest.mark.parametrize("used", [0.0, 0.35, math.nan])
def test_hardly_used_grip_has_no_most_probable_value(used: float) -> None:
    assert names(road_friction(0.6, 0.11, 1.14, used)) == {"LowerBound": 11.0, "UpperBound": 100.0}


def test_unknown_friction_is_absent() -> None:
    assert road_friction(math.nan, math.nan, math.nan, 0.5) == {}


def test_friction_is_reported_at_the_given_rate() -> None:
    lines: list[str] = []
    output = RoadFrictionOutput(["car-one"], lines.append, 2.0)
    output.report_grip(None)
    for k in range(21):
        output.report_grip(grip(0.3, 0.2, 0.4, 0.3, 0.1 * k))
    assert len(lines) == 5
    assert json.loads(lines[1])["time"] == "2027-01-15T08:00:00.500Z"


def test_subscriber_receives_the_printed_vss_value(router: Router) -> None:
    lines: list[str] = []
    output = RoadFrictionOutput(["car-one"], lines.append, 10.0)
    received: list[str] = []
    with (
        zenoh.open(configuration(router.settings, "car-one")) as car,
        zenoh.open(configuration(router.settings, "dashboard")) as dashboard,
    ):
        output.attach("car-one", car)
        output.report_grip(grip(0.3, 0.2, 0.4, 0.3))
        dashboard.declare_subscriber(
            keys.vss_key("car-one"), lambda sample: received.append(sample.payload.to_string())
        )
        matched(output.publishers["car-one"])
        output.report_grip(grip(0.3, 0.2, 0.4, 0.3, 1.0))
        until(lambda: received)
    assert received == lines[1:]
    assert names(json.loads(received[0]))["MostProbable"] == 30.0


@pytest.mark.campaign
def test_the_command_prints_lines_of_the_drive(
    router: Router, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    config = tmp_path / "agent.json"
    config.write_text(
        json.dumps({"zenoh": router.settings.model_dump(), "spool": str(tmp_path / "spool.sqlite")})
    )
    with Service(router):
        assert main([*WORDS, "--config", str(config)]) == 0
    *lines, _ = capsys.readouterr().out.splitlines()
    signals = [json.loads(line) for line in lines]
    assert len(signals) > 1
    assert {one["event"] for one in signals} == {"vss"}
    assert {one["vehicle"] for one in signals} == {"car-one"}
    for one in signals:
        known = names(one)
        assert 0.0 < known["LowerBound"] < known["UpperBound"] <= 100.0
        assert known["LowerBound"] <= known.get("MostProbable", 100.0)
