"""Regression tests of bugs that new users met in their first hour and that no other test covers."""

from __future__ import annotations

import re
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc
import pyarrow.parquet as pq
import pytest
import zenoh
from matplotlib.figure import Figure

import edge_agent
from deploy.router import open_router
from edge_agent.cli import main as edge_agent_main
from edge_agent.lab.simulation import PRESETS
from fleet_service.analytics import plots, synthetic
from fleet_service.archive.maintenance.compaction import compact
from fleet_service.cli import main as fleet_service_main
from schemas import keys, wire
from schemas.config import AgentConfig, ZenohSettings, load_config
from schemas.runtime.zenoh_session import open_session
from tests.edge_agent.inputs.formats import BLF, NMEA, VEHICLE
from tests.fleet_service.conftest import running
from tests.structure import ROOT
from tests.usability.wrong_logs import find_unnoticed
from tests.waiting import until


def test_replay_mentions_faulty_signals_and_is_silent_for_sound_ones(tmp_path: Path) -> None:
    assert (
        find_unnoticed(tmp_path, ["a_y flipped", "yaw rate in deg/s", "mass in tonnes"], 9000) == []
    )


def test_two_cars_of_one_shipped_configuration_have_an_outbox_each() -> None:
    config = load_config(ROOT / "deploy" / "agent.json", AgentConfig)
    assert config.spool_of("car-one") != config.spool_of("car-two")


def test_every_estimator_is_made_by_its_name_alone() -> None:
    vehicle = PRESETS["sedan"].vehicle
    assert len(edge_agent.ESTIMATORS) >= 8
    assert all(
        isinstance(edge_agent.make_bank(name, [vehicle]), edge_agent.EstimatorBank)
        for name in edge_agent.ESTIMATORS
    )


def test_plot_shows_before_left_of_after_and_the_difference() -> None:
    both = {"cells": 3, "vehicles": 4, "values": 50}
    table = pa.Table.from_pylist(
        [
            {"period": "after", "mu": 0.6, "lower": 0.1, "difference": 0.2, "upper": 0.3, **both},
            {
                "period": "before",
                "mu": 0.4,
                "lower": None,
                "difference": None,
                "upper": None,
                **both,
            },
        ]
    )
    figure = Figure()
    plots._before_after(figure, table)
    left, right = figure.axes
    assert [label.get_text() for label in left.get_xticklabels()] == ["before", "after"]
    assert np.asarray(left.lines[0].get_ydata()).tolist() == [0.4, 0.6]
    assert left.get_ylim()[0] == 0.0, "a cut axis makes little look like much"
    bars: Any = right.collections[0]
    (bar,) = bars.get_segments()
    assert bar[:, 1].tolist() == pytest.approx([0.1, 0.3])


def test_a_person_s_report_by_hand_as_the_page_has_it_is_acknowledged(tmp_path: Path) -> None:
    page = (ROOT / "schemas" / "README.md").read_text()
    found = re.search(r"### Publishing by hand\n+```python\n(.*?)```", page, re.DOTALL)
    assert found
    session, endpoints = open_router(listen="tcp/127.0.0.1:0")
    settings = ZenohSettings(connect=endpoints)
    with session, running(settings, tmp_path):
        reader: zenoh.Session | None = open_session(settings)
        assert reader is not None
        with reader:
            acks: list[bytes] = []
            reader.declare_subscriber(
                keys.ack_key("anna"), lambda sample: acks.append(sample.payload.to_bytes())
            )
            exec(found[1].replace("tcp/127.0.0.1:7447", endpoints[0]), {})
            until(lambda: acks)
    vehicle, (stream,) = wire.decode_ack(acks[0])
    assert vehicle == "anna"
    assert stream.durable
    assert not stream.rejected


