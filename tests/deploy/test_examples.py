"""Tests that every example runs as it is, and prints what its page says."""

from __future__ import annotations

import json
import math
import time
import xml.etree.ElementTree as ET
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import zenoh

from deploy.examples import archive_questions, be_warned, first_estimate, own_estimator, query_map
from deploy.router import open_router
from fleet_service.analytics import synthetic
from fleet_service.archive.maintenance.compaction import compact
from schemas.config import ZenohSettings
from schemas.runtime.palette import GRIP_RANGE, shade
from schemas.runtime.zenoh_session import open_session
from tests.fleet_service.app.test_service import Fleet
from tests.fleet_service.conftest import running
from tests.fleet_service.examples import LATITUDE, LONGITUDE, SECOND, batch
from tests.structure import ROOT

FOLDER = ROOT / "deploy" / "examples"
Output = pytest.CaptureFixture[str]


def test_readme_lists_every_example() -> None:
    text = (FOLDER / "README.md").read_text()
    files = [
        path.name
        for path in FOLDER.iterdir()
        if path.suffix in (".py", ".ipynb", ".qml") and path.stem[0] != "_"
    ]
    assert len(files) > 5
    assert not [name for name in files if f"`{name}`" not in text]


def test_a_first_estimate_makes_a_frame_and_a_plot(tmp_path: Path, capsys: Output) -> None:
    first_estimate.main(tmp_path)
    assert capsys.readouterr().out.splitlines()[0].split()[:3] == ["t", "vx", "mu"]
    assert "<svg" in (tmp_path / "first.svg").read_text()


def test_own_estimator_reports_at_least_the_grip_used(capsys: Output) -> None:
    own_estimator.main()
    (row,) = json.loads(capsys.readouterr().out.replace("'", '"'))
    assert row["mu_lower"] <= row["mu"] <= row["mu_upper"]
    assert row["mu_lower"] > 0.3


@contextmanager
def serve_ice(folder: Path) -> Iterator[str]:
    """Yield the endpoint of a router whose service has received reports of ice from
    three vehicles.
    """
    session, endpoints = open_router(listen="tcp/127.0.0.1:0")
    settings = ZenohSettings(connect=endpoints)
    with session, running(settings, folder):
        monitoring_session: zenoh.Session | None = open_session(settings)
        assert monitoring_session is not None
        with monitoring_session:
            fleet = Fleet(monitoring_session).await_services()
            fleet.settle(
                *(batch(f"sim-{k:03}", 1, time.time_ns() - SECOND, [0.2]) for k in range(3))
            )
            yield endpoints[0]


def test_map_is_queried_and_a_tile_decoded(tmp_path: Path, capsys: Output) -> None:
    with serve_ice(tmp_path) as endpoint:
        assert query_map.main(endpoint) == 1
    assert ": 1 cells" in capsys.readouterr().out


def test_car_is_warned_of_ice_that_three_others_found(tmp_path: Path, capsys: Output) -> None:
    """A car that approaches ice reported by three other cars must be warned. Router, service,
    reports and alert are real.
    """
    before = LONGITUDE - 60.0 / 111e3 / math.cos(math.radians(LATITUDE))
    with serve_ice(tmp_path) as endpoint:
        warned = be_warned.main(endpoint, LATITUDE, before)
    assert warned.startswith("my-car: slippery in ")
    assert "an alert is active" in warned or "the map reports low grip" in warned
    assert capsys.readouterr().out.startswith("ahead on ")


def test_the_archive_is_the_same_in_pandas_and_duckdb(tmp_path: Path, capsys: Output) -> None:
    world = synthetic.SyntheticFleet(rows=6000, days=1, vehicles=20, roads=4, length=30, icy=2)
    synthetic.write_archive(tmp_path / "archive", world, 2000)
    compact(tmp_path / "archive")
    archive_questions.main(tmp_path / "archive", tmp_path / "out")
    stdout = capsys.readouterr().out
    assert stdout.startswith("largest difference of the two: 0")
    assert "stretches, " in stdout


@pytest.mark.parametrize("path", sorted(FOLDER.glob("*.ipynb")), ids=lambda path: str(path.stem))
def test_a_notebook_runs_from_its_first_cell_to_its_last(path: Path) -> None:
    notebook = json.loads(path.read_text())
    assert notebook["nbformat"] == 4
    cells = ["".join(cell["source"]) for cell in notebook["cells"] if cell["cell_type"] == "code"]
    assert len(cells) >= 4
    space: dict[str, Any] = {}
    for cell in cells:
        exec(compile(cell, str(path), "exec"), space)  # runs the cell as a Jupyter kernel does
    shown = [cell["execution_count"] for cell in notebook["cells"] if cell.get("outputs")]
    assert shown == sorted(shown), "outputs are of one run, from the first cell to the last"


@pytest.mark.parametrize("path", sorted(FOLDER.glob("*.ipynb")), ids=lambda path: str(path.stem))
def test_a_notebook_shows_its_results_without_being_run(path: Path) -> None:
    assert path.stat().st_size < 150_000
    notebook = json.loads(path.read_text())
    outputs = [output for cell in notebook["cells"] for output in cell.get("outputs", ())]
    kind = "text/html" if path.stem == "archive" else "image/png"
    assert any(kind in output["data"] for output in outputs if "data" in output)
    assert not any(output["output_type"] == "error" for output in outputs)


def test_qgis_style_has_the_map_colours_and_none_for_unknown() -> None:
    text = (FOLDER / "gripmap.qml").read_text()
    root = ET.fromstring(text[text.index("<qgis") :])
    rules = {rule.get("label", ""): rule.get("filter", "") for rule in root.iter("rule")}
    assert '"mu" IS NULL' in rules.values()
    ice = [int(shade(0.15, *GRIP_RANGE)[k : k + 2], 16) for k in (1, 3, 5)]
    assert f"{ice[0]},{ice[1]},{ice[2]},255" in text
    assert text.count("b_diagonal") == 1
    edges = np.array(
        [
            float(word)
            for rule in rules.values()
            if "AND" in rule
            for word in rule.split()
            if word[0] in "0123456789"
        ]
    )
    assert edges.min() == 0.0
    assert edges.max() >= 1.2
