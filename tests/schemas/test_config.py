"""Tests of the configuration reader: its errors name the file, the wrong setting and the fix."""

from __future__ import annotations

import json
import re
from pathlib import Path

import pytest
from pydantic import BaseModel

from fleet_service.enrolment.fleet import Enrolment
from schemas import tables
from schemas.config import LEAST_RAW_DAYS, AgentConfig, ServiceConfig, load_config
from schemas.errors import InputError
from schemas.vehicle import load_vehicle


@pytest.mark.parametrize(
    ("model", "settings", "message"),
    [
        (ServiceConfig, {"archiv": {}}, "^archiv: is not a known name; write 'archive' in the "),
        (ServiceConfig, {"archive": {"pth": "x"}}, "^archive.pth: .*; write 'path' in the conf"),
        (ServiceConfig, {"archive": {"copi": "x"}}, "^archive.copi: .*; write 'copy' in the conf"),
        (AgentConfig, {"zenoh": {"xyz": 1}}, "^zenoh.xyz: .*use one of connect, config in the"),
        (
            Enrolment,
            {"routers": {"router-a": {"host": ["h"], "port": 7447}}},
            r"^routers.router-a.host: .*; write 'hosts' in the",
        ),
    ],
)
def test_a_misspelt_setting_is_reported_with_the_known_name(
    tmp_path: Path, model: type[BaseModel], settings: dict[str, object], message: str
) -> None:
    path = tmp_path / "settings.json"
    path.write_text(json.dumps(settings))
    with pytest.raises(InputError) as error:
        load_config(path, model)
    assert re.search(message, str(error.value)), str(error.value)


def test_a_setting_that_is_given_twice_is_refused(tmp_path: Path) -> None:
    path = tmp_path / "settings.json"
    path.write_text('{"archive": {"path": "a"}, "zenoh": {}, "archive": {"copy": "file:///b"}}')
    with pytest.raises(InputError, match="^archive: is given more than once; keep one in the conf"):
        load_config(path, ServiceConfig)
    path.write_text('{"mass": 1500, "mass": 1600}')
    with pytest.raises(InputError, match="^mass: is given more than once; keep one in the vehicle"):
        load_vehicle(path)


def test_a_missing_file_is_reported_under_the_name_of_its_option(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="^config: cannot read .*nosuch.json"):
        load_config(tmp_path / "nosuch.json", ServiceConfig)
    with pytest.raises(InputError, match="^fleet: cannot read .*nosuch.json"):
        load_config(tmp_path / "nosuch.json", Enrolment, "fleet")


def test_an_archive_without_name_is_refused(tmp_path: Path) -> None:
    path = tmp_path / "service.json"
    path.write_text(json.dumps({"archive": ""}))
    with pytest.raises(InputError, match=r'^archive: should be a folder, or left out \(got ""\);'):
        load_config(path, ServiceConfig)


def test_raw_days_too_few_to_recognise_repeats_are_refused(tmp_path: Path) -> None:
    path = tmp_path / "service.json"
    for days in (0, LEAST_RAW_DAYS):
        path.write_text(json.dumps({"raw_days": days}))
        assert load_config(path, ServiceConfig).raw_days == days
    path.write_text(json.dumps({"raw_days": LEAST_RAW_DAYS - 1}))
    with pytest.raises(InputError, match=r"^raw_days: .* 0 or at least 31 \(got 30\);"):
        load_config(path, ServiceConfig)


@pytest.mark.parametrize("uri", ["foo", "s3://", "bucket/folder"])
def test_uri_that_can_name_no_folder_is_refused(tmp_path: Path, uri: str) -> None:
    path = tmp_path / "service.json"
    path.write_text(json.dumps({"put_to": uri}))
    with pytest.raises(InputError, match="^put_to: "):
        load_config(path, ServiceConfig)


@pytest.mark.parametrize("name", ["position_std", "yaw_std"])
def test_an_accuracy_that_a_service_rejects_is_refused_at_the_start(
    tmp_path: Path, name: str
) -> None:
    limits = next(field.range for field in tables.OBSERVATION if field.name == name)
    assert limits is not None
    path = tmp_path / "agent.json"
    path.write_text(json.dumps({name: limits[1]}))
    load_config(path, AgentConfig)
    path.write_text(json.dumps({name: 1.01 * limits[1]}))
    with pytest.raises(InputError, match=name):
        load_config(path, AgentConfig)


@pytest.mark.parametrize(
    ("settings", "words"),
    [
        ({"regions": ["1202/x"]}, "regions.0: should be 4, 3 and 3 digits from 0 to 3"),
        ({"name": "Shard 1"}, "name: should be 3 to 63 of a-z"),
    ],
)
def test_form_of_a_setting_is_explained_in_words(
    tmp_path: Path, settings: dict[str, object], words: str
) -> None:
    path = tmp_path / "service.json"
    path.write_text(json.dumps(settings))
    with pytest.raises(InputError, match=words):
        load_config(path, ServiceConfig)
