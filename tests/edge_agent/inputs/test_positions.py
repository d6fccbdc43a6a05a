"""Tests of positions and speeds over ground in imported recordings: units, dates, rows without a
fix, and broken times.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest

from edge_agent.inputs.bring_in import read_source
from edge_agent.inputs.merge import Merged, merge_recordings
from edge_agent.inputs.profile import Channel, Profile
from edge_agent.inputs.signal_log import read_log
from schemas.signals import S, per_wheel
from schemas.thresholds import NS
from tests.edge_agent.fakes import a_log

PROFILE = Profile(name="own", channels={n: Channel(signal=n) for n in ("ax", *per_wheel("omega"))})
START_NS = 1_795_946_400 * NS  # 2026-11-29 10:00:00


def merge_files(*paths: Path) -> Merged:
    return merge_recordings([read_source(path, PROFILE, None) for path in paths], PROFILE)


def write_table(path: Path, first: float) -> Path:
    rows = [f"{first + 0.01 * k:.2f},0.1,30,30,30,30" for k in range(600)]
    path.write_text("\n".join(["t,ax,omega_fl,omega_fr,omega_rl,omega_rr", *rows]))
    return path


def write_nmea(path: Path, days: list[str]) -> Path:
    lines = []
    for second, day in enumerate(days):
        body = f"GPRMC,1000{second:02d}.00,A,4800.0000,N,01100.0000,E,19.44,90.0,{day},,"
        total = 0
        for byte in body.encode():
            total ^= byte
        lines.append(f"${body}*{total:02X}")
    path.write_text("\n".join(lines))
    return path


def test_speed_over_ground_is_converted_from_its_unit(tmp_path: Path) -> None:
    names = ("sats", "time", "lat", "long", "velocity", "heading", "ax", *per_wheel("omega"))
    rows = [f"8 {101500 + 0.01 * k:.2f} 3610.5 -1080.3 36.0 90 0.1 30 30 30 30" for k in range(50)]
    text = "\n".join(["[header]", "[column names]", " ".join(names), "[data]", *rows])
    path = tmp_path / "a.vbo"
    path.write_text(text)
    assert np.allclose(merge_files(path).columns["gnss_speed"], 10.0), "36 km/h"


def test_date_of_a_receiver_fits_a_log_that_counts_from_start_up(tmp_path: Path) -> None:
    table = write_table(tmp_path / "a.csv", 5000.0)
    merged = merge_files(table, write_nmea(tmp_path / "a.nmea", ["291126"] * 6))
    assert merged.start_ns == pytest.approx(START_NS, abs=1e6)


def test_date_with_a_zone_corrects_one_without(tmp_path: Path) -> None:
    rows = [f"2026-11-29 12:00:0{k % 6}.{k // 6:02d},0.1,30,30,30,30" for k in range(600)]
    own = tmp_path / "local.csv"
    own.write_text("\n".join(["t,ax,omega_fl,omega_fr,omega_rl,omega_rr", *sorted(rows)]))
    places = tmp_path / "places.csv"
    fixes = [f"2026-11-29T10:00:0{k}Z,48.0,11.0" for k in range(6)]
    places.write_text("\n".join(["time,latitude,longitude", *fixes]))
    profile = PROFILE.model_copy(
        update={
            "channels": PROFILE.channels
            | {name: Channel(signal=name) for name in ("latitude", "longitude")}
        }
    )
    recordings = [read_source(path, None, None) for path in (own, places)]
    assert merge_recordings(recordings, profile).start_ns == START_NS


def test_fixes_before_an_earlier_time_are_counted(tmp_path: Path) -> None:
    path = write_nmea(tmp_path / "a.nmea", ["291129", *["291126"] * 5])
    recording = read_source(path, None, None)
    assert len(recording.signals["latitude"].t) == 1
    assert "5 lines left out" in recording.notes[0]


def test_a_position_at_zero_degrees_is_a_missing_reading(tmp_path: Path) -> None:
    path = tmp_path / "a.parquet"
    columns = a_log(4) | {
        "latitude": np.array([48.0, 0.0, 0.0, 48.1]),
        "longitude": np.array([11.0, 0.0, 11.1, 0.0]),
    }
    pq.write_table(pa.table(columns), path)
    signals = read_log(path).signals
    assert np.isfinite(signals[:, S.LATITUDE]).tolist() == [True, False, True, True]
    assert np.isfinite(signals[:, S.LONGITUDE]).tolist() == [True, False, True, True]
