"""Tests of weather input from a file and over Zenoh: invalid input is refused with a reason, valid
input is archived and has the same effect after a restart.
"""

from __future__ import annotations

import shutil
import time
from collections.abc import Callable
from contextlib import closing
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
import zenoh

from fleet_service.app.engine import Engine
from fleet_service.archive.format.layout import DAY_NS
from fleet_service.archive.maintenance.compaction import compact
from fleet_service.archive.maintenance.retention import drop_checkpoints
from fleet_service.counts import ServiceCounts
from fleet_service.fusion import Fusion
from fleet_service.ingest.inbox import Message
from fleet_service.ingest.weather import (
    MOST_BYTES,
    WAITING,
    WeatherInbox,
    WeatherMessage,
    archived_reports,
    join_daily_files,
    read_file,
    retire_files,
    weather_files,
)
from fleet_service.replay import checkpoints
from schemas import grid, keys, mugrid, tables, weather, wire
from schemas.config import ServiceConfig
from schemas.errors import InputError, WireError
from schemas.weather import Report
from schemas.wire import Kind
from tests.fleet_service.checkpoint_writer import save_checkpoint
from tests.fleet_service.conftest import Running
from tests.fleet_service.examples import REGION, SECOND, batch, key
from tests.schemas.examples import encode_weather
from tests.waiting import matched, until


def test_weather_report_round_trips_and_missing_values_are_unknown() -> None:
    prior = np.full(mugrid.BINS, 1.0 / mugrid.BINS)
    got = weather.decode_report(
        encode_weather(Report(17, road_temperature=-2.5, precipitation=0.25, prior=prior))
    )
    assert (got.time, got.road_temperature, got.precipitation) == (17, -2.5, 0.25)
    assert np.isnan(got.air_temperature)
    assert got.prior == pytest.approx(prior)
    by_hand = weather.decode_report(b'{"time": "5", "airTemperature": 3.5}', wire.JSON)
    assert (by_hand.time, by_hand.air_temperature) == (5, 3.5)
    assert np.isnan(by_hand.precipitation)
    assert by_hand.prior is None


@pytest.mark.parametrize(
    ("report", "field"),
    [
        (Report(1), "weather"),
        (Report(1, road_temperature=400.0), "road_temperature"),
        (Report(1, precipitation=-1.0), "precipitation"),
        (Report(1, air_temperature=float("inf")), "air_temperature"),
        (Report(1, prior=np.ones(3) / 3), "prior"),
        (Report(1, prior=np.ones(mugrid.BINS)), "prior"),
        (Report(1, prior=np.r_[-1.0, 2.0, np.zeros(mugrid.BINS - 2)]), "prior"),
    ],
)
def test_a_report_that_breaks_a_rule_is_refused_by_name(report: Report, field: str) -> None:
    with pytest.raises(WireError, match=f"^{field}: .*; "):
        weather.decode_report(encode_weather(report))


def file(path: Path, **columns: object) -> Path:
    pq.write_table(pa.table(columns), path)
    return path


@pytest.mark.parametrize(
    ("columns", "complaint"),
    [
        ({"region": ["1202300230"]}, "row 0: region, time or a number is missing"),
        ({"region": ["1202300230"], "time": [1], "wind": [3.0]}, "wind is not a column"),
        (
            {"region": ["1202300230"], "time": [1], "precipitation": [-9999.0]},
            "row 0, precipitation: -9999 lies outside",
        ),
        (
            {"region": [-1], "time": [1], "precipitation": [1.0]},
            "row 0, region: is not a z10 region",
        ),
        (
            {"region": ["1202300230"], "time": [1_796_000_000], "precipitation": [1.0]},
            "row 0, time: lies before 2000; give a timestamp, or ns",
        ),
        ({"region": ["12x"], "time": [1], "precipitation": [1.0]}, "row 0: region, time"),
    ],
)
def test_a_wrong_weather_file_is_refused_with_row_and_column(
    tmp_path: Path, columns: dict[str, list[Any]], complaint: str
) -> None:
    with pytest.raises(InputError, match=complaint):
        read_file(file(tmp_path / "w.parquet", **columns))
    with pytest.raises(InputError, match="cannot read"):
        read_file(tmp_path / "none.parquet")


