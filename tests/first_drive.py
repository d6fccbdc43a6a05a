"""The first drive of the tutorial: a recorded minute on a dry motorway, imported, checked and
published under three vehicle names.
"""

from __future__ import annotations

import json
import re
from contextlib import redirect_stderr, redirect_stdout
from io import StringIO
from pathlib import Path
from typing import TypeAlias

from edge_agent.cli import main as edge_agent
from schemas.config import ZenohSettings
from schemas.runtime.zenoh_session import open_session
from tests.edge_agent.inputs.formats import BLF, NMEA, VEHICLE
from tests.structure import ROOT
from tests.test_end_to_end import VEHICLES, System, run_system

Cells: TypeAlias = list[dict[str, object]]


def read_commands() -> list[str]:
    """Return the commands of the tutorial's section "A real minute"."""
    text = (ROOT / "deploy" / "docs" / "tutorials" / "first-drive.md").read_text(encoding="utf-8")
    block = re.search(r"## A real minute\n.*?```\n(.*?)```", text, re.DOTALL)
    assert block
    return block[1].strip().splitlines()


def map_first_drive(folder: Path) -> tuple[Cells, list[str]]:
    """Start a new router and service. Publish the tutorial's recording, one minute of real driving,
    once under each of several vehicle names. Return the cells of the map and the keys of the
    alerts.
    """
    with run_system(folder) as system:
        return _publish_drive(system, folder / "drive.parquet")


def _publish_drive(system: System, log: Path) -> tuple[Cells, list[str]]:
    """Import, check and replay the tutorial's recording, and publish it under each vehicle name.
    Return the cells of the map and the keys of the alerts.
    """
    car = ["--vehicle", str(VEHICLE)]
    out = str(log.with_suffix(".csv"))
    alerts = list[str]()
    session = open_session(ZenohSettings(connect=[system.endpoint]))
    assert session is not None
    with session:
        held = session.declare_subscriber(
            "gripmap/v1/alert/**", lambda sample: alerts.append(str(sample.key_expr))
        )
        assert (
            edge_agent(
                ["import", str(BLF), str(NMEA), "--profile", "toyota", *car, "--out", str(log)]
            )
            == 0
        )
        assert edge_agent(["check", str(log), *car]) == 0
        for name in VEHICLES:
            words = [
                "replay",
                str(log),
                *car,
                "--out",
                out,
                "--publish",
                "--name",
                name,
                "--config",
                str(system.agent),
            ]
            with redirect_stdout(StringIO()) as stdout:
                assert edge_agent([*words, "--start", "now"]) == 0
            counts = json.loads(stdout.getvalue().splitlines()[-1])
            assert counts["observations_acknowledged"] > 50
            assert counts["rejected"] == 0
        with redirect_stdout(StringIO()) as stdout, redirect_stderr(StringIO()) as warned:
            assert edge_agent(words) == 1, "of 2018, and nobody takes it"
        refused = json.loads(stdout.getvalue().splitlines()[-1])["rejected"]
        assert refused > 50
        assert (
            f"error: publish: {refused} records were refused; the log is older than a month: "
            "publish it with --start now" in warned.getvalue()
        )
        cells = system.query_cells()
        held.undeclare()
    return cells, alerts