def test_replay_without_a_vehicle_file_explains_how_to_get_one(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    log = tmp_path / "drive.parquet"
    assert edge_agent_main(["simulate", "slalom", "--duration", "2", "--out", str(log)]) == 0
    words = ["replay", str(log), "--out", str(tmp_path / "e.parquet")]
    assert edge_agent_main(words) == 2
    last_line = capsys.readouterr().err.splitlines()[-1]
    assert last_line.startswith("error: vehicle: cannot read ")
    assert f"--vehicle-out {tmp_path / 'drive.json'}" in last_line
    again = ["simulate", "slalom", "--duration", "2", "--out", str(log), *last_line.split()[-4:-2]]
    assert edge_agent_main(again) == 0
    assert edge_agent_main(words) in (0, 3)


def test_real_minute_with_steering_in_degrees_is_named(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    log = tmp_path / "minute.parquet"
    files = [str(BLF), str(NMEA), "--profile", "toyota", "--vehicle", str(VEHICLE)]
    assert edge_agent_main(["import", *files, "--out", str(log)]) == 0
    table = pq.read_table(log)
    at = table.schema.get_field_index("delta_fl")
    field = table.schema.field(at)
    degrees = pc.multiply(table[field.name], 180.0 / np.pi).cast(field.type)
    table = table.set_column(at, field, degrees)
    pq.write_table(table, log)
    capsys.readouterr()
    assert edge_agent_main(["check", str(log), "--vehicle", str(VEHICLE)]) == 1
    assert re.search(r"^FAULT +delta +deg ", capsys.readouterr().out, re.MULTILINE)


def test_times_in_csv_answers_are_iso_8601(tmp_path: Path) -> None:
    archive = tmp_path / "archive"
    synthetic.write_archive(archive, synthetic.SyntheticFleet(6000, 1, 20, 4, 30, 1), 2000)
    compact(archive)
    for question, columns in {"spells": ("onset",), "grip": ("day",)}.items():
        out = tmp_path / f"{question}.csv"
        assert (
            fleet_service_main(
                [
                    "analyze",
                    question,
                    "--archive",
                    str(archive),
                    "--to",
                    "2026-01-28",
                    "--out",
                    str(out),
                ]
            )
            == 0
        )
        head, *rows = (line.split(",") for line in out.read_text().splitlines())
        assert rows
        names = [name.strip('"') for name in head]
        for name in columns:
            assert re.match(r'"?2026-01-27', rows[0][names.index(name)])
        assert {"latitude", "longitude"} <= set(names)


def test_example_without_its_arguments_prints_its_usage(tmp_path: Path) -> None:
    command = [sys.executable, str(ROOT / "deploy" / "examples" / "be_warned.py")]
    done = subprocess.run(command, cwd=tmp_path, capture_output=True, text=True, check=False)
    assert "Traceback" not in done.stderr
    assert "be_warned.py ENDPOINT LATITUDE LONGITUDE" in done.stderr + done.stdout


@pytest.mark.parametrize(
    ("main", "line"),
    [
        (edge_agent_main, "simulate slalom --mu 0,5 --out x.parquet"),
        (fleet_service_main, "page --port 80a"),
        (fleet_service_main, "analyze grip"),
    ],
)
def test_argument_errors_are_one_line(
    main: Callable[[list[str]], int], line: str, capsys: pytest.CaptureFixture[str]
) -> None:
    with pytest.raises(SystemExit) as left:
        main(line.split())
    assert left.value.code == 2
    (error_line,) = capsys.readouterr().err.splitlines()
    assert error_line.startswith("error: ")


def test_title_of_the_first_estimate_has_the_speed_of_its_curve() -> None:
    truth, _ = edge_agent.simulate_manoeuvre("double-lane-change", mu=0.5, seed=1)
    text = (ROOT / "deploy" / "examples" / "first_estimate.py").read_text()
    title = re.search(r"double lane change at (\d+) m/s", text)
    assert title is not None
    assert round(float(truth["true_vx"][0].as_py())) == int(title[1])