def test_zone_of_a_time_in_a_weather_file_is_heeded(tmp_path: Path) -> None:
    noon_utc = pa.array([1_796_040_000], pa.timestamp("s", "Europe/Stockholm"))
    columns = {"region": ["1202300230"], "time": noon_utc, "precipitation": [1.0]}
    [(_, report)] = read_file(file(tmp_path / "w.parquet", **columns))
    assert report.time == 1_796_040_000 * 10**9


def drive(engine: Engine, begin: int, seq: int) -> None:
    """Let the engine (service without network) process one observation of each of three vehicles.
    `begin` is the time [ns] of the first, `seq` the number of each batch.
    """
    for k in range(3):
        sent = batch(f"sim-00{k}", seq, begin + k * SECOND, [0.8])
        engine.intake.ingest(
            [Message(Kind.OBSERVATION, key(sent.vehicle), wire.encode(sent), "")],
            begin + 60 * SECOND,
        )
    engine.settlement.flush()


def beliefs(engine: Engine, now: int) -> np.ndarray:
    return engine.state.fusion.beliefs(np.arange(engine.state.fusion.size), now)


def test_restart_has_the_used_weather_and_gives_the_same_map(tmp_path: Path) -> None:
    start = time.time_ns() - 7200 * SECOND
    path = file(
        tmp_path / "w.parquet",
        region=[grid.quadkey(REGION, grid.REGION_ZOOM)],
        time=pa.array([start - 600 * SECOND], pa.timestamp("ns", "UTC")),
        air_temperature=[5.0],
        precipitation=[3.0],
    )
    config = ServiceConfig(weather=path)
    engine = Engine(config, tmp_path / "a")
    drive(engine, start, 1)
    payload = encode_weather(
        Report(start + 1200 * SECOND, road_temperature=-1.0, precipitation=1.0)
    )
    engine.intake.weather.enqueue(
        WeatherMessage(keys.weather_key(REGION), payload, wire.WEATHER_ENCODING)
    )
    engine.intake.weather.enqueue(WeatherMessage(keys.weather_key(REGION), b"garbage", ""))
    engine.intake.update_weather(start + 1300 * SECOND)
    drive(engine, start + 3000 * SECOND, 2)
    assert (engine.counts.weather, engine.counts.refused["weather"]) == (2, 1)
    engine.close()
    again = Engine(config, tmp_path / "a")
    dry = Engine(ServiceConfig(), tmp_path / "b")
    drive(dry, start, 1)
    drive(dry, start + 3000 * SECOND, 2)
    now = start + 5000 * SECOND
    np.testing.assert_allclose(beliefs(again, now), beliefs(engine, now), atol=1e-6)
    assert np.abs(beliefs(dry, now) - beliefs(engine, now)).max() > 1e-3
    # The row of the file is recognised as a duplicate.
    assert len(archived_reports(tmp_path / "a").time) == 2
    assert pq.read_schema(next((tmp_path / "a" / "weather").glob("*"))).equals(
        tables.WEATHER_ARCHIVE
    )
    again.close()
    dry.close()


