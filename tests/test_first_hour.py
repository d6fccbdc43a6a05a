"""Regression tests of bugs that new users met in their first hour and that no other test covers."""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pytest
import zenoh
from matplotlib.figure import Figure

import edge_agent
from deploy.router import open_router
from edge_agent.lab.simulation import PRESETS
from fleet_service.analytics import plots
from schemas import keys, wire
from schemas.config import AgentConfig, ZenohSettings, load
from schemas.runtime.zenoh_session import open_session
from tests.fleet_service.conftest import running
from tests.structure import ROOT
from tests.usability.wrong_logs import find_unnoticed
from tests.waiting import until


def test_replay_mentions_faulty_signals_and_is_silent_for_sound_ones(tmp_path: Path) -> None:
    assert (
        find_unnoticed(tmp_path, ["a_y flipped", "yaw rate in deg/s", "mass in tonnes"], 9000) == []
    )


def test_two_cars_of_one_shipped_configuration_have_an_outbox_each() -> None:
    config = load(ROOT / "deploy" / "agent.json", AgentConfig)
    assert config.spool_of("car-one") != config.spool_of("car-two")


def test_every_estimator_is_made_by_its_name_alone() -> None:
    vehicle = PRESETS["sedan"].vehicle
    assert len(edge_agent.ESTIMATORS) >= 8
    assert all(
        isinstance(edge_agent.make_bank(name, [vehicle]), edge_agent.EstimatorBank)
        for name in edge_agent.ESTIMATORS
    )


def test_before_stands_left_of_after_and_their_difference_has_its_interval() -> None:
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
            heard: list[bytes] = []
            reader.declare_subscriber(
                keys.ack_key("anna"), lambda sample: heard.append(sample.payload.to_bytes())
            )
            exec(found[1].replace("tcp/127.0.0.1:7447", endpoints[0]), {})
            until(lambda: heard)
    vehicle, (stream,) = wire.decode_ack(heard[0])
    assert vehicle == "anna"
    assert stream.durable
    assert not stream.rejected
