"""Tests of route files: GPX and GeoJSON of common programs give the same route, and other files are
refused with the reason.
"""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from edge_agent.ahead.route_file import read_route
from schemas.errors import InputError
from tests.edge_agent.ahead.roads import HOME, line

POINTS = list(zip(*(side[::20].tolist() for side in line()), strict=True))
GPX = (
    '<?xml version="1.0"?><gpx xmlns="http://www.topografix.com/GPX/1/1">'
    "<trk><trkseg>{}</trkseg></trk></gpx>"
)
TRACK = GPX.format("".join(f'<trkpt lat="{a}" lon="{o}"/>' for a, o in POINTS))
GEOMETRY = {"type": "LineString", "coordinates": [[o, a] for a, o in POINTS]}
FEATURE = {"type": "Feature", "geometry": GEOMETRY, "properties": {}}
COLLECTION = {"type": "FeatureCollection", "features": [FEATURE]}
LAUGHS = (
    '<!DOCTYPE g [<!ENTITY a "ha"><!ENTITY b "&a;&a;">]>'
    '<gpx><rte><rtept lat="57" lon="11">&b;</rtept></rte></gpx>'
)


@pytest.mark.parametrize(
    "text",
    [TRACK, TRACK.replace("trkpt", "rtept"), *map(json.dumps, (GEOMETRY, FEATURE, COLLECTION))],
)
def test_gpx_and_geojson_give_the_same_way(tmp_path: Path, text: str) -> None:
    file = tmp_path / "route"
    file.write_text(text)
    path = read_route(file).ahead(HOME, 200.0)
    assert path is not None
    assert len(path.distance) == 200


@pytest.mark.parametrize(
    "text",
    [
        "",
        "{}",
        "[]",
        "no",
        "<gpx>",
        LAUGHS,
        GPX.format(""),
        GPX.format('<trkpt lat="57.7"/>'),
        "[" * 100_000,
        GPX.format('<trkpt lat="57.7" lon="11"/>' * 2),
        GPX.format('<trkpt lat="1e9" lon="11"/><trkpt lat="1" lon="1"/>'),
        json.dumps({"type": "LineString", "coordinates": [[11.9, 57.7], ["x", 57.8]]}),
        json.dumps({"type": "LineString", "coordinates": [[float("nan"), 57.7], [1, 57.8]]}),
    ],
)
def test_invalid_route_file_is_refused_with_the_field(tmp_path: Path, text: str) -> None:
    file = tmp_path / "route.gpx"
    file.write_text(text)
    with pytest.raises(InputError, match="route: "):
        read_route(file)


def test_missing_file_is_reported(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="cannot read"):
        read_route(tmp_path / "none.gpx")
