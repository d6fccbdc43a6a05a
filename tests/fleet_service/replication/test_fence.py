"""Tests of fencing, the protection of an archive against a service that lost its lease (ownership).
Its late uploads must replace no file of the service that took over.
"""

from __future__ import annotations

import time
from pathlib import Path

import pytest

from fleet_service.archive.identity import vehicle_ids
from fleet_service.archive.identity.vehicle_ids import VehicleIds
from fleet_service.counts import ServiceCounts
from fleet_service.fusion import Fusion
from fleet_service.ingest.weather import WeatherInbox, WeatherMessage, join_daily_files
from fleet_service.ingest.weather import archived_reports as archived_weather
from schemas import keys, weather, wire
from tests.buckets import BucketServer
from tests.fleet_service.replication.test_lease import Machine
from tests.schemas.examples import encode_weather
from tests.standbys import restore_archive


@pytest.mark.campaign
def test_late_uploads_of_a_former_lease_holder_overwrite_nothing(
    bucket: BucketServer, tmp_path: Path
) -> None:
    month = "2026-11"
    known = dict[int, int]()

    def meets(one: Machine, pseudonym: int) -> None:
        list_ = VehicleIds(one.root / "keys")
        known[pseudonym] = list_.id_of(f"car-{pseudonym}", month, pseudonym)
        list_.sync()

    def hears(one: Machine, region: int) -> None:
        inbox = WeatherInbox(one.root, one.config.name, fusion, ServiceCounts())
        report = encode_weather(weather.Report(time.time_ns(), precipitation=1.0))
        inbox.enqueue(WeatherMessage(keys.weather_key(region), report, wire.WEATHER_ENCODING))
        assert inbox.take(time.time_ns()) is not None

    fusion = Fusion(120.0)
    one = Machine(tmp_path / "one", bucket)
    for number in (1, 2):
        meets(one, number)
        hears(one, number)
    one.copy.upload_segments([])
    one.copy.sync()
    one.freeze()
    two = Machine(tmp_path / "two", bucket)
    for number in (3, 4):
        meets(two, number)
        hears(two, number)
    join_daily_files(two.root)
    two.copy.upload_segments([])
    two.copy.sync()
    known_there = dict(known)
    meets(one, 5)  # the frozen service resumes
    join_daily_files(one.root)
    one.copy.upload_segments([])
    # As if it had been frozen right after its checks.
    one.copy.bucket.may_write = lambda: True
    one.copy.bucket.assert_alone = None
    one.copy.sync()
    found = restore_archive(tmp_path / "new", bucket)
    held = vehicle_ids.read_numbers(found / "keys")
    assert {name: held.get(name) for name in known_there} == known_there
    assert set(archived_weather(found).region.tolist()) == {1, 2, 3, 4}
    two.close()
    one.close()