def test_weather_reports_of_a_day_are_joined_and_the_map_stays(tmp_path: Path) -> None:
    start = time.time_ns() - 7200 * SECOND
    root = tmp_path / "a"
    with closing(Engine(ServiceConfig(), root)) as engine:
        for k in range(6):
            payload = encode_weather(
                Report(start + 600 * k * SECOND, road_temperature=-1.0, precipitation=float(k % 2))
            )
            engine.intake.weather.enqueue(
                WeatherMessage(keys.weather_key(REGION), payload, wire.WEATHER_ENCODING)
            )
            engine.intake.update_weather(start + 600 * k * SECOND)
            drive(engine, start + 600 * k * SECOND, 1 + k)
            if k == 3:
                save_checkpoint(engine)
        now = start + 5000 * SECOND
        right = beliefs(engine, now)
        before = archived_reports(root)
    path = weather_files(root)[2]
    shutil.copy(path, tmp_path / path.name)
    assert (join_daily_files(root), join_daily_files(root), len(weather_files(root))) == (5, 0, 1)
    shutil.copy(tmp_path / path.name, path)  # a power loss before the file name was removed
    assert len(archived_reports(root).time) == 7
    for kept in (1, 0):
        assert len(checkpoints.list_checkpoints(root)) == kept
        with closing(Engine(ServiceConfig(), root)) as again:
            np.testing.assert_array_equal(beliefs(again, now), right)
        drop_checkpoints(root)
    assert join_daily_files(root) == 1
    assert {*archived_reports(root).time.tolist()} == {*before.time.tolist()}
    day = start // DAY_NS
    assert (retire_files(root, day - 2), len(weather_files(root))) == (0, 1)
    assert (retire_files(root, day + 1), len(weather_files(root))) == (1, 0)


def test_weather_that_no_longer_matters_is_not_loaded_or_kept(tmp_path: Path) -> None:
    now = time.time_ns()
    old = now - 60 * DAY_NS
    recent = (now // SECOND - 7200) * SECOND
    with closing(Engine(ServiceConfig(), tmp_path)) as engine:
        for seq, begin in enumerate((old, recent), 1):
            payload = encode_weather(Report(begin, road_temperature=-1.0))
            engine.intake.weather.enqueue(
                WeatherMessage(keys.weather_key(REGION), payload, wire.WEATHER_ENCODING)
            )
            engine.intake.update_weather(begin)
            drive(engine, begin, seq)
        right = beliefs(engine, now)
        engine.drop_old()
        assert (engine.state.fusion.reports.time >= recent).all()
    compact(tmp_path)
    drop_checkpoints(tmp_path)
    assert len(archived_reports(tmp_path).time) == 2
    with closing(Engine(ServiceConfig(), tmp_path)) as again:
        assert (again.state.fusion.reports.time >= recent).all()
        np.testing.assert_allclose(beliefs(again, now), right, atol=1e-6)


def test_a_running_service_takes_weather_over_its_key(
    service: Running, session: zenoh.Session, start: Callable[..., Any]
) -> None:
    # By default Zenoh drops a put if the link is busy for a millisecond.
    publisher = session.declare_publisher(
        keys.weather_key(REGION), congestion_control=zenoh.CongestionControl.BLOCK
    )
    matched(publisher)
    publisher.put(bytes(wire.MAX_BYTES + 1), encoding=wire.WEATHER_ENCODING)
    publisher.put(
        encode_weather(Report(time.time_ns(), precipitation=2.0)),
        encoding=wire.WEATHER_ENCODING,
    )
    publisher.put(encode_weather(Report(5, precipitation=2.0)), encoding=wire.WEATHER_ENCODING)
    counts = service.service.engine.counts
    until(lambda: counts.weather == 1 and counts.refused["weather"] == 2)
    publisher.undeclare()


def test_inbox_keeps_a_limited_number_of_reports_the_newest(tmp_path: Path) -> None:
    counts = ServiceCounts()
    inbox = WeatherInbox(tmp_path, "fleet", Fusion(120.0), counts)
    now = 10**18
    many = WAITING + 50
    key = keys.weather_key(REGION)
    for k in range(many):
        payload = encode_weather(Report(now + k * 1000, precipitation=2.0))
        inbox.enqueue(WeatherMessage(key, payload, wire.WEATHER_ENCODING))
    taken = inbox.take(now)
    assert taken is not None
    assert len(taken.time) == WAITING
    assert int(taken.time.max()) == now + (many - 1) * 1000
    assert inbox.take(now) is None
    inbox.enqueue(WeatherMessage(key, bytes(MOST_BYTES + 1), wire.WEATHER_ENCODING))
    assert inbox.take(now) is None
    assert counts.refused["weather"] == 1
