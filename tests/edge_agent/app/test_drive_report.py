"""Tests of reports of a drive. The plots must show the estimates, and unknown values must have no
colour.
"""

from __future__ import annotations

import json
import re
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pytest

from edge_agent.app import drive_report
from edge_agent.app.drive_report import (
    MOST_POINTS,
    PANELS,
    RecordedDrive,
    curve_of,
    page_of,
    write_report,
)
from edge_agent.inputs.signal_log import SignalLog
from schemas.errors import InputError
from schemas.numeric import FloatArray
from schemas.signals import CHANNELS, Health, S
from schemas.tables import ESTIMATES_SCHEMA
from tests.browser import DESK, open_page

ROWS = 4000
START_NS = 1_700_000_000 * 10**9


def drive_of(*names: str, rows: int = ROWS, wide: bool = False) -> RecordedDrive:
    t: FloatArray = np.arange(rows, dtype=np.float64) * 0.01
    columns: dict[str, Any] = {name: np.full(rows, 0.1) for name in ESTIMATES_SCHEMA.names}
    columns |= {
        "t": t,
        "vx": 10.0 + np.sin(t),
        "mu": np.full(rows, 0.3),
        "mu_lower": np.full(rows, 0.1 if wide else 0.25),
        "mu_upper": np.full(rows, 1.1 if wide else 0.35),
        "health": np.where(t > 20, Health.NO_POSITION.value, 0).astype(np.int32),
    }
    table = pa.table(columns).cast(ESTIMATES_SCHEMA)
    signals = np.full((rows, len(CHANNELS)), np.nan)
    signals[:, S.LATITUDE] = 57.7 + t * 1e-5
    signals[:, S.LONGITUDE] = 11.97
    return RecordedDrive(
        SignalLog(t, signals, START_NS), dict.fromkeys(names or ("ckf",), table), "a <drive>"
    )


def data_of(text: str) -> dict[str, Any]:
    found = re.search(r"const data = (\{.*\});\n", text)
    assert found is not None
    return dict(json.loads(found[1]))


def test_the_page_holds_every_quantity_of_every_estimator() -> None:
    found = data_of(page_of(drive_of("ckf", "sr-ukf")))
    assert [plot["name"] for plot in found["plots"]] == [panel.name for panel in PANELS]
    assert all(
        [c["estimator"] for c in plot["curves"]] == ["ckf", "sr-ukf"] for plot in found["plots"]
    )
    assert found["health"] == [{"name": "no position", "spans": [[20.01, 39.99]]}]
    assert len(found["track"]["x"]) == len(found["track"]["colour"])


def test_a_long_drive_is_thinned_and_its_band_keeps_its_extremes() -> None:
    drive = drive_of(rows=10 * MOST_POINTS)
    table = drive.estimates["ckf"]
    lower = table["mu_lower"].to_numpy().copy()
    lower[777] = 0.07
    table = table.set_column(table.schema.get_field_index("mu_lower"), "mu_lower", pa.array(lower))
    found = data_of(page_of(RecordedDrive(drive.log, {"ckf": table}, "")))
    friction = next(plot for plot in found["plots"] if plot["name"].startswith("friction"))
    assert len(friction["curves"][0]["t"]) <= MOST_POINTS
    assert min(friction["curves"][0]["low"]) == 0.07


def test_a_track_without_knowledge_has_no_colour() -> None:
    assert set(data_of(page_of(drive_of(wide=True)))["track"]["colour"]) == {None}
    assert None not in data_of(page_of(drive_of()))["track"]["colour"]


def test_track_over_the_antimeridian_is_continuous() -> None:
    drive = drive_of()
    drive.log.signals[:, S.LATITUDE] = -16.8
    drive.log.signals[:, S.LONGITUDE] = (179.9998 + drive.log.t * 1e-5 + 180.0) % 360.0 - 180.0
    track = data_of(page_of(drive))["track"]
    assert max(track["x"]) - min(track["x"]) == pytest.approx(42.6, abs=0.5)


def test_title_of_a_report_is_escaped() -> None:
    text = page_of(drive_of())
    assert "<drive>" not in text
    assert "a &lt;drive&gt;" in text
    assert not re.search(r'(?:src|href)="(?!data:)', text)


def test_the_band_of_a_standard_deviation_is_its_90_percent_interval() -> None:
    t, value, low, high = curve_of(drive_of().estimates["ckf"], PANELS[0])
    assert len(t) == ROWS
    assert high - value == pytest.approx(0.1645, abs=1e-4)
    assert value - low == pytest.approx(0.1645, abs=1e-4)


def test_an_image_is_written(tmp_path: Path) -> None:
    drive = drive_of("ckf", "sr-ukf")
    write_report(drive, tmp_path / "drive.png")
    assert (tmp_path / "drive.png").read_bytes().startswith(b"\x89PNG")


def test_an_unknown_ending_is_refused(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="known ending"):
        write_report(drive_of(), tmp_path / "drive.xls")
    assert drive_report.ENDINGS == (".html", ".png", ".svg", ".pdf")


@pytest.mark.campaign
def test_straight_drive_leaves_all_values_in_the_window(tmp_path: Path) -> None:
    """The plot of a track straight to the north must not be taller than the window."""
    write_report(drive_of(), tmp_path / "drive.html")
    with open_page(tmp_path / "drive.html") as seen:
        box = seen.page.locator("#track svg").bounding_box()
        values = seen.page.locator("#values").bounding_box()
    assert box is not None
    assert values is not None
    assert box["height"] < 0.6 * DESK["height"]
    assert values["y"] + values["height"] <= DESK["height"]
    assert seen.errors == []


@pytest.mark.campaign
def test_times_of_health_and_letters_are_right_on_a_phone(tmp_path: Path) -> None:
    write_report(drive_of(), tmp_path / "drive.html")
    with open_page(tmp_path / "drive.html", phone=True) as seen:
        plots = seen.page.locator("#plots svg")
        letter = seen.page.locator("#plots text").first.bounding_box()
        bar = plots.last.locator("rect").bounding_box()
        axis = plots.first.locator(".grid").first.bounding_box()
    assert letter is not None
    assert letter["height"] > 10.0
    assert bar is not None
    assert axis is not None
    assert bar["x"] - axis["x"] == pytest.approx(20.01 / 39.99 * axis["width"], abs=2.0)
    assert seen.errors == []
