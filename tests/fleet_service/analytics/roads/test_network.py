"""Tests of the reading of directed road links from an OpenStreetMap extract and from files of
lines. Any other input must be refused with an error that names the file.
"""

from __future__ import annotations

from pathlib import Path

import geopandas
import numpy as np
import pytest
from shapely.geometry import LineString, Point

from fleet_service.analytics.roads.network import read_network
from schemas.errors import InputError

NODES = [(57.70, 11.97), (57.70, 11.98), (57.70, 11.99), (57.71, 11.98)]
WAYS = {
    1: ([1, 2], {"highway": "residential", "name": "First"}),
    2: ([2, 3], {"highway": "primary", "oneway": "yes"}),
    3: ([2, 4], {"highway": "service", "oneway": "-1"}),
    4: ([1, 2, 4, 1], {"highway": "tertiary", "junction": "roundabout"}),
    5: ([1, 4], {"highway": "footway"}),
    6: ([3, 4], {"building": "yes"}),
}


def extract(path: Path) -> Path:
    lines = ["<?xml version='1.0'?><osm version='0.6' generator='test'>"]
    lines += [
        f"<node id='{k}' version='1' lat='{lat}' lon='{lon}'/>"
        for k, (lat, lon) in enumerate(NODES, 1)
    ]
    for way, (nodes, tags) in WAYS.items():
        parts = [f"<nd ref='{node}'/>" for node in nodes] + [
            f"<tag k='{k}' v='{v}'/>" for k, v in tags.items()
        ]
        lines.append(f"<way id='{way}' version='1'>{''.join(parts)}</way>")
    path.write_text("\n".join([*lines, "</osm>"]))
    return path


def test_an_extract_gives_each_direction_that_cars_may_drive(tmp_path: Path) -> None:
    network = read_network(extract(tmp_path / "town.osm"))
    found = [(link.id, link.direction, link.kind) for link in network.links]
    assert found == [
        ("1", "forward", "residential"),
        ("1", "backward", "residential"),
        ("2", "forward", "primary"),
        ("3", "backward", "service"),
        ("4", "forward", "tertiary"),
    ]
    forward, backward = network.links[:2]
    assert forward.name == "First"
    assert np.array_equal(forward.longitude, backward.longitude[::-1])
    assert forward.longitude[0] == pytest.approx(11.97)
    assert network.source["extract"] == "town.osm"
    assert "OpenStreetMap" in network.source["licence"]


@pytest.mark.parametrize("ending", [".gpkg", ".geojson", ".parquet"])
def test_lines_with_ids_come_from_any_file_in_any_coordinates(tmp_path: Path, ending: str) -> None:
    lines = [
        LineString([(11.97, 57.70), (11.98, 57.70)]),
        LineString([(11.98, 57.70), (11.98, 57.71)]),
        Point(0, 0),
    ]
    frame = geopandas.GeoDataFrame(
        {"road": ["a", "b", "c"], "called": ["E6", None, None], "oneway": ["no", "forward", "no"]},
        geometry=lines,
        crs=4326,
    )
    frame = frame if ending == ".geojson" else frame.to_crs(3006)
    path = tmp_path / f"roads{ending}"
    frame.to_parquet(path) if ending == ".parquet" else frame.to_file(path)
    network = read_network(path, "road", "called")
    assert [(link.id, link.direction) for link in network.links] == [
        ("a", "forward"),
        ("a", "backward"),
        ("b", "forward"),
    ]
    assert network.links[0].name == "E6"
    assert network.links[0].latitude == pytest.approx([57.70, 57.70], abs=1e-7)
    assert network.notes == ()


def test_roads_with_the_same_id_are_noted(tmp_path: Path) -> None:
    lines = [LineString([(11.97, 57.70), (11.98, 57.70 + 0.01 * k)]) for k in range(3)]
    frame = geopandas.GeoDataFrame({"id": ["a", "b", "a"]}, geometry=lines, crs=4326)
    frame.to_parquet(tmp_path / "roads.parquet")
    network = read_network(tmp_path / "roads.parquet")
    assert network.notes == ("lines with the same 'id' count as one road (a); see --id",)


@pytest.mark.parametrize(
    ("name", "content", "field"),
    [
        ("a.osm.pbf", b"not a pbf", "extract"),
        ("a.osm", b"<osm", "extract"),
        ("a.osm", b"<?xml version='1.0'?><osm version='0.6'></osm>", "extract"),
        ("a.gpkg", b"x", "extract"),
        ("a.geojson", b'{"type": "FeatureCollection", "features": []}', "id"),
        ("a.txt", b"", "extract"),
    ],
)
def test_invalid_road_network_is_an_error_that_names_the_field(
    name: str, content: bytes, field: str, tmp_path: Path
) -> None:
    (tmp_path / name).write_bytes(content)
    with pytest.raises(InputError) as error:
        read_network(tmp_path / name)
    assert error.value.field == field


@pytest.mark.parametrize("missing", [None, np.nan])
def test_line_without_an_id_is_refused_and_a_missing_name_is_empty(
    tmp_path: Path, missing: float | None
) -> None:
    lines = [LineString([(11.97, 57.70), (11.98, 57.70)])] * 2
    frame = geopandas.GeoDataFrame({"id": [1, 2], "name": missing}, geometry=lines, crs=4326)
    path = tmp_path / "roads.parquet"
    frame.to_parquet(path)
    assert {link.name for link in read_network(path).links} == {""}
    frame.assign(id=[1.0, missing]).to_parquet(path)
    with pytest.raises(InputError, match=r"id: a line of roads.parquet has no 'id'"):
        read_network(path)


def test_a_truncated_extract_is_no_whole_one(tmp_path: Path) -> None:
    path = extract(tmp_path / "town.osm")
    path.write_bytes(path.read_bytes()[:-200])
    with pytest.raises(InputError, match="extract"):
        read_network(path)
    with pytest.raises(InputError, match="does not exist"):
        read_network(tmp_path / "none.osm")
