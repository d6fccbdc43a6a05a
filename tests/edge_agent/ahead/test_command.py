"""Tests of `edge-agent run --ahead` as a process: it prints its warnings as JSON lines, uses the
route file, and refuses options that need `--ahead` without it.
"""

from __future__ import annotations

import json
import time
from pathlib import Path

import numpy as np
import pytest

from edge_agent.cli import main
from edge_agent.lab.simulation.scenarios import scenario_named
from schemas import grid
from schemas.wire import Alert
from tests.benchmarks.ahead.made_up_service import MadeUpService
from tests.edge_agent.ahead.roads import alert
from tests.edge_agent.service import Router, Service

WORDS = ["run", "--scenario", "test", "--estimator", "ckf", "--name", "car-one", "--duration", "6"]


def everywhere_slippery(now: int) -> list[Alert]:
    """Return active ice alerts for every map cell on the triangular course of the simulated car."""
    scenario = scenario_named("test")
    x, y = np.meshgrid(np.arange(-15.0, 130.0, 5.0), np.arange(-15.0, 105.0, 5.0))
    cells = np.unique(grid.cell_of(*scenario.to_latlon(x.ravel(), y.ravel())))
    return [
        alert(int(cell) * grid.SECTORS + k, time=now) for cell in cells for k in range(grid.SECTORS)
    ]


def settings(folder: Path, router: Router) -> list[str]:
    path = folder / "agent.json"
    path.write_text(
        json.dumps(
            {
                "zenoh": router.settings.model_dump(),
                "spool": str(folder / "spool.sqlite"),
                "log": "json",
            }
        )
    )
    return ["--config", str(path)]


@pytest.mark.campaign
def test_a_car_that_listens_prints_its_warnings_and_heeds_its_route(
    router: Router, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    now = time.time_ns()
    scenario = scenario_named("test")
    corners = np.array([scenario.junctions[name] for name in ("a", "b", "c", "a", "c", "b", "a")])
    latitude, longitude = scenario.to_latlon(corners[:, 0], corners[:, 1])
    route = tmp_path / "way.geojson"
    route.write_text(
        json.dumps(
            {"type": "LineString", "coordinates": np.column_stack([longitude, latitude]).tolist()}
        )
    )
    with MadeUpService(router.settings, now, standing=everywhere_slippery(now)), Service(router):
        assert main([*WORDS, *settings(tmp_path, router), "--ahead", "--route", str(route)]) == 0
    *lines, last = capsys.readouterr().out.splitlines()
    warnings = [one for line in lines if (one := json.loads(line)).get("event") == "warning"]
    assert warnings[0]["state"] == "raised"
    assert warnings[0]["vehicle"] == "car-one"
    assert {one["way"] for one in warnings} == {"route"}
    counts = json.loads(last)
    assert counts["warnings"] == len(warnings)
    assert counts["heard_bytes"] > 0
    assert counts["looks"] >= 3


@pytest.mark.parametrize("more", [[], ["--autoware-hash", "RIHS01_0"]])
def test_limits_for_a_planner_without_listening_are_a_mistake(
    capsys: pytest.CaptureFixture[str], more: list[str]
) -> None:
    assert main([*WORDS, "--autoware", "tcp/127.0.0.1:7447", *more]) == 2
    assert "autoware: needs --ahead" in capsys.readouterr().err


def test_type_of_limits_without_a_planner_is_a_mistake(
    capsys: pytest.CaptureFixture[str],
) -> None:
    assert main([*WORDS, "--ahead", "--autoware-hash", "RIHS01_0"]) == 2
    assert "autoware-hash: needs --autoware" in capsys.readouterr().err


def test_a_route_without_listening_is_a_mistake(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main([*WORDS, "--route", str(tmp_path / "way.gpx")]) == 2
    assert "route: needs --ahead" in capsys.readouterr().err


@pytest.mark.campaign
def test_only_the_given_share_of_a_fleet_is_warned(
    router: Router, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    now = time.time_ns()
    words = [
        "fleet",
        "--scenario",
        "test",
        "--estimator",
        "ckf",
        "--vehicles",
        "4",
        "--duration",
        "6",
    ]
    with MadeUpService(router.settings, now, standing=everywhere_slippery(now)), Service(router):
        assert main([*words, *settings(tmp_path, router), "--warned", "0.5"]) == 0
    lines = [json.loads(line) for line in capsys.readouterr().out.splitlines()]
    warned = {one["vehicle"] for one in lines if one.get("event") == "warning"}
    assert warned == {"sim-001", "sim-004"}
    assert {one["way"] for one in lines if one.get("event") == "warning"} == {"route"}
    assert main([*words, "--warned", "2"]) == 2


def test_a_share_of_winter_vehicles_beyond_one_is_refused(
    capsys: pytest.CaptureFixture[str],
) -> None:
    words = [
        "fleet",
        "--scenario",
        "test",
        "--estimator",
        "ckf",
        "--vehicles",
        "2",
        "--duration",
        "1",
    ]
    assert main([*words, "--winter", "2"]) == 2
    assert "error: winter: " in capsys.readouterr().err
