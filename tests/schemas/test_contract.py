"""Tests of the contract (common definitions in `schemas`). Keys, friction grid, configuration,
vehicle file and queries must be read as defined, and an error must name the wrong field.
"""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from schemas import config, grid, keys, mugrid, query, tables
from schemas.errors import InputError
from schemas.signals import CHANNELS, WHEELS, S
from schemas.vehicle import Vehicle, load_vehicle

VEHICLE = {
    "name": "saloon",
    "mass": 1643.0,
    "yaw_inertia": 1954.0,
    "cg_to_front_axle": 1.287,
    "cg_to_rear_axle": 1.403,
    "track_front": 1.581,
    "track_rear": 1.586,
    "cg_height": 0.545,
    "wheel_radius": 0.359,
    "wheel_inertia": 1.2,
    "longitudinal_stiffness": 90000.0,
    "cornering_stiffness": 70000.0,
}


@given(
    st.integers(0, 4**10 - 1),
    st.from_regex(config.NAME_PATTERN, fullmatch=True).filter(lambda s: "\n" not in s),
)
def test_a_key_is_taken_apart_as_it_was_built(region: int, vehicle: str) -> None:
    for name, build in (("obs", keys.observation_key), ("state", keys.state_key)):
        parsed = keys.parse(build(region, vehicle))
        assert (parsed.topic.name, parsed.quadint, parsed.name) == (name, region, vehicle)


@given(st.integers(0, 4**14 - 1))
def test_a_tile_key_extends_the_key_of_its_region(tile: int) -> None:
    assert keys.parse(keys.map_key(tile)).quadint == tile
    region = keys.chunks(int(grid.parent(tile, 10, of=14)), 10)
    assert keys.map_key(tile).startswith(f"gripmap/v1/map/{region}/")


@pytest.mark.parametrize(
    "key",
    [
        "gripmap/v1/obs/1200/320/230/*",
        "gripmap/v1/obs/**",
        "gripmap/v1/obs/1200/320/23/anna",
        "gripmap/v1/ack/Anna",
        "gripmap/v1/obs/1200/320/234/anna",
        "gripmap/v2/ack/anna",
        "gripmap/v1/what/anna",
        "gripmap/v1/map/1200/320/230",
        "gripmap/v1/ack/1200/anna",
        "gripmap/v1/ack/../../etc",
        "",
    ],
)
def test_a_key_that_is_not_concrete_or_not_ours_is_refused(key: str) -> None:
    with pytest.raises(InputError, match="^key: "):
        keys.parse(key)


def test_the_prior_leaves_ninety_per_cent_between_11_and_114() -> None:
    assert mugrid.quantiles(mugrid.PRIOR, 0.05) == pytest.approx(0.1075)
    assert mugrid.quantiles(mugrid.PRIOR, 0.95) == pytest.approx(1.1425)


@given(st.lists(st.floats(-15.0, 0.0), min_size=32, max_size=32))
def test_a_log_likelihood_survives_the_wire_within_half_a_step(values: list[float]) -> None:
    sent = np.array(values) - max(values)
    got = mugrid.decode_log_likelihood(mugrid.encode_log_likelihood(sent))
    assert np.abs(got - sent).max() <= 0.5 / mugrid.STEPS_PER_NAT + 1e-12


def test_a_log_likelihood_is_floored() -> None:
    impossible = np.zeros(32)
    impossible[0] = -np.inf
    assert mugrid.encode_log_likelihood(impossible)[0] == mugrid.FLOOR_STEPS


@given(
    st.lists(st.floats(0.0, 1.0), min_size=32, max_size=32).filter(lambda p: sum(p) > 1e-3),
    st.floats(0.01, 0.99),
)
def test_a_quantile_has_its_share_of_the_mass_below(p: list[float], q: float) -> None:
    value = mugrid.quantiles(np.array(p), q)
    below = np.interp(value, mugrid.EDGES, np.concatenate([[0.0], np.cumsum(p)])) / sum(p)
    assert below == pytest.approx(q, abs=1e-9)


def test_channels_are_in_the_order_of_their_indices() -> None:
    assert len(CHANNELS) == 18
    for index in S:
        assert CHANNELS[index] in (index.name.lower(), f"{index.name.lower()}_{WHEELS[0]}")


def test_every_column_has_a_unit_and_a_meaning() -> None:
    for schema in (
        tables.MAP_SCHEMA,
        tables.ESTIMATES_SCHEMA,
        tables.OBSERVATION_ARCHIVE,
        tables.STATE_ARCHIVE,
    ):
        assert len(set(schema.names)) == len(schema.names)
        assert all(
            field.metadata and field.metadata[b"unit"] and field.metadata[b"meaning"]
            for field in schema
        )


def test_a_vehicle_file_is_read(tmp_path: Path) -> None:
    path = tmp_path / "vehicle.json"
    path.write_text(json.dumps(VEHICLE))
    assert load_vehicle(path) == Vehicle.model_validate(VEHICLE)


@pytest.mark.parametrize(
    ("change", "complaint"),
    [
        ({"mass": -5.0}, "^mass: input should be greater than 0"),
        ({"mass": None}, "^mass: "),
        ({"track_front": "wide"}, "^track_front: "),
        ({"wheel_radius": float("nan")}, "^wheel_radius: "),
        ({"weel_radius_front": 0.3}, "^weel_radius_front: .*; write 'wheel_radius_front' in the"),
        ({"calibration": {"drives": 1, "axe": None}}, "^calibration.axe: .*; write 'ax' in the"),
    ],
)
def test_a_wrong_vehicle_field_is_named(
    tmp_path: Path, change: dict[str, object], complaint: str
) -> None:
    path = tmp_path / "vehicle.json"
    path.write_text(json.dumps(VEHICLE | change))
    with pytest.raises(InputError, match=complaint):
        load_vehicle(path)


def test_a_file_that_is_no_json_is_an_error_without_its_content(tmp_path: Path) -> None:
    path = tmp_path / "vehicle.json"
    path.write_text('{"mass": 1500.0,}')
    with pytest.raises(InputError, match="^content: invalid JSON: [^{]*; correct it in the"):
        load_vehicle(path)


def test_a_foreign_name_in_a_vehicle_file_is_ignored_with_a_warning(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    path = tmp_path / "vehicle.json"
    path.write_text(json.dumps(VEHICLE | {"comment": "winter tyres since 2026"}))
    assert load_vehicle(path) == Vehicle.model_validate(VEHICLE)
    assert "comment is not a known name; it is ignored" in caplog.text


def test_a_missing_vehicle_field_or_file_is_named(tmp_path: Path) -> None:
    path = tmp_path / "vehicle.json"
    path.write_text(json.dumps({k: v for k, v in VEHICLE.items() if k != "mass"}))
    with pytest.raises(InputError, match="^mass: is missing"):
        load_vehicle(path)
    with pytest.raises(InputError, match="^vehicle: cannot read"):
        load_vehicle(tmp_path / "none.json")


def test_an_unknown_setting_is_refused_and_defaults_hold(tmp_path: Path) -> None:
    path = tmp_path / "agent.json"
    path.write_text('{"state_rate": 3}')
    with pytest.raises(InputError, match="^state_rate: "):
        config.load_config(path, config.AgentConfig)
    assert config.load_config(None, config.AgentConfig).state_rate_hz == 2.0


@pytest.mark.parametrize(
    ("text", "utc"),
    [
        ("2026-01-31", "2026-01-31T00:00:00"),
        ("2026-01-31T07:00:00", "2026-01-31T07:00:00"),
        ("2026-01-31T07:00:00Z", "2026-01-31T07:00:00"),
        ("2026-01-31T07:00:00.123456+01:00", "2026-01-31T06:00:00.123456"),
        ("1971-01-01 00:00:00.000001", "1971-01-01T00:00:00.000001"),
    ],
)
def test_a_time_is_read_in_one_way_everywhere_and_without_a_zone_it_is_utc(
    text: str, utc: str
) -> None:
    expected = int(np.datetime64(utc, "ns").astype(np.int64))
    assert config.parse_moment(text, "from") == expected
    at = query.parse({"at": text}).at
    assert at is not None
    assert config.to_nanoseconds(at) == expected


@pytest.mark.parametrize("text", ["", "yesterday", "07:00", "1969-12-31", "2300-01-01", "1e9"])
def test_invalid_time_is_refused_with_the_field(text: str) -> None:
    with pytest.raises(
        InputError,
        match="^from: .* is not a time; write it like|^from: .* lies before 1970 or after",
    ):
        config.parse_moment(text, "from")


@pytest.mark.parametrize(
    ("parameters", "field"),
    [
        ({"bbox": "1,2,3"}, "bbox"),
        ({"bbox": "3,2,1,4"}, "bbox"),
        ({"bbox": "a,b,c,d"}, "bbox"),
        ({"bbox": "nan,0,1,1"}, "bbox"),
        ({"min_vehicles": "0"}, "min_vehicles"),
        ({"format": "xml"}, "format"),
        ({"at": "1970-12-31T07:00:00"}, "at"),
        ({"at": "yesterday"}, "at"),
        ({"route": "1,2"}, "route"),
        ({"route": "1,2|3"}, "route"),
        ({"box": "1"}, "box"),
        ({"basis": "guessed"}, "basis"),
    ],
)
def test_a_broken_query_names_the_parameter_and_the_fix(
    parameters: dict[str, str], field: str
) -> None:
    with pytest.raises(InputError, match=f"^{field}: .*; "):
        query.parse(parameters)


def test_a_query_is_read() -> None:
    asked = query.parse(
        {
            "bbox": "11.9,57.6,12.1,57.8",
            "min_vehicles": "2",
            "format": "geojson",
            "at": "2026-01-31T07:00:00Z",
        }
    )
    assert asked.bbox == (11.9, 57.6, 12.1, 57.8)
    assert (asked.min_vehicles, asked.format.encoding) == (2, "application/geo+json")
    route = query.parse({"route": "11.9,57.6|12.0,57.7"}).route
    assert route == ((11.9, 57.6), (12.0, 57.7))
